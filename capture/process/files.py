"""Folders of one user alone, and files in them that nobody else can have put there, whatever the umask.

What is checked is what was opened: a name may lead elsewhere a moment later, a descriptor does not. Root is trusted.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import re
import shutil
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO

from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import sanitize_text

log = logging.getLogger(__name__)

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_OTHERS, _OTHERS_WRITE = 0o077, 0o022
_NAMED = 5  # stray files


class NotOwnerOnly(PermissionError):
    """Another user could read or replace what is kept there; the text says what to do."""


class StrayFile(ValueError):
    """A file is not this user's, or is larger than any that is written there."""


def make_owner_only_folder(folder: Path, instead: str, *, ours: bool) -> None:
    """Makes `folder`, and what is missing above it, for this user alone.

    Where it is there and others may read it, it is closed to them if it is `ours` by its name, and refused if it is
    any folder that somebody named. Raises OSError, and NotOwnerOnly, which names what to set `instead`.
    """
    with _open_folder(folder, instead) as descriptor:
        found = os.fstat(descriptor)
        if found.st_uid != os.geteuid():
            raise NotOwnerOnly(_describe_owner(folder, found, instead))
        if ours and found.st_mode & _OTHERS and not found.st_mode & stat.S_IWOTH:
            os.fchmod(descriptor, 0o700)
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
        if mode & _OTHERS:
            raise NotOwnerOnly(
                f"{_sanitize_path(folder)} must be private (mode 0700), got mode {mode:04o}. If nobody else has put "
                "anything "
                f"there, run: chmod 700 {_sanitize_path(folder)}. Or set {instead} to a folder that is not there yet"
            )


def check_way(folder: Path, instead: str = "") -> None:
    """Raises NotOwnerOnly where another user could make the way to `folder` lead elsewhere, as sshd's StrictModes does.

    Each folder above it must be root's or this user's, and no group and nobody else may write there, unless it is
    sticky. So must each above what a link on the way leads to. What is not there yet is no hindrance. The text says
    what to run, and what to set `instead`.
    """
    _check_steps(Path.cwd() / folder, instead, is_end=True)


def check_owner_only(folder: Path) -> None:
    """Raises NotOwnerOnly where another user could change what lies in `folder`, OSError where it is none."""
    check_way(folder)
    with _open(os.path.realpath(folder), _FOLDER) as descriptor:
        _check_owner(os.fstat(descriptor), folder)


@contextlib.contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A folder among the system's temporary ones, which is removed at the end, and which this user alone can change.

    Raises NotOwnerOnly, OSError.
    """
    with tempfile.TemporaryDirectory(prefix=prefix) as name:
        check_way(Path(name), "$TMPDIR")
        yield Path(name)


def read_own(path: Path, most_bytes: int, *, only_ours: bool = False) -> bytes:
    """The content of a file of this user. Raises OSError, and StrayFile for what is none, or is larger.

    `only_ours`: raises NotOwnerOnly where another user could change it.
    """
    if only_ours:
        check_way(path.parent)
    if not stat.S_ISREG(os.lstat(path).st_mode):  # before it is opened: a device may begin to work
        raise StrayFile(f"{_sanitize_path(path)} is no regular file")
    with open(os.open(path, os.O_RDONLY | _FILE), "rb", buffering=0) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode) or found.st_uid not in (0, os.geteuid()):
            raise StrayFile(f"{_sanitize_path(path)} is no file of this user")
        if found.st_size > most_bytes:
            raise StrayFile(f"{_sanitize_path(path)} has {found.st_size} bytes; at most {most_bytes} are read")
        if only_ours:
            _check_owner(found, path)
        return _read(file.fileno(), found.st_size)


def create_own(path: Path) -> int:
    """The descriptor of a new file that only this user can read. Raises OSError where anything has that name."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _FILE, 0o600)
    try:
        os.fchmod(descriptor, 0o600)  # a umask may have taken even that
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def list_own_files(folder: Path, name: re.Pattern[str], ending: str) -> list[Path]:
    """The regular files of this user in `folder` called as `name` says, in the order of the numbers they begin with.

    What else ends with `ending` (a copy, a folder, a link, a pipe) is left alone, and said.
    """
    ours, strays = [], []
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.endswith(ending):
                continue
            found = entry.stat(follow_symlinks=False)
            is_ours = stat.S_ISREG(found.st_mode) and found.st_uid in (0, os.geteuid())
            (ours if is_ours and name.fullmatch(entry.name) else strays).append(entry.name)
    if strays:
        named = ", ".join(sanitize_text(each, 100) for each in sorted(strays)[:_NAMED])
        event(log, logging.WARNING, "left_alone", folder=folder, files=len(strays), such_as=named)
    return [folder / each for each in sorted(ours, key=_number_and_name)]


