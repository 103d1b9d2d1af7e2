"""The heartbeat of the recon daemon."""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec

from splatnode.capture.messaging.wire import Amount, Count, Header, Name, Sequential, Text
from splatnode.recon.daemon.worlds import Worlds
from splatnode.recon.result.message import CameraRecord


class ReconState(enum.Enum):
    LOADING = "loading"  # what an earlier process knew, after a start
    WAITING = "waiting"  # until there are keyframes enough for a scene
    GROWING = "growing"  # adds keyframes to the scene
    REFINING = "refining"  # no keyframe is waiting: the scene is built anew from all of them and optimised
    IDLE = "idle"  # the scene is finished
    LOST = "lost"  # the last keyframes do not belong to the scene
    FULL = "full"  # keyframes cannot be stored; they wait with the sender


PLACES = 8  # that a heartbeat tells of; places.json has all


class SubmapStatus(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place, as it was when it was last worked on."""

    scene_id: Name
    state: Name  # here, left, finished
    verdict: Text
    keyframes: Count  # with a camera in its scene
    left_out: Count  # keyframes without one
    seconds: Amount  # that were worked on it
    rss_mb: Amount  # memory of the process then


class WorkProgress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The work under way, how far it is, and how long the rest of it takes."""

    doing: Text  # in words
    done: Sequential  # things that were counted so far
    of: Sequential  # 0: there is nothing to count
    what: Text  # one of the things: "step", "keyframe", "scene"
    left_s: Amount | None = None  # by what was measured in this process; None: nothing tells it


class ReconStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    state: ReconState
    uptime_s: Amount
    scene_id: Name
    keyframe: Count  # number of the last one that was taken, -1 before
    queue: Count  # keyframes that are stored and not in the scene yet
    keyframes: Count  # that the scene is made of
    num_gaussians: Count
    iterations: Count
    final: bool
    verdict: Text
    message: Text
    bounds: Text  # the widest of the scene's cameras, in words; empty where there are none
    keyframe_s: Amount | None  # from the last keyframe's arrival until the scene showed it
    delay_s: Amount  # that the oldest keyframe has waited which no scene shows yet; 0: none waits
    delay: Text  # what it waits for
    unfinished: Count  # places that were left and whose scenes are not final yet
    scenes: Count  # whose cameras are judged with all evidence, of all places
    maps: Count  # that these are, joined by the chains and loops that count
    loops: Count
    newest_places: Annotated[tuple[SubmapStatus, ...], msgspec.Meta(max_length=PLACES)]
    refused: Count  # malformed messages
    duplicates: Count  # keyframes that came again
    rss_mb: Amount
    camera_moved: bool | None  # None: not watched
    moved: Text  # by how much and with what certainty; empty while it stands still
    tracked: CameraRecord | None  # where the live camera is in the finished scene, if that is known
    worlds: Worlds = ()  # of the scenes, as poses in them are told: another revision withdraws those before
    work: WorkProgress | None = None  # None: nothing is being done, or the node is older
    problem: Text  # what keeps the node from working as it should; empty where nothing does
