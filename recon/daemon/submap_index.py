"""The index of submaps, places.json: what became of each submap and its images, the pose graph, and the maps.

`recon.result.submap_index` reads it for those who show or merge what a node has written.
"""

from __future__ import annotations

import enum
import logging
from collections.abc import Collection, Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.process.config import record_in
from splatnode.capture.process.system import raise_shortage, resident_mb
from splatnode.capture.process.text import guard_untrusted
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.daemon import SubmapStatus
from splatnode.recon.daemon.pose_graph import (
    Cameras,
    EdgeKind,
    PoseGraphEdge,
    SubmapPose,
    make_chain_edge,
    optimize_pose_graph,
    transfer_edge,
)
from splatnode.recon.result.export import SceneFileError, read_cameras, write_files
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Code

log = logging.getLogger(__name__)

FILE = "places.json"


class SubmapState(enum.Enum):
    HERE = "here"  # the camera is there: the scene may grow
    LEFT = "left"  # the camera went on: the scene is finished when no keyframe waits
    FINISHED = "finished"  # the scene is final


class DroppedRecord(msgspec.Struct, frozen=True):
    name: str
    reason: str


class SubmapRecord(msgspec.Struct, frozen=True):
    """A submap, as it was when it was last looked at."""

    scene_id: str
    state: SubmapState
    folder: str | None  # with its result, in that of places.json; None: there is none
    verdict: str
    message: str
    publishable: bool
    provisional: bool
    num_gaussians: int
    frames_used: tuple[str, ...]  # that have a camera in the scene
    frames_dropped: tuple[DroppedRecord, ...]  # all others that were taken there, and why they have none
    follows: str = ""  # the scene that it goes on from; empty: it began anew
    shared: tuple[str, ...] = ()  # the photographs that both have
    # Whether all evidence was weighed and the cameras may be published; the scene may be a draft
    verified: bool = msgspec.field(default=False, name="judged")
    seconds: float = 0.0  # that were worked on it, by the process that wrote this
    rss_mb: float = 0.0  # memory of that process then

    @property
    def status(self) -> SubmapStatus:
        """As a heartbeat tells it."""
        kept, out = len(self.frames_used), len(self.frames_dropped)
        return SubmapStatus(self.scene_id, self.state.value, self.verdict, kept, out, self.seconds, self.rss_mb)


def make_submap_record(
    scene_id: str,
    state: SubmapState,
    folder: str | None,
    snapshot: Snapshot,
    kept: Sequence[str],
    dropped: Collection[DroppedFrame],
    follows: str = "",
    shared: Sequence[str] = (),
) -> SubmapRecord:
    """The submap as the snapshot shows it. `kept` are the names of its keyframes; others that came were `dropped`.

    It `follows` a scene, if any, with which it has the `shared` photographs in common.
    """
    verdict = snapshot.verdict
    used = tuple(camera.name for camera in snapshot.cameras)
    why = "it has no camera in the scene" if used else f"there is no scene: {verdict.code.value}"
    unplaced = (DroppedRecord(name, why) for name in kept if name not in used)
    return SubmapRecord(
        scene_id=scene_id,
        state=state,
        folder=folder,
        verdict=verdict.code.value,
        message=verdict.message,
        publishable=verdict.publishable,
        provisional=verdict.provisional or not snapshot.final,
        num_gaussians=len(snapshot.gaussians),
        verified=verdict.publishable and not verdict.provisional,
        frames_used=used,
        frames_dropped=(*unplaced, *(DroppedRecord(frame.name, frame.reason) for frame in dropped)),
        follows=follows,
        shared=tuple(shared),
        seconds=round(sum(snapshot.seconds[stage] for stage in snapshot.seconds.keys() - {"wait", "total"}), 1),
        rss_mb=round(resident_mb()),
    )


def make_unverified_record(scene_id: str, names: Sequence[str]) -> SubmapRecord:
    """An inactive submap, of whose keyframes nothing is known yet."""
    return SubmapRecord(
        scene_id=scene_id,
        state=SubmapState.LEFT,
        folder=None,
        verdict=Code.UNDETERMINED.value,
        message="This place is judged when there is time for it.",
        publishable=False,
        provisional=True,
        num_gaussians=0,
        frames_used=(),
        frames_dropped=tuple(DroppedRecord(name, "its place is not judged yet") for name in names),
    )


class _Index(msgspec.Struct, frozen=True):
    checkpoint: str  # identity of the one that the submaps belong to
    submaps: tuple[SubmapRecord, ...] = msgspec.field(default=(), name="places")
    links: tuple[PoseGraphEdge, ...] = ()  # between scenes that are verified
    poses: tuple[SubmapPose, ...] = ()  # of these scenes, by all links together
    frame: str | None = None  # of reference, that the node was asked for


def _describe_frame(frame: str | None) -> str:
    return f"the frame {frame}" if frame else "the default frame"


