"""What a library says of a stranger's file while it decodes it: for C, lines of the log, at debug level.

libjpeg and libpng, inside OpenCV, print what they think of a damaged photograph. While one is decoded, C's variable
`stderr`, which the GNU C library lets a program set, leads to a piece of memory. Descriptor 2 is left alone: it belongs
to the process, its other threads and whoever imported splatnode. It stays where Python, faulthandler and the last words
of the C library itself go, and an import changes nothing. Where the C library is another one, all is as before.

In a process of the command line that memory is a file, which is left where a decoder ends the process. The next command
tells what it says.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import errno
import fcntl
import itertools
import logging
import mmap
import os
import threading
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.process.files import StrayFile, check_owner_only, create_own, make_owner_only_folder, read_own
from splatnode.capture.process.terminal import event, is_logged
from splatnode.capture.process.text import LONGEST_TEXT, sanitize_text

log = logging.getLogger(__name__)

MOST_BYTES = 1 << 16  # of what is said meanwhile; what comes after it is lost, and that is told
_times, _crashes = itertools.count(1), itertools.count(1)  # that a library has said something
_UNBUFFERED = 2  # _IONBF of glibc's stdio.h
_warning = threading.RLock()  # two threads that change and restore the filters would leave them changed
_ENDING = ".said"  # of the files that outlive their process


@contextlib.contextmanager
def catch_library_lines() -> Iterator[None]:
    """Logs what C prints on its `stderr` in here, in any thread, once nobody is in here any more."""
    _catcher.enter()
    try:
        yield
    finally:
        _catcher.leave()


@contextlib.contextmanager
def ignore_file_warnings() -> Iterator[None]:
    """Leaves out what a library in Python warns of in a file, such as an old format: what it cannot read, it refuses.

    Of code that calls it wrongly it warns by other classes.
    """
    with _warning, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def keep_last_words(folder: Path) -> None:
    """Keeps what is said meanwhile in a file in `folder` from now on, made when it is needed, for one user alone."""
    _catcher.folder = folder


def tell_last_words(folder: Path) -> None:
    """Logs what libraries said in processes that have ended while they decoded, and removes their files.

    For the beginning of a process: nobody needs what cannot be read.
    """
    with contextlib.suppress(OSError):
        check_owner_only(folder)
        for path in sorted(path for path in folder.iterdir() if path.suffix == _ENDING):
            with contextlib.suppress(OSError, StrayFile):
                _tell_last_words(path)


def log_library_lines(data: bytes, ended: int = 0) -> None:
    """Logs what a library said, if anything, as one line: the 1st, 2nd, 4th, ... time, with how many times it was.

    `ended`: the exit code of the process in which it said so; below 0, which is a signal, that is no mere detail.
    """
    if not data:
        return
    times = next(_crashes if ended < 0 else _times)
    if is_logged(times):
        lines = data.decode(errors="replace").splitlines()
        fields: dict[str, object] = {"times": times, "lines": len(lines)}
        fields |= {"cut": True} if len(data) >= MOST_BYTES else {}
        fields |= {"ended": ended} if ended else {}
        said = sanitize_text("; ".join(line.strip() for line in lines), LONGEST_TEXT)
        event(log, logging.INFO if ended < 0 else logging.DEBUG, "library_said", **fields, said=said)


class _Catcher:
    """How many are decoding, and the memory that C's `stderr` leads to while there are any."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self._lock = threading.Lock()
        self._inside = 0
        self._memory: _Memory | None = None  # None before the first time, and where there is none
        self._is_tried = False

    def enter(self) -> None:
        with self._lock:
            if not self._is_tried:
                self._is_tried, self._memory = True, self._find_memory()
            self._inside += 1
            if self._inside == 1 and self._memory is not None:
                self._memory.attach()

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside or self._memory is None:
                return
            self._memory.detach()
            data = self._memory.take()
        log_library_lines(data)

    def _find_memory(self) -> _Memory | None:
        libc = ctypes.CDLL(None)
        if not hasattr(libc, "gnu_get_libc_version"):
            return None
        try:
            found = _Memory(libc, self.folder)
        except (OSError, ValueError) as error:
            log.debug("what decoders say goes to stderr: %s", sanitize_text(error))
            return None
        os.register_at_fork(after_in_child=lambda: self._begin_anew(found))
        return found

    def _begin_anew(self, memory: _Memory) -> None:
        """For a copy of the process, in which nobody decodes: the memory is that of the process it is a copy of."""
        if self._memory is memory:
            memory.give_up()
            self._lock, self._memory = threading.Lock(), None
            self._inside, self._is_tried = 0, False


