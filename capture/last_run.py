"""How capture ended: kept where its sockets were, so that `splatnode status` tells an end from a silence."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Annotated

import msgspec

from splatnode.capture.messaging.network import Network, runtime_directory
from splatnode.capture.process.private import StrayFile, create_own, read_own
from splatnode.capture.process.records import record_in

Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]

_FILE = "capture.finished"
_MOST_BYTES = 1000


class LastRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A recording that capture read to its end, and whose keyframes recon has answered."""

    frames: Number
    keyframes: Number
    at_s: Annotated[float, msgspec.Meta(ge=0, le=1e11)]  # of time.time()

    def __str__(self) -> str:
        """`finished at 16:35:44: recon has answered all of its 25 keyframes (of 40 frames)`."""
        clock = time.strftime("%H:%M:%S", time.localtime(self.at_s))
        return (
            f"finished at {clock}: recon has answered all of its {self.keyframes} keyframes (of {self.frames} frames)"
        )


def begin_run(network: Network) -> None:
    """Forgets the last run: another one has begun. Raises NetworkError, OSError."""
    _path(network).unlink(missing_ok=True)


def end_run(network: Network, frames: int, keyframes: int) -> None:
    """Keeps that the recording has ended now. Raises NetworkError, OSError."""
    path = _path(network)
    path.unlink(missing_ok=True)
    with open(create_own(path), "wb") as file:
        file.write(msgspec.json.encode(LastRun(frames, keyframes, time.time())))


def last_run(network: Network) -> LastRun | None:
    """How capture ended on this machine; None where that is not known, or it was stopped. Raises NetworkError."""
    with contextlib.suppress(OSError, StrayFile, msgspec.MsgspecError):
        return record_in(read_own(_path(network), _MOST_BYTES), LastRun)
    return None


def _path(network: Network) -> Path:
    return runtime_directory(network) / _FILE