class SubmapIndex:
    """The file, and what is in it."""

    def __init__(self, out: Path, checkpoint: str, frame: str | None = None) -> None:
        """Goes on with the submaps of an earlier process that had the same `checkpoint`.

        An index that cannot be read begins anew. The log tells where that process was asked for another `frame` of
        reference: files that are written from now on are in this one.
        """
        self._path, self._index = out / FILE, _Index(checkpoint, frame=frame)
        try:
            with guard_untrusted(SceneFileError):
                found = record_in(read_json_file(self._path), _Index)
            if found.checkpoint == checkpoint:
                self._index = found
                self._change_frame(frame)
        except FileNotFoundError:
            pass
        except (OSError, SceneFileError) as error:
            raise_shortage(error)
            log.warning("the index of submaps begins anew: %s", error)

    def _change_frame(self, frame: str | None) -> None:
        before = self._index.frame
        if frame == before:
            return
        if self._index.submaps:
            log.warning(
                "until now results were in %s; from now on they are in %s: give %s to keep them in one frame",
                _describe_frame(before), _describe_frame(frame), f"--frame {before}" if before else "no --frame",
            )  # fmt: skip
        self._index = msgspec.structs.replace(self._index, frame=frame)

    def select_newest(self, most: int) -> Sequence[SubmapRecord]:
        """The submaps that were found last, at most so many."""
        return self._index.submaps[-most:]

    def find_scenes(self, name: str) -> list[str]:
        """The ids of the scenes that have a camera of this photograph."""
        return [submap.scene_id for submap in self._index.submaps if name in submap.frames_used]

    def find_frame_set(self, scene_id: str, name: str, tolerance_s: float) -> list[str]:
        """The photographs of a scene that several cameras took together with this one, which is among them."""
        cameras = self._read_cameras(scene_id)
        timed = [(each.name, each.camera_id, each.captured_at) for each in cameras if each.captured_at is not None]
        sets = (list(each.names.values()) for each in form_frame_sets(timed, tolerance_s))
        return next((names for names in sets if name in names), [name])

    def mark_finished(self, scene_id: str) -> None:
        """Says that the camera has left a submap whose scene is final. Raises ResultWriteError."""
        for submap in (submap for submap in self._index.submaps if submap.scene_id == scene_id):
            self.update(msgspec.structs.replace(submap, state=SubmapState.FINISHED))

    def update(self, submap: SubmapRecord) -> None:
        """Writes the index with what is known of this submap now. Raises ResultWriteError."""
        submaps = {each.scene_id: each for each in self._index.submaps} | {submap.scene_id: submap}
        self._write(msgspec.structs.replace(self._index, submaps=tuple(submaps.values())))

    @property
    def links(self) -> tuple[PoseGraphEdge, ...]:
        """Between scenes that are verified; those that are retracted say why."""
        return self._index.links

    @property
    def poses(self) -> tuple[SubmapPose, ...]:
        """Poses of the verified scenes, in the maps that they belong to."""
        return self._index.poses

    def link_scene(self, scene_id: str, before: Cameras) -> None:
        """Writes how this verified scene, which was just written, lies to those that it goes on from, and others.

        Its loops stay where its cameras lie to each other as they did `before`. Raises ResultWriteError.
        """
        now, verified = self.load_cameras(scene_id), self._publishable_submaps
        links = [each for each in self._index.links if scene_id not in (each.scene, each.other)]
        for submap in verified.values():
            follows = verified.get(submap.follows)
            if follows is not None and scene_id in (submap.scene_id, follows.scene_id):
                shared = [
                    {name: T for name, T in self.load_cameras(each.scene_id).items() if name in submap.shared}
                    for each in (follows, submap)
                ]
                found = make_chain_edge(follows.scene_id, submap.scene_id, *shared)
                links += [] if found is None else [found]
        for loop in self._index.links:
            if loop.kind is EdgeKind.LOOP and scene_id in (loop.scene, loop.other):
                found = transfer_edge(loop, scene_id, before, now)
                links += [] if found is None else [found]
        self._write_links(links)

    def add_loops(self, scene_id: str, loops: Collection[PoseGraphEdge]) -> None:
        """Writes these as the loops by which the scene was found to lie where others do. Raises ResultWriteError."""
        others = [each for each in self._index.links if each.kind is not EdgeKind.LOOP or each.other != scene_id]
        self._write_links([*others, *loops])

    @property
    def _publishable_submaps(self) -> dict[str, SubmapRecord]:
        """Final scenes are, also those of an index that says nothing of it."""
        submaps = self._index.submaps
        return {each.scene_id: each for each in submaps if each.verified or (each.publishable and not each.provisional)}

    def _write_links(self, links: Sequence[PoseGraphEdge]) -> None:
        """Those between scenes that are verified: one that was may be none any more."""
        verified = self._publishable_submaps
        given = [each for each in links if {each.scene, each.other} <= verified.keys()]
        graph = optimize_pose_graph(list(verified), given)
        for each, before in zip(graph.links, given, strict=True):
            if each.retracted and not before.retracted:
                log.warning("the loop from %s to %s does not count: %s", each.scene, each.other, each.retracted)
        self._write(msgspec.structs.replace(self._index, links=graph.links, poses=graph.poses))

    def load_cameras(self, scene_id: str) -> dict[str, npt.NDArray[np.float64]]:
        """T_world_camera (4, 4) by the names of the photographs, as the scene was written; none that cannot be read."""
        return {camera.name: camera.T_world_camera for camera in self._read_cameras(scene_id)}

    def _read_cameras(self, scene_id: str) -> Sequence[CameraEstimate]:
        """The cameras of a scene as it was written; none where it was refused, or they cannot be read."""
        submap = next((each for each in self._index.submaps if each.scene_id == scene_id), None)
        if submap is None or submap.folder is None or not submap.publishable:
            return ()
        try:
            return read_cameras(self._path.parent / submap.folder / "cameras.json")
        except (OSError, SceneFileError) as error:
            raise_shortage(error)
            log.warning("the cameras of %s cannot be read: %s", scene_id, error)
            return ()

    def _write(self, index: _Index) -> None:
        if index != self._index:
            write_files(self._path.parent, {self._path.name: json_bytes(msgspec.to_builtins(index))})
            self._index = index