def _number_and_name(name: str) -> tuple[int, str]:
    digits = re.match("[0-9]*", name)
    return int(digits[0]) if digits and digits[0] else 0, name


def _check_owner(found: os.stat_result, path: Path) -> None:
    if found.st_uid not in (0, os.geteuid()) or found.st_mode & _OTHERS_WRITE:
        raise NotOwnerOnly(
            f"{_sanitize_path(path)} can be changed by others (mode {stat.S_IMODE(found.st_mode):04o} of user "
            f"{found.st_uid}). "
            f"Look what lies there, then run: chown {os.geteuid()} {_sanitize_path(path)}; chmod go-w "
            f"{_sanitize_path(path)}"
        )


@contextlib.contextmanager
def _open_folder(folder: Path, instead: str) -> Iterator[int]:
    """A descriptor of the folder, which is made where it is missing."""
    check_way(folder, instead)
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    for each in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process has just made it
            _make(each)
    with _open(os.path.realpath(folder), _FOLDER) as descriptor:
        yield descriptor


def _make(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    with _open(folder, os.O_PATH | _FOLDER) as descriptor:
        if os.fstat(descriptor).st_mode & 0o700 != 0o700:  # a umask has taken the owner's own rights
            os.chmod(f"/proc/self/fd/{descriptor}", 0o700)


@contextlib.contextmanager
def _open(path: Path | str, flags: int) -> Iterator[int]:
    descriptor = os.open(path, flags)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _check_step(each: Path, instead: str, is_end: bool) -> bool:
    """Whether the way goes on behind `each`. Raises NotOwnerOnly; what may be done with an end, its caller checks."""
    try:
        found = os.lstat(each)
    except (FileNotFoundError, NotADirectoryError):
        return False
    is_link = stat.S_ISLNK(found.st_mode)
    others_write = bool(found.st_mode & _OTHERS_WRITE) and not found.st_mode & stat.S_ISVTX
    bad_mode = others_write and not is_link and not is_end
    is_anothers = found.st_uid not in (0, os.geteuid())
    if is_anothers or bad_mode:
        shown, me, mode = _sanitize_path(each), os.geteuid(), stat.S_IMODE(found.st_mode)
        run = [f"chown {'-h ' * is_link}{me} {shown}"] * is_anothers + [f"chmod go-w {shown}"] * bad_mode
        raise NotOwnerOnly(
            f"{shown} must be of root or of user {me}, and nobody else may write there unless it is sticky as /tmp is, "
            f"but it is of user {found.st_uid} with mode {mode:04o}: look what lies there, then run: {'; '.join(run)}"
            f"{f'. Or set {instead} to a folder of your own' if instead else ''}"
        )
    if is_link and os.path.exists(each):  # and is no circle
        _check_steps(Path(os.path.realpath(each.parent), os.readlink(each)), instead, is_end)
    return True


def _check_steps(folder: Path, instead: str, is_end: bool) -> None:
    for each in (*reversed(folder.parents), folder):
        if not _check_step(each, instead, is_end and each == folder):
            return


def _describe_owner(path: Path, found: os.stat_result, instead: str) -> str:
    return (
        f"{_sanitize_path(path)} belongs to user {found.st_uid}, who could read and replace what is kept there. "
        f"Set {instead} to a folder of your own"
    )


def _read(descriptor: int, size: int) -> bytes:
    pieces = []
    while size > 0 and (piece := os.read(descriptor, min(size, 1 << 30))):
        pieces.append(piece)
        size -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def _sanitize_path(path: Path) -> str:
    return sanitize_text(path)


# Files that a stranger may have put there: regular ones only, and never more bytes than the reader can use.


def read_bounded(path: Path, most: int, refusal: type[Exception], source: str = "") -> bytes:
    """The content of `path`, as long as it was when it was opened, if that is at most `most` bytes.

    A pipe or a device, which could be read for ever, is no file; nor is it opened, which some devices take for a
    command. Raises a `refusal` that begins with `source`, or OSError where the bytes cannot be had.
    """
    where = f"{source}: " if source else ""
    with open_regular(path, refusal, source) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise refusal(f"{where}the file has {size} bytes; at most {most} are read")
        return file.read(size)


def read_text(path: Path, most: int, refusal: type[Exception], source: str, wanted: str) -> str:
    """The text of a file that must give what `wanted` says. Raises a `refusal` that begins with `source`."""
    try:
        return read_bounded(path, most, refusal, source).decode("utf-8-sig")
    except OSError as error:
        raise refusal(f"{source}: {error.strerror}; give a file with {wanted}") from error
    except UnicodeDecodeError as error:
        raise refusal(f"{source} is no text; it must give {wanted}") from error


@contextlib.contextmanager
def open_regular(path: Path, refusal: type[Exception], source: str = "") -> Iterator[BinaryIO]:
    """The file `path`, opened to be read. Raises as `read_bounded`."""
    where = f"{source}: " if source else ""
    if "\0" in str(path):
        raise refusal(f"{where}no file has a null byte in its name")
    _must_be_regular(os.stat(path), refusal, where)
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        _must_be_regular(os.fstat(file.fileno()), refusal, where)  # of what was opened, whatever was there before
        yield file


def _must_be_regular(found: os.stat_result, refusal: type[Exception], where: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = "folder" if stat.S_ISDIR(found.st_mode) else "pipe or a device"
        raise refusal(f"{where}must be a file, is a {kind}")


# Is there room on the disk for what is about to be written, and was it the disk that failed?

_OF_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS}


def is_disk_error(error: BaseException) -> bool:
    """Whether something failed because the disk did not take it, which says nothing of what it was."""
    return isinstance(error, OSError) and error.errno in _OF_DISK


def shortage(folder: Path, needed_bytes: int, what: str) -> str:
    """Why `what` may not fit into `folder`, with both numbers; empty where `needed_bytes` are free.

    `folder` need not exist yet. A file system that does not tell its size is taken to have room. Raises OSError.
    """
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    disk = shutil.disk_usage(existing)
    if disk.total == 0 or disk.free >= needed_bytes:
        return ""
    return f"{_megabytes(disk.free)} are free in {folder}, and {what} may take {_megabytes(needed_bytes)}"


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


# Files that are whole or not there, also after a power cut; and files that no link leads to.

_BUFFER = 1 << 20  # bytes: the many small arrays of a message are one call each else


def write_atomically(path: Path, content: Iterable[bytes | memoryview]) -> None:
    """Writes `path` under a temporary name, through to the disk, then renames it. Raises OSError, nothing left.

    Only this user can read it. A process that is killed may leave the temporary file, `.NAME.*.tmp`.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(create_own(temporary), "wb", buffering=_BUFFER) as file:
            file.writelines(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def open_itself(path: Path, mode: str, **options: Any) -> IO[Any]:
    """Opens a file to write into it as `open` does, but not one that a link in its place names. Raises OSError."""
    try:
        return open(path, mode, opener=_open_no_link, **options)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise OSError(error.errno, "a link lies where this file belongs; remove it", str(path)) from error


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def remove_leftovers(folder: Path) -> None:
    """Removes what killed processes left of files that they were writing. For the one process that writes there."""
    for leftover in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):  # where it cannot be removed, it is in nobody's way
            if stat.S_ISREG(leftover.lstat().st_mode):
                leftover.unlink()


def sync_folder(folder: Path) -> None:
    """Makes renames and removals survive a power cut. A file system that cannot do it has done what it can.

    Raises what is_shortage tells: where the folder cannot be opened now, nothing is promised.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise_shortage(error)


# One process at a time: a lock that the kernel lets go of when its holder dies, however it dies.


class LockHeld(RuntimeError):
    """Another process holds the lock."""

    exit_code = 75

    def __init__(self, message: str, pid: int | None) -> None:
        super().__init__(message)
        self.pid = pid


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Holds the lock file at `path`, which is this user's and tells the holder's process id. Raises LockHeld, OSError.

    The file stays, unless its holder removes it.
    """
    with contextlib.ExitStack() as resources:
        file = resources.enter_context(_hold_lock(path))
        while not _is_at(path, file):  # the holder before removed the file after it was opened here
            file = resources.enter_context(_hold_lock(path))
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


@contextlib.contextmanager
def _hold_lock(path: Path) -> Iterator[TextIO]:
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(path, flags, 0o600), "a+", errors="replace") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EEXIST, "something lies where the lock belongs; remove it", str(path))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            text = file.read(32).strip()
            pid = int(text) if text.isdecimal() else None
            raise LockHeld(f"{path} is held by {f'process {pid}' if pid else 'another process'}", pid) from error
        yield file


def _is_at(path: Path, file: TextIO) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


# Folders that a process makes: none is left behind empty, and one process at a time writes into one.

LOCK = ".splatnode.lock"


@contextlib.contextmanager
def make_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` and the folders above it; at the end removes those that it made and that are empty.

    Raises OSError where one cannot be made.
    """
    with contextlib.ExitStack() as resources:
        _make_level(folder, resources)
        yield


@contextlib.contextmanager
def claim_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` as `make_folder` does and holds its lock, whose file is removed at the end.

    Raises LockHeld, OSError.
    """
    with make_folder(folder), exclusive(folder / LOCK):
        try:
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)


def _make_level(folder: Path, resources: contextlib.ExitStack) -> None:
    if folder.is_dir():
        return
    _make_level(folder.parent, resources)
    try:
        folder.mkdir()
    except FileExistsError as error:
        if folder.is_dir():  # another process has just made it
            return
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder)) from error
    resources.callback(_remove_if_empty, folder)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it holds files, which is the usual case
        folder.rmdir()


# Where a daemon keeps what must outlive it.


def state_directory() -> Path:
    """$STATE_DIRECTORY, which systemd sets, else $XDG_STATE_HOME/splatnode, else ~/.local/state/splatnode."""
    if os.environ.get("STATE_DIRECTORY"):
        return Path(os.environ["STATE_DIRECTORY"].split(":")[0])
    named = os.environ.get("XDG_STATE_HOME")
    return (Path(named).expanduser() if named else home("XDG_STATE_HOME") / ".local" / "state") / "splatnode"


def default_runtime_directory() -> Path:
    """The folder of what need not outlive the machine's next start, such as sockets: $RUNTIME_DIRECTORY, which systemd
    sets, else $XDG_RUNTIME_DIR/splatnode, else one among the temporary folders. It may not be there yet.
    """
    if os.environ.get("RUNTIME_DIRECTORY"):
        return Path(os.environ["RUNTIME_DIRECTORY"].split(":")[0])
    if os.environ.get("XDG_RUNTIME_DIR"):
        return Path(os.environ["XDG_RUNTIME_DIR"], "splatnode")
    return Path(tempfile.gettempdir(), f"splatnode-{os.getuid()}")


def home(instead: str) -> Path:
    """The user's own folder. Raises ValueError, which names the variable to set `instead`, where there is none.

    A number that a container or a service runs as is a user without one.
    """
    try:
        return Path.home()
    except RuntimeError as error:
        raise ValueError(f"user {os.getuid()} has no home directory; set {instead} to a folder") from error
