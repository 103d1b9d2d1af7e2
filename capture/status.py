"""Heartbeats of the processes, and `splatnode status`, which waits for one of each."""

from __future__ import annotations

import time
from typing import Any

from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.services import CAPTURE_STATUS, RECON_STATUS, Service
from splatnode.capture.messaging.wire import Header

HEARTBEAT_S = 1.0  # between heartbeats of capture
WAIT_S = 2.0  # for a heartbeat; a process without one is silent
POLL_S = 0.05


class CaptureStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Capture's heartbeat."""

    state: str  # starting, streaming, degraded, finished
    why: str  # of a degraded state; or that the spool, or its disk, is full or nearly so
    camera: str  # its kind
    pid: int
    uptime_s: float
    frames: int
    frames_per_second: float
    keyframes: int
    unusable: int  # frames that would have added something and were blurred, badly exposed, or copies
    dropped: int  # frames that the camera could not give
    skipped: int  # frames for which there was no time
    not_taken: int  # keyframes that found no room in the spool
    last_decision: str
    waiting: int  # keyframes that recon has not acknowledged
    waiting_mb: float
    acknowledged: int
    recon_connected: bool
    refused_messages: int
    rss_mb: float


class _Listener(Subscriber):
    """Receives a heartbeat of any process as plain fields, so that recon need not be imported to show them."""

    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(service, network, dict[str, Any])

    def _count(self, header: dict[str, Any]) -> None:
        """Counts nothing: one heartbeat is enough."""


def heartbeats(network: Network, wait_s: float = WAIT_S) -> dict[str, dict[str, Any] | None]:
    """The next heartbeat of each process by its room's name; None for one that is silent. Raises NotAllowed."""
    with _Listener(CAPTURE_STATUS, network) as capture, _Listener(RECON_STATUS, network) as recon:
        deadline = time.monotonic() + wait_s
        found: dict[str, dict[str, Any] | None] = {"capture": None, "recon": None}
        while time.monotonic() < deadline and None in found.values():
            for room, subscriber in (("capture", capture), ("recon", recon)):
                if found[room] is None and (message := subscriber.latest(POLL_S)) is not None:
                    found[room] = message.header
        return found