class _Memory:
    """A stream of C's that writes into memory, as much as there is, and that is never closed. For one thread."""

    def __init__(self, libc: ctypes.CDLL, folder: Path | None) -> None:
        """Raises OSError, ValueError."""
        self._libc, self._stderr = libc, ctypes.c_void_p.in_dll(libc, "stderr")  # the variable
        self._before: int | None = None
        self._lock, self._path = _create_file(folder)
        self._bytes = _map_file(self._path)
        libc.fmemopen.restype = ctypes.c_void_p
        libc.fmemopen.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p]
        libc.setvbuf.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
        libc.ftell.restype, libc.ftell.argtypes = ctypes.c_long, [ctypes.c_void_p]
        libc.rewind.argtypes = [ctypes.c_void_p]
        place = (ctypes.c_char * MOST_BYTES).from_buffer(self._bytes)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(place))  # C may write there for as long as the process lives
        self._stream: int | None = libc.fmemopen(ctypes.addressof(place), MOST_BYTES, b"w")
        if self._stream is None:
            raise OSError(errno.ENOMEM, "no stream for what decoders say")
        libc.setvbuf(self._stream, None, _UNBUFFERED, 0)
        atexit.register(self._remove)

    def attach(self) -> None:
        self._before, self._stderr.value = self._stderr.value, self._stream

    def detach(self) -> None:
        """Gives the variable back, unless somebody has set it meanwhile."""
        if self._stderr.value == self._stream:
            self._stderr.value = self._before

    def take(self) -> bytes:
        """Returns what was written since the last time."""
        size = self._libc.ftell(self._stream)
        if size <= 0:
            return b""
        data = self._bytes[:size]
        self._bytes[:size] = bytes(size)
        self._libc.rewind(self._stream)
        return data

    def give_up(self) -> None:
        """In a copy of the process."""
        self.detach()
        atexit.unregister(self._remove)
        if self._lock is not None:
            os.close(self._lock)  # the other process holds it on

    def _remove(self) -> None:
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def _create_file(folder: Path | None) -> tuple[int | None, Path | None]:
    """The descriptor of a file that this process holds the lock of, and its path; None where there can be none."""
    if folder is None:
        return None, None
    path = folder / f"{uuid.uuid4().hex}{_ENDING}"
    try:
        make_owner_only_folder(folder, "$XDG_RUNTIME_DIR", ours=True)
        os.close(create_own(path))
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        log.debug("what decoders say is in no file that outlives the process: %s", sanitize_text(error))
        return None, None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.posix_fallocate(descriptor, 0, MOST_BYTES)  # writing to memory that the disk has no room for ends a process
    except OSError as error:
        log.debug("what decoders say is in no file that outlives the process: %s", sanitize_text(error))
        os.close(descriptor)
        path.unlink(missing_ok=True)
        return None, None
    return descriptor, path


def _map_file(path: Path | None) -> mmap.mmap:
    """Maps the file by another descriptor than that of the lock: the memory keeps it, in copies of the process, too."""
    if path is None:
        return mmap.mmap(-1, MOST_BYTES)
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        return mmap.mmap(descriptor, MOST_BYTES)
    finally:
        os.close(descriptor)


def _tell_last_words(path: Path) -> None:
    data = read_own(path, MOST_BYTES)
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:  # its process lives
        return
    finally:
        os.close(descriptor)
    path.unlink(missing_ok=True)
    if said := sanitize_text(data.rstrip(b"\0").decode(errors="replace").strip(), LONGEST_TEXT):
        log.warning("a process ended while it decoded a photograph; the decoder had said: %s", said)


_catcher = _Catcher()
