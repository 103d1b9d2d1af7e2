"""Heartbeats of the processes, and `splatnode status`, which waits for one of each."""

from __future__ import annotations

import time
from typing import Annotated, Any

import msgspec

from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.commands import Answer, MarkProblemsSeen, NoAnswer, ask
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.quarantine import QuarantinedKeyframe
from splatnode.capture.messaging.services import (
    CAPTURE_CONTROL,
    CAPTURE_STATUS,
    RECON_CONTROL,
    RECON_STATUS,
    Service,
)
from splatnode.capture.messaging.values import Amount, Count, Name, Text
from splatnode.capture.messaging.wire import Header, WireError

HEARTBEAT_S = 1.0  # between heartbeats of capture
WAIT_S = 2.0  # for a heartbeat; a process without one is silent
POLL_S = 0.05
ANSWER_S = 3.0
NAMED = 8  # keyframes that were set aside last

Field = Annotated[str, msgspec.Meta(pattern="^[A-Za-z_]+$", max_length=40)]
# Any process's heartbeat. What a field holds is for people: wire.decode has checked that it can be shown.
Heartbeat = Annotated[dict[Field, Any], msgspec.Meta(max_length=64)]


class CaptureStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Capture's heartbeat."""

    state: Name  # starting, streaming, degraded, finished
    why: Text  # of a degraded state; or that the spool, or its disk, is full or nearly so
    camera: Name  # its kind
    pid: Count
    uptime_s: Amount
    frames: Count
    frames_per_second: Amount
    keyframes: Count
    unusable: Count  # frames that would have added something and were blurred, badly exposed, or copies
    dropped: Count  # frames that the camera could not give
    skipped: Count  # frames for which there was no time
    not_taken: Count  # keyframes that found no room in the spool
    last_decision: Text
    waiting: Count  # keyframes that recon has not answered
    waiting_mb: Amount
    acknowledged: Count
    recon_connected: bool
    refused_messages: Count
    set_aside: Count  # keyframes in the quarantine
    newest_set_aside: Annotated[tuple[QuarantinedKeyframe, ...], msgspec.Meta(max_length=NAMED)]
    rss_mb: Amount
    problem: Text  # what went wrong and nobody has seen yet; empty where nothing did


class _Listener(Subscriber):
    """Receives a heartbeat of any process as plain fields, so that recon need not be imported to show them."""

    def __init__(self, service: Service, network: Network) -> None:
        super().__init__(service, network, Heartbeat)

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


def mark_problems_seen(network: Network, rooms: list[str]) -> dict[str, str]:
    """Tells these processes that their problems have been seen; what they answered. Raises NotAllowed."""
    services = {"capture": CAPTURE_CONTROL, "recon": RECON_CONTROL}
    answers = {}
    for room in rooms:
        try:
            answers[room] = ask(services[room], network, MarkProblemsSeen(), Answer, ANSWER_S).message
        except (NoAnswer, WireError) as error:
            answers[room] = str(error)
    return answers
