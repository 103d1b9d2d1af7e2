"""What a daemon's failure means to who started it: before it was ready, and after."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from splatnode.capture.process.memory_shortage import is_shortage
from splatnode.capture.process.service_manager import ServiceManager

_HELPED_BY_A_START = (69, 75)  # exit codes: the camera is not there, another process is still ending


class FailedAfterReady(RuntimeError):
    """A process failed after it was ready: no fault of its configuration, and another start may help."""

    exit_code = 70


@contextlib.contextmanager
def wrap_late_errors(manager: ServiceManager) -> Iterator[None]:
    """Once the process is ready, an error in here is no longer one of its configuration, whatever it was raised for.

    The exit codes that the units take as the call for a human, 2 and 77, are those of a start that failed.
    """
    try:
        yield
    except Exception as error:
        helped = is_shortage(error) or getattr(error, "exit_code", None) in _HELPED_BY_A_START
        if not manager.is_ready or helped:
            raise
        raise FailedAfterReady(f"{type(error).__name__}: {error}") from error
