"""Our code in a process of its own, with a limit on its memory: what a stranger's file does to it ends there."""

from __future__ import annotations

import contextlib
import errno
import resource
import subprocess

from splatnode.capture.process import python


def answer(module: str, data: bytes, most: int, *arguments: str) -> tuple[bytes, int]:
    """Returns what the process of a module writes, at most `most` bytes, after it has read `data`, and how it ended."""
    child = start_process(python.command(module, *arguments), subprocess.PIPE)
    with child:
        assert child.stdin is not None and child.stdout is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # it ended before it had read all
                child.stdin.write(data)
                child.stdin.close()
            found = child.stdout.read(most)
            child.stdout.close()  # what it would write beyond ends it
            return found, child.wait()
        finally:
            child.kill()


def start_process(command: list[str], stdin: int) -> subprocess.Popen[bytes]:
    """The process, whose output can be read. Raises OSError; what is_shortage tells where no further one may be."""
    try:
        return subprocess.Popen(
            command,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # what a decoder says of a stranger's file is a stranger's text
            start_new_session=True,  # Ctrl-C is for us
        )
    except BlockingIOError as error:  # fork(2): too many processes, or threads
        raise OSError(errno.ENOMEM, f"no further process can be started ({error.strerror})") from error


def limit_memory(further_bytes: int) -> None:
    """Lets this process take so many bytes beyond those that it has now; a later limit may be another one."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _data_bytes() + further_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def _data_bytes() -> int:
    """Returns the bytes of this process that RLIMIT_DATA counts now."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))
