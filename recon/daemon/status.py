"""The heartbeat of the recon daemon."""

from __future__ import annotations

import enum

from capture.messaging.wire import Header
from recon.daemon.scene_message import CameraRecord


class State(enum.Enum):
    WAITING = "waiting"  # for key frames enough for a scene
    GROWING = "growing"  # works key frames in
    REFINING = "refining"  # no key frame is waiting: the scene is made afresh and refined
    IDLE = "idle"  # the scene is as good as it gets
    LOST = "lost"  # the last key frames do not belong to the scene
    FULL = "full"  # key frames cannot be stored; they wait with the sender


class ReconStatus(Header, frozen=True, forbid_unknown_fields=True, kw_only=True):
    state: State
    uptime_s: float
    scene_id: str
    keyframe: int  # number of the last one that was taken, -1 before
    queue: int  # key frames that are stored and not worked in yet
    keyframes: int  # that the scene is made of
    num_gaussians: int
    iterations: int
    final: bool
    verdict: str
    message: str
    keyframe_s: float | None  # from the last key frame's arrival until the scene showed it
    refused: int  # malformed messages
    duplicates: int  # key frames that came again
    rss_mb: float
    camera_moved: bool | None  # None: not watched
    moved: str  # by how much and with what certainty; empty while it stands
    tracked: CameraRecord | None  # where the live camera is in the finished scene, if that is known
    problem: str  # what keeps the node from working as it should; empty where nothing does
