"""Which poses still hold: a scene's world changes where it is made afresh, and what was told in it is withdrawn then.

A scene that grows keeps its world: its first camera stays where it is, and the others within their bounds.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np

from splatnode.capture.messaging.wire import Name, Sequential, Text
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import find_widest

MOST_WORLDS = 32  # scenes that a heartbeat tells of: those that changed last
UNBOUNDED_DEG, UNBOUNDED_SHARE = 0.5, 0.01  # by which a camera without bounds may move
REBUILT = "the scene was made afresh from all its keyframes"


class WorldRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The world of a scene. A pose in it holds as long as `revision` is the one that it was told with."""

    scene_id: Name
    revision: Sequential  # counts all changes of all worlds of this session
    provisional: bool  # it may still change
    why: Text  # it is not the one before; empty where there was none


Worlds = Annotated[tuple[WorldRecord, ...], msgspec.Meta(max_length=MOST_WORLDS)]


@dataclass(frozen=True, eq=False)
class _World:
    record: WorldRecord
    final: bool
    cameras: tuple[CameraEstimate, ...]


class WorldRevisions:
    """Numbers the worlds of all scenes. Any thread may ask and tell."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._worlds: dict[str, _World] = {}  # what changed last comes last
        self._changes = 0

    @property
    def records(self) -> tuple[WorldRecord, ...]:
        """The worlds that changed last, the newest last."""
        with self._lock:
            return tuple(world.record for world in self._worlds.values())

    def update(self, scene_id: str, snapshot: Snapshot) -> WorldRecord:
        """Notes what is shown of a scene, and tells its world."""
        provisional = not snapshot.final or snapshot.verdict.provisional
        with self._lock:
            before = self._worlds.get(scene_id)
            why = "" if before is None else _explain_change(before, snapshot)
            if before is None or why:
                return self._change(scene_id, why, provisional, snapshot.final, snapshot.cameras)
            record = msgspec.structs.replace(before.record, provisional=provisional)
            self._worlds[scene_id] = replace(before, record=record, final=snapshot.final, cameras=snapshot.cameras)
            return record

    def rebuild(self, scene_id: str, cameras: Sequence[CameraEstimate] = (), why: str = REBUILT) -> None:
        """Notes that a scene that the camera left has another world now, which is final."""
        with self._lock:
            if scene_id in self._worlds:
                self._change(scene_id, why, not cameras, bool(cameras), tuple(cameras))

    def _change(
        self, scene_id: str, why: str, provisional: bool, final: bool, cameras: tuple[CameraEstimate, ...]
    ) -> WorldRecord:
        self._changes += 1
        record = WorldRecord(scene_id, self._changes, provisional, why)
        self._worlds.pop(scene_id, None)
        self._worlds[scene_id] = _World(record, final, cameras)
        while len(self._worlds) > MOST_WORLDS:
            del self._worlds[next(iter(self._worlds))]
        return record


def _explain_change(before: _World, now: Snapshot) -> str:
    """Says why poses that were told before do not hold in what is shown now; empty where they do."""
    if now.final and (not before.final or now.cameras != before.cameras):
        return REBUILT
    if before.cameras and not now.cameras:
        return f"there is no scene any more: {now.verdict.code.value}"
    return explain_moved_cameras(before.cameras, now.cameras)


def explain_moved_cameras(before: Sequence[CameraEstimate], now: Sequence[CameraEstimate]) -> str:
    """Says which camera is gone, or moved by more than its bounds before; empty where all hold."""
    placed = {camera.name: camera.T_world_camera for camera in now}
    widest = find_widest(camera.bounds for camera in before if camera.bounds is not None)
    size = float(np.ptp([camera.T_world_camera[:3, 3] for camera in before], axis=0).max()) if before else 0.0
    turn_deg = UNBOUNDED_DEG if widest is None else widest.rotation_deg
    shift = UNBOUNDED_SHARE * size if widest is None else widest.centre
    for camera in before:
        if camera.name not in placed:
            return f"the camera of {camera.name} was removed"
        T = np.linalg.inv(camera.T_world_camera) @ placed[camera.name]
        cosine = np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
        if float(np.degrees(np.arccos(cosine))) > turn_deg or float(np.linalg.norm(T[:3, 3])) > shift:
            return f"the camera of {camera.name} moved by more than its bounds"
    return ""
