"""Errors for want of memory, threads or open files, whoever asked for them: no fault of what was worked on."""

from __future__ import annotations

import errno
import logging
import re
import time
from collections.abc import Callable
from typing import TypeVar

log = logging.getLogger(__name__)

SHORT_OF_MEMORY = (
    "the memory, the threads or the open files that this process may have do not suffice: end others, or raise its "
    "limits"
)
_OF_FILES = {errno.EMFILE, errno.ENFILE}  # no descriptor is free, in this process or on the whole machine
_OF_PROCESS = _OF_FILES | {errno.ENOMEM}
# PyTorch and OpenCV have no exception of their own for it.
_OF_LIBRARIES = re.compile(
    r"can't allocate memory|not enough memory|Insufficient memory|Failed to allocate|bad_alloc|can't start new thread",
    re.IGNORECASE,
)
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 2.0  # before it is tried again; doubled each time
_FILES_S, _MEMORY_S = 600.0, 10.0  # of trying. Files come back when others close theirs; what lacks memory rarely fits
_MOST_CAUSES = 10  # errors that one error has as its causes

T = TypeVar("T")


def is_shortage(error: BaseException) -> bool:
    """Whether something failed for want of memory, threads or files; of files, too, where that is the cause of `error`.

    That says nothing of what it was done with: neither a file nor its sender is to blame, and another time may do.
    """
    return _lacks_memory(error) or any(_code(each) in _OF_PROCESS for each in _list_causes(error))


def may_be_shortage(error: BaseException) -> bool:
    """As `is_shortage`, and where memory lacked for what a stranger's bytes describe: perhaps he asks for too much."""
    return is_shortage(error) or any(map(_lacks_memory, _list_causes(error)))


def raise_shortage(error: BaseException) -> None:
    """Raises `error` where it is a shortage; for code that would else hold what it worked on to be broken."""
    if is_shortage(error):
        raise error


def outlast(work: Callable[[], T], what: str, files_s: float = _FILES_S) -> T:
    """Returns what `work` does, which is repeated while this process is short of something; that is said once.

    `what` is waiting, in the words of a person. Raises the shortage where that lasts for too long: for want of files
    `files_s`, for want of memory less.
    """
    began, pause_s = time.monotonic(), _FIRST_PAUSE_S
    while True:
        try:
            return work()
        except Exception as error:
            patience_s = files_s if _lacks_files(error) else min(files_s, _MEMORY_S)
            if not may_be_shortage(error) or time.monotonic() - began > patience_s:
                raise
            if pause_s == _FIRST_PAUSE_S:
                log.warning("%s has to wait: %s", what, SHORT_OF_MEMORY)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


def _lacks_memory(error: BaseException) -> bool:
    if isinstance(error, (OSError, ValueError)):  # what a ValueError says may be a stranger's words
        return False
    return isinstance(error, MemoryError) or bool(_OF_LIBRARIES.search(str(error)))


def _lacks_files(error: BaseException) -> bool:
    return any(_code(each) in _OF_FILES for each in _list_causes(error))


def _code(error: BaseException) -> int | None:
    """Returns the system's error number; ZeroMQ's and FFmpeg's errors have one, too."""
    return getattr(error, "errno", None)


def _list_causes(error: BaseException) -> list[BaseException]:
    found, cause = [error], error.__cause__
    while cause is not None and len(found) < _MOST_CAUSES:
        found.append(cause)
        cause = cause.__cause__
    return found
