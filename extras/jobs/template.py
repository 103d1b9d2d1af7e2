"""A process that others are copies of: this module makes a copy of its process for each call.

What a call imports is imported here once, so that a copy has it at once; with torch that saves seconds. Each line of
standard input is a folder with a call and the cores for it, in JSON. Each line of standard output is the number of a
process that began, or that and its exit code, below 0 a signal, when it has ended.

With a folder on its command line it is the process of one call: it makes the call that lies there, and answers.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import pickle
import selectors
import signal
import socket
import sys
import traceback
from pathlib import Path
from typing import IO, NoReturn

from splatnode.capture.process.files import check_owner_only
from splatnode.extras.jobs import ANSWER, CALL, ERROR, LOG
from splatnode.extras.jobs.launch import end_with

RAISED = 1  # the exit code where the function raised


def run_call(folder: Path) -> int:
    """Makes the call and leaves the answer, or what was raised; returns the exit code.

    Raises NotOwnerOnly for a call that another user could have put there.
    """
    check_owner_only(folder)
    with (folder / CALL).open("rb") as call:
        module_of(call)
        try:
            answer = pickle.dumps(pickle.load(call)())
        except Exception:
            (folder / ERROR).write_text(traceback.format_exc(), errors="backslashreplace")
            return RAISED
    partial = folder / f"{ANSWER}.partial"
    partial.write_bytes(answer)
    os.replace(partial, folder / ANSWER)
    return 0


def module_of(call: IO[bytes]) -> str:
    """The name of the module of a call, which is found from here on; the function comes next in the file."""
    for place in pickle.load(call):
        if place not in sys.path:
            sys.path.append(place)
    return pickle.load(call)


def main() -> None:
    """Ends when standard input does."""
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what an import prints is no answer
    ends, woken = socket.socketpair()
    for end in (ends, woken):
        end.setblocking(False)
    signal.set_wakeup_fd(woken.fileno())
    signal.signal(signal.SIGCHLD, lambda *_: None)  # none is lost, and the descriptor wakes
    with selectors.DefaultSelector() as selector:
        selector.register(0, selectors.EVENT_READ)
        selector.register(ends, selectors.EVENT_READ)
        rest = b""
        while True:
            ready = {key.fileobj for key, _ in selector.select()}
            if ends in ready:
                with contextlib.suppress(BlockingIOError):
                    ends.recv(1024)
                _tell_ends(output)
            if 0 in ready:
                read = os.read(0, 65536)
                if not read:
                    return
                *lines, rest = (rest + read).split(b"\n")
                for line in lines:
                    folder, cores = json.loads(line)
                    _tell(output, _copy(Path(folder), cores))


def _copy(folder: Path, cores: list[int]) -> int:
    """The number of the copy that makes the call of `folder` on `cores`."""
    with contextlib.suppress(Exception), (folder / CALL).open("rb") as call:  # the copy tells what fails
        check_owner_only(folder)
        importlib.import_module(module_of(call))
    me = os.getpid()
    if (pid := os.fork()) == 0:
        _become(folder, cores, me)
    with contextlib.suppress(OSError):  # the copy has done so, or has ended
        os.setpgid(pid, pid)
    return pid


def _become(folder: Path, cores: list[int], template: int) -> NoReturn:
    code = RAISED
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setpgid(0, 0)
        end_with(template)
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, cores)
        log, nothing = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), os.open(os.devnull, os.O_RDONLY)
        for descriptor, stream in ((nothing, 0), (log, 1), (log, 2)):
            os.dup2(descriptor, stream)
        code = run_call(folder)
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        os.write(2, traceback.format_exc().encode(errors="backslashreplace"))
    finally:
        os._exit(code)


def _tell_ends(output: IO[str]) -> None:
    with contextlib.suppress(ChildProcessError):  # there is none any more
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            _tell(output, ended[0], os.waitstatus_to_exitcode(ended[1]))


def _tell(output: IO[str], *numbers: int) -> None:
    output.write(" ".join(map(str, numbers)) + "\n")
    output.flush()


if __name__ == "__main__":
    sys.exit(run_call(Path(sys.argv[1])) if sys.argv[1:] else main())
