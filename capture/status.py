"""Heartbeats of the processes, how `splatnode status` tells of them, and how the last run of capture ended."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from splatnode.capture.messaging.keyframe_queue import QuarantinedKeyframe
from splatnode.capture.messaging.messages import Amount, Count, Header, Name, Text, WireError
from splatnode.capture.messaging.network import (
    CAPTURE_CONTROL,
    CAPTURE_STATUS,
    RECON_CONTROL,
    RECON_STATUS,
    Network,
    Service,
    find_captures,
    runtime_directory,
)
from splatnode.capture.messaging.pubsub import (
    Answer,
    MarkProblemsSeen,
    NoAnswer,
    Subscriber,
    ask,
)
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import StrayFile, create_own, read_own
from splatnode.capture.process.terminal import ProgressStep

HEARTBEAT_S = 1.0  # between heartbeats of capture
WAIT_S = 2.0  # for a heartbeat; a process without one is silent
POLL_S = 0.05
ANSWER_S = 3.0
NAMED = 8  # keyframes that were set aside last

Field = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z_]+\Z", max_length=40)]
# Any process's heartbeat. What a field holds is for people: messages.decode has checked that it can be shown.
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


def read_heartbeats(
    network: Network, wait_s: float = WAIT_S, only: str | None = None
) -> dict[str, dict[str, Any] | None]:
    """The next heartbeat of each process by its room's name; None for one that is silent. Raises NotAllowed.

    A capture beside others is `capture@left`, by its camera id. `only` is the one to wait for; None: all.
    """
    with contextlib.ExitStack() as listening:
        services = {_name_capture(each): CAPTURE_STATUS.select_capture(each) for each in find_captures(network) or [""]}
        services["recon"] = RECON_STATUS
        services = {room: each for room, each in services.items() if only in (None, room)}
        listeners = {room: listening.enter_context(_Listener(each, network)) for room, each in services.items()}
        found: dict[str, dict[str, Any] | None] = dict.fromkeys(listeners)
        deadline = time.monotonic() + wait_s
        while time.monotonic() < deadline and None in found.values():
            for room, subscriber in listeners.items():
                if found[room] is None and (message := subscriber.latest(POLL_S)) is not None:
                    found[room] = message.header
        return found


def _name_capture(camera_id: str) -> str:
    return f"capture@{camera_id}" if camera_id else "capture"


def parse_camera_id(room: str) -> str:
    """The camera id of a capture beside others, by its name in `read_heartbeats`' result; empty where it has none."""
    return room.partition("@")[2]


def mark_problems_seen(network: Network, rooms: list[str]) -> dict[str, str]:
    """Tells these processes that their problems have been seen; what they answered. Raises NotAllowed."""
    answers = {}
    for room in rooms:
        service = RECON_CONTROL if room == "recon" else CAPTURE_CONTROL.select_capture(parse_camera_id(room))
        try:
            answers[room] = ask(service, network, MarkProblemsSeen(), Answer, ANSWER_S).message
        except (NoAnswer, WireError) as error:
            answers[room] = str(error)
    return answers


# What `splatnode status` prints of a heartbeat, in plain words.


def _seconds(value: Any) -> str:
    return f"{value:.0f} s"


def _megabytes(value: Any) -> str:
    return f"{value:.1f} MB"


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict) and {"name", "reason"} <= value.keys():  # a keyframe that was set aside
        return f"{value['name']}: {value['reason']}"
    if isinstance(value, dict) and {"scene_id", "keyframes"} <= value.keys():
        return _format_submap(value)
    if isinstance(value, dict) and {"scene_id", "revision"} <= value.keys():
        return _format_world(value)
    if isinstance(value, dict) and value.keys() == {"doing", "done", "of", "what", "left_s"}:
        return _format_work(value)
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _format_submap(value: Mapping[str, Any]) -> str:
    """`scene-0002: left, OK, 12 photographs, 1 left out, 43 s of work, 512 MB`."""
    kept, out = value["keyframes"], value.get("left_out")
    parts = [
        f"{value.get('state')}, {value.get('verdict')}",
        f"{kept} photograph{'' if kept == 1 else 's'}",
        f"{out} left out" if out else "",
        f"{value.get('seconds', 0):.0f} s of work",
        f"{value.get('rss_mb', 0):.0f} MB",
    ]
    return f"{value['scene_id']}: {', '.join(filter(None, parts))}"


