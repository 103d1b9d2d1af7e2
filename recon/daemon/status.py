"""The heartbeat of the recon daemon."""

from __future__ import annotations

import enum

from splatnode.capture.messaging.wire import Header
from splatnode.recon.result.message import CameraRecord


class State(enum.Enum):
    WAITING = "waiting"  # until there are keyframes enough for a scene
    GROWING = "growing"  # adds keyframes to the scene
    REFINING = "refining"  # no keyframe is waiting: the scene is built anew from all of them and optimised
    IDLE = "idle"  # the scene is finished
    LOST = "lost"  # the last keyframes do not belong to the scene
    FULL = "full"  # keyframes cannot be stored; they wait with the sender


class ReconStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    state: State
    uptime_s: float
    scene_id: str
    keyframe: int  # number of the last one that was taken, -1 before
    queue: int  # keyframes that are stored and not in the scene yet
    keyframes: int  # that the scene is made of
    num_gaussians: int
    iterations: int
    final: bool
    verdict: str
    message: str
    bounds: str  # the widest of the scene's cameras, in words; empty where there are none
    keyframe_s: float | None  # from the last keyframe's arrival until the scene showed it
    refused: int  # malformed messages
    duplicates: int  # keyframes that came again
    rss_mb: float
    camera_moved: bool | None  # None: not watched
    moved: str  # by how much and with what certainty; empty while it stands still
    tracked: CameraRecord | None  # where the live camera is in the finished scene, if that is known
    problem: str  # what keeps the node from working as it should; empty where nothing does
