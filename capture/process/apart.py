"""Our code in a process of its own, with a limit on its memory: what a stranger's file does to it ends there."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import resource
import subprocess
from collections.abc import Iterator

from splatnode.capture.process import python

_MOST_SAID = 1 << 16  # bytes on stderr


def answer(module: str, data: bytes, most: int, *arguments: str) -> tuple[bytes, int]:
    """Returns what the process of a module writes, at most `most` bytes, after it has read `data`, and how it ended."""
    with start_process(python.command(module, *arguments), subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it ended before it had read all
            child.stdin.write(data)
            child.stdin.close()
        found = child.stdout.read(most)
        child.stdout.close()  # what it would write beyond ends it
        return found, child.wait()


@contextlib.contextmanager
def start_process(command: list[str], stdin: int) -> Iterator[subprocess.Popen[bytes]]:
    """The process, whose output can be read; it is ended at the end. What it says on stderr goes to the log then.

    Raises OSError; what is_shortage tells where no further one may be.
    """
    with _hear() as heard:
        try:
            child = subprocess.Popen(
                command,
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=heard,  # what a decoder says of a stranger's file is a stranger's text
                start_new_session=True,  # Ctrl-C is for us
            )
        except BlockingIOError as error:  # fork(2): too many processes, or threads
            raise OSError(errno.ENOMEM, f"no further process can be started ({error.strerror})") from error
        with child:
            try:
                yield child
            finally:
                ended = child.poll()
                child.kill()
                child.wait()
                _tell(heard, ended or 0)


@contextlib.contextmanager
def _hear() -> Iterator[int]:
    """A descriptor that takes _MOST_SAID bytes of all that is written; where the system has no such, /dev/null."""
    if not hasattr(os, "memfd_create"):
        yield subprocess.DEVNULL
        return
    heard = os.memfd_create("decoder", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(heard, _MOST_SAID)
        fcntl.fcntl(heard, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK)
        yield heard
    finally:
        os.close(heard)


def _tell(heard: int, ended: int) -> None:
    if heard < 0 or not (size := os.lseek(heard, 0, os.SEEK_CUR)):
        return
    from splatnode.capture.process.library_lines import log_library_lines  # the process itself shall start soon

    log_library_lines(os.pread(heard, size, 0), ended)


def limit_memory(further_bytes: int) -> None:
    """Lets this process take so many bytes beyond those that it has now; a later limit may be another one."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _data_bytes() + further_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def _data_bytes() -> int:
    """Returns the bytes of this process that RLIMIT_DATA counts now."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))