def _format_world(value: Mapping[str, Any]) -> str:
    """`scene-0001: revision 3, final; earlier poses are withdrawn: the scene was made afresh`."""
    kind, why = "provisional" if value.get("provisional") else "final", value.get("why")
    withdrawn = f"; earlier poses are withdrawn: {why}" if why else ""
    return f"{value['scene_id']}: revision {value['revision']}, {kind}{withdrawn}"


def _format_work(value: Mapping[str, Any]) -> str:
    """`refining the scene: 210 of 500 steps, about 6 s left`."""
    done, of, left_s = value["done"], value["of"], value["left_s"]
    if not (isinstance(done, int) and isinstance(of, int) and isinstance(left_s, (int, float, type(None)))):
        return str(dict(value))
    return ProgressStep(str(value["doing"]), done, of, str(value["what"]), left_s).sentence


# Field of a heartbeat -> what it is called, and how its value is written; other fields go by their names.
_WORDS: Mapping[str, tuple[str, Callable[[Any], str]]] = {
    "uptime_s": ("running for", _seconds),
    "rss_mb": ("memory", _megabytes),
    # capture's
    "pid": ("process", _format_value),
    "unusable": ("blurred, dark or copied", _format_value),
    "dropped": ("frames not readable", _format_value),
    "skipped": ("frames passed over", _format_value),
    "not_taken": ("keyframes without room", _format_value),
    "waiting": ("keyframes not at recon", _format_value),
    "waiting_mb": ("size of those", _megabytes),
    "acknowledged": ("keyframes at recon", _format_value),
    # recon's
    "scene_id": ("scene", _format_value),
    "keyframe": ("last keyframe", lambda number: f"number {number}"),
    "queue": ("keyframes waiting", _format_value),
    "num_gaussians": ("Gaussians", _format_value),
    "iterations": ("steps of refinement", _format_value),
    "bounds": ("cameras known", _format_value),
    "keyframe_s": ("last shown after", _seconds),
    "delay_s": ("delay", _seconds),
    "delay": ("because", _format_value),
    "unfinished": ("places to finish", _format_value),
    "newest_places": ("places", _format_value),
    "worlds": ("poses in", _format_value),
    "work": ("now", _format_value),
    "refused": ("refused messages", _format_value),
    "duplicates": ("keyframes come again", _format_value),
}
_NOT_PRINTED = {"session", "sequence", "mono_ns", "type", "state", "tracked"}  # they tell a user nothing
_NOTHING = ("", None, [])
_LOADING = "loading"  # recon's state in which it knows nothing yet: zeros would pass for what there is


def describe_heartbeat(room: str, fields: Mapping[str, Any]) -> list[str]:
    """Lines about the process of this room, by its heartbeat."""
    state = fields.get("state", "running")
    lines = [f"{room}: {state}"]
    for key, value in fields.items():
        if key in _NOT_PRINTED or value in _NOTHING or (key == "keyframe" and value == -1):
            continue
        if state == _LOADING and not value:
            continue
        name, written = _WORDS.get(key, (key.replace("_", " "), _format_value))
        shown = map(_format_value, value) if isinstance(value, list) else [written(value)]
        lines += [
            f"  {label:24}{each}"
            for label, each in zip(itertools.chain([name], itertools.repeat("")), shown, strict=False)
        ]
    return lines


# How capture ended: kept where its sockets were, so that `splatnode status` tells an end from a silence.

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


def begin_run(network: Network, camera_id: str = "") -> None:
    """Forgets the last run: another one has begun. Raises NetworkError, OSError."""
    _path(network, camera_id).unlink(missing_ok=True)


def end_run(network: Network, frames: int, keyframes: int, camera_id: str = "") -> None:
    """Keeps that the recording has ended now. Raises NetworkError, OSError."""
    path = _path(network, camera_id)
    path.unlink(missing_ok=True)
    with open(create_own(path), "wb") as file:
        file.write(msgspec.json.encode(LastRun(frames, keyframes, time.time())))


def last_run(network: Network, camera_id: str = "") -> LastRun | None:
    """How capture ended on this machine; None where that is not known, or it was stopped. Raises NetworkError."""
    with contextlib.suppress(OSError, StrayFile, msgspec.MsgspecError):
        return record_in(read_own(_path(network, camera_id), _MOST_BYTES), LastRun)
    return None


def _path(network: Network, camera_id: str) -> Path:
    return runtime_directory(network) / (f"{_FILE}@{camera_id}" if camera_id else _FILE)
