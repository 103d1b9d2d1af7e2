"""Python in a process of its own: the one way to start it.

A data set may hold a file called numpy.py, and a program that is begun in that folder must not run it. So each process
is isolated (`-I`): the current folder is no place of modules, and neither are relative folders of $PYTHONPATH. It has
the places of an isolated Python, which are the standard library and the environment's site packages; the user's own
site packages and the absolute folders of $PYTHONPATH, where this process has them, too; and this splatnode.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import resource
import site
import subprocess
import sys
from collections.abc import Iterator

from splatnode.capture.process import start


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as `python -m` does, with these arguments, in a process that is isolated."""
    return make_isolated_command(start.__file__, json.dumps(_user_folders()), module, *arguments)


def make_isolated_command(*arguments: str) -> list[str]:
    """The command of an isolated Python with these `arguments`, such as a script, or -m and a module.

    It has none of the user's places, and does not know this splatnode unless that is installed.
    """
    kept = [*(["-B"] if sys.dont_write_bytecode else []), *(["-X", "utf8"] if sys.flags.utf8_mode else [])]
    return [sys.executable, "-I", *kept, *arguments]  # $PYTHON... do not count there


def place_of(module: str) -> str | None:
    """The folder in which another process finds the package of a module; None for splatnode, which it finds anyway."""
    package = module.partition(".")[0]
    if package == "splatnode" or (file := getattr(sys.modules.get(package), "__file__", None)) is None:
        return None
    folder = os.path.dirname(os.path.abspath(file))
    return os.path.dirname(folder) if hasattr(sys.modules[package], "__path__") else folder


def _user_folders() -> list[str]:
    """Lists where this process finds modules because its user said so, without the current folder."""
    named = [*os.environ.get("PYTHONPATH", "").split(os.pathsep), site.getusersitepackages()]
    known = set(sys.path)
    found = dict.fromkeys(os.path.abspath(each) for each in named if os.path.isabs(each))
    return [each for each in found if each in known and not is_current_folder(each)]


def is_current_folder(folder: str) -> bool:
    """Returns whether a folder is the current one, which may be anybody's."""
    try:
        return os.path.samefile(folder, os.curdir)
    except OSError:  # one of them is not there
        return False


# Our code in a process of its own, with a limit on its memory: what a stranger's file does to it ends there.

_MOST_SAID = 1 << 16  # bytes on stderr


def answer(module: str, data: bytes, most: int, *arguments: str) -> tuple[bytes, int]:
    """Returns what the process of a module writes, at most `most` bytes, after it has read `data`, and how it ended."""
    with start_process(command(module, *arguments), subprocess.PIPE) as child:
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
