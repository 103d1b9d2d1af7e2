"""The outputs of the reconstruction: snapshots for viewers, the checkpoint, the result folders and their index."""

from __future__ import annotations

import enum
import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.messages import Numbering, WireError
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.process.config import record_in
from splatnode.capture.process.system import SHORT_OF_MEMORY, is_shortage, raise_shortage, resident_mb
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import guard_untrusted
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.daemon import SubmapStatus, WorldRevisions, checkpoint
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.free_space import GrowingScene, ProvisionalMap, drop_normals
from splatnode.recon.daemon.pose_graph import (
    Cameras,
    EdgeKind,
    PoseGraphEdge,
    SubmapPose,
    make_chain_edge,
    optimize_pose_graph,
    transfer_edge,
)
from splatnode.recon.daemon.relocalization import LOST, NOT_FINAL, OccupancyResult
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.metres import NOTHING, Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.occupancy import encode_map, make_provisional_record, no_map
from splatnode.recon.priors import Pointmap
from splatnode.recon.result import snapshot as result_snapshot
from splatnode.recon.result.export import SceneFileError, read_cameras, remove_result, write_files
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Code

# places.json: all places that the node has seen, what became of each, and of each photograph that was taken there.

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
    """A place, as it was when it was last looked at."""

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
    judged: bool = False  # whether all evidence was weighed and the cameras may be published; the scene may be a draft
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
    """The place as the snapshot shows it. `kept` are the names of its keyframes; others that came were `dropped`.

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
        judged=verdict.publishable and not verdict.provisional,
        frames_used=used,
        frames_dropped=(*unplaced, *(DroppedRecord(frame.name, frame.reason) for frame in dropped)),
        follows=follows,
        shared=tuple(shared),
        seconds=round(sum(snapshot.seconds[stage] for stage in snapshot.seconds.keys() - {"wait", "total"}), 1),
        rss_mb=round(resident_mb()),
    )


def make_unverified_record(scene_id: str, names: Sequence[str]) -> SubmapRecord:
    """A place that was left, of whose keyframes nothing is known yet."""
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
    checkpoint: str  # identity of the one that the places belong to
    places: tuple[SubmapRecord, ...] = ()
    links: tuple[PoseGraphEdge, ...] = ()  # between scenes that are judged
    poses: tuple[SubmapPose, ...] = ()  # of these scenes, by all links together


class SubmapIndex:
    """The file, and what is in it."""

    def __init__(self, out: Path, checkpoint: str) -> None:
        """Goes on with the places of an earlier process that had the same `checkpoint`.

        An index that cannot be read begins anew.
        """
        self._path, self._index = out / FILE, _Index(checkpoint)
        try:
            with guard_untrusted(SceneFileError):
                found = record_in(read_json_file(self._path), _Index)
            if found.checkpoint == checkpoint:
                self._index = found
        except FileNotFoundError:
            pass
        except (OSError, SceneFileError) as error:
            raise_shortage(error)
            log.warning("the index of places begins anew: %s", error)

    def select_newest(self, most: int) -> Sequence[SubmapRecord]:
        """The places that were found last, at most so many."""
        return self._index.places[-most:]

    def find_scenes(self, name: str) -> list[str]:
        """The ids of the scenes that have a camera of this photograph."""
        return [place.scene_id for place in self._index.places if name in place.frames_used]

    def find_frame_set(self, scene_id: str, name: str, tolerance_s: float) -> list[str]:
        """The photographs of a scene that several cameras took together with this one, which is among them."""
        cameras = self._read_cameras(scene_id)
        timed = [(each.name, each.camera_id, each.captured_at) for each in cameras if each.captured_at is not None]
        sets = (list(each.names.values()) for each in form_frame_sets(timed, tolerance_s))
        return next((names for names in sets if name in names), [name])

    def mark_finished(self, scene_id: str) -> None:
        """Says that the camera has left a place whose scene is final. Raises ResultWriteError."""
        for place in (place for place in self._index.places if place.scene_id == scene_id):
            self.update(msgspec.structs.replace(place, state=SubmapState.FINISHED))

    def update(self, place: SubmapRecord) -> None:
        """Writes the index with what is known of this place now. Raises ResultWriteError."""
        places = {each.scene_id: each for each in self._index.places} | {place.scene_id: place}
        self._write(msgspec.structs.replace(self._index, places=tuple(places.values())))

    @property
    def links(self) -> tuple[PoseGraphEdge, ...]:
        """Between scenes that are judged; those that are retracted say why."""
        return self._index.links

    @property
    def poses(self) -> tuple[SubmapPose, ...]:
        """Poses of the verified scenes, in the maps that they belong to."""
        return self._index.poses

    def link_scene(self, scene_id: str, before: Cameras) -> None:
        """Writes how this scene, which is judged and was just written, lies to those that it goes on from, and others.

        Its loops stay where its cameras lie to each other as they did `before`. Raises ResultWriteError.
        """
        now, judged = self.load_cameras(scene_id), self._publishable_submaps
        links = [each for each in self._index.links if scene_id not in (each.scene, each.other)]
        for place in judged.values():
            follows = judged.get(place.follows)
            if follows is not None and scene_id in (place.scene_id, follows.scene_id):
                shared = [
                    {name: T for name, T in self.load_cameras(each.scene_id).items() if name in place.shared}
                    for each in (follows, place)
                ]
                found = make_chain_edge(follows.scene_id, place.scene_id, *shared)
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
        places = self._index.places
        return {each.scene_id: each for each in places if each.judged or (each.publishable and not each.provisional)}

    def _write_links(self, links: Sequence[PoseGraphEdge]) -> None:
        """Those between scenes that are judged: one that was may be none any more."""
        judged = self._publishable_submaps
        given = [each for each in links if {each.scene, each.other} <= judged.keys()]
        graph = optimize_pose_graph(list(judged), given)
        for each, before in zip(graph.links, given, strict=True):
            if each.retracted and not before.retracted:
                log.warning("the loop from %s to %s does not count: %s", each.scene, each.other, each.retracted)
        self._write(msgspec.structs.replace(self._index, links=graph.links, poses=graph.poses))

    def load_cameras(self, scene_id: str) -> dict[str, npt.NDArray[np.float64]]:
        """T_world_camera (4, 4) by the names of the photographs, as the scene was written; none that cannot be read."""
        return {camera.name: camera.T_world_camera for camera in self._read_cameras(scene_id)}

    def _read_cameras(self, scene_id: str) -> Sequence[CameraEstimate]:
        """The cameras of a scene as it was written; none where it was refused, or they cannot be read."""
        place = next((each for each in self._index.places if each.scene_id == scene_id), None)
        if place is None or place.folder is None or not place.publishable:
            return ()
        try:
            return read_cameras(self._path.parent / place.folder / "cameras.json")
        except (OSError, SceneFileError) as error:
            raise_shortage(error)
            log.warning("the cameras of %s cannot be read: %s", scene_id, error)
            return ()

    def _write(self, index: _Index) -> None:
        if index != self._index:
            write_files(self._path.parent, {self._path.name: json_bytes(msgspec.to_builtins(index))})
            self._index = index


# The outputs of the reconstruction: snapshots for viewers, the checkpoint, the result folders and their index.

# The metres of what the daemon shows and writes: what its keyframes tell of them, looked for once in each.


class MetricScaler:
    """Puts scenes into metres as `splatnode replay` does. For one thread."""

    def __init__(self, config: MetricConfig) -> None:
        self._config = config
        self._told: WeakKeyDictionary[Frame, Evidence] = WeakKeyDictionary()

    def scale_snapshot(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Returns the snapshot for viewers, in metres where a scale source is available, else unchanged.

        A network, which takes seconds, is asked about a final scene alone. Landmarks are gathered for a final scene, by
        which it is measured in its files, too; for others where stereo pairs or depth images are measured by them.
        """
        evidence = self.collect_evidence(work.graph.keyframes)
        config = self._config if snapshot.final else msgspec.structs.replace(self._config, depth_network=False)
        came = evidence.tracked or evidence.motions
        if evidence.pairs or evidence.depths or (snapshot.final and (config != MetricConfig() or came)):
            snapshot = add_landmarks(snapshot, work.find_reconstruction())
        measured = apply_metric_scale(snapshot, config, evidence)
        return measured if snapshot.final else replace(measured, landmarks=None)

    def scale_result(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Returns the snapshot for a result folder, with its estimate's landmarks if still known."""
        with_all = add_landmarks(snapshot, work.find_reconstruction())
        return apply_metric_scale(with_all, self._config, self.collect_evidence(work.graph.keyframes))

    def collect_evidence(self, keyframes: Sequence[Keyframe]) -> Evidence:
        """Collects the keyframes' scale evidence: markers, poses, motions, gravity, mounts and so on."""
        for frame in (each.frame for each in keyframes):
            if frame not in self._told:
                self._told[frame] = gather_evidence((frame,), self._config)
        return reduce(Evidence.merge, (self._told[each.frame] for each in keyframes), NOTHING)


PROVISIONAL = "-provisional"  # ends the name of a result folder whose scene is not final


@dataclass(frozen=True, eq=False)
class PublishedSnapshot:
    """A snapshot that viewers may see, with the id of its scene."""

    snapshot: Snapshot
    scene_id: str
    estimate: Reconstruction | None = None  # of its keyframes, where images are located in it
    pointmaps: Mapping[str, Pointmap] | None = None  # by keyframe, where it is mapped while it grows
    shown_s: float = 0.0  # monotonic


class Output:
    def __init__(
        self,
        config: DaemonConfig,
        store: Store,
        publish: Callable[[PublishedSnapshot], None],
        complain: Callable[[str], None],
        worlds: WorldRevisions | None = None,
    ) -> None:
        """`complain` is called where the disk is full: that costs a result, or time after a restart; no keyframe."""
        self._worlds = worlds or WorldRevisions()
        self._config, self._store, self._publish, self.complain = config, store, publish, complain
        self.places = SubmapIndex(config.out, store.identity)
        self._metres = MetricScaler(config.reconstruction.metric)

    def publish(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Shows what `work` has come to, in metres where these are known; what is shown."""
        measured = self._metres.scale_snapshot(snapshot, work)
        estimate = work.find_reconstruction() if self._config.localization.live else None
        mapped = self._config.occupancy.live and self._config.occupancy.provisional and not snapshot.final
        pointmaps = drop_normals(work.state.pointmaps) if mapped else None
        self._publish(PublishedSnapshot(measured, self._store.scene_id, estimate, pointmaps, shown_s=time.monotonic()))
        return measured

    def save(self, place: Store, work: IncrementalReconstruction, final: bool) -> None:
        """Writes the files of the place's checkpoint that a restart would else have to compute again."""
        try:
            checkpoint.save(place, work, final)
        except OSError as error:
            self.complain(f"the scene cannot be saved ({_why(error)})")

    def save_fallbacks(self, place: Store, work: IncrementalReconstruction) -> None:
        """Writes which fallbacks gained nothing, so that no process tries them again."""
        try:
            checkpoint.save_fallbacks(place, work)
        except OSError as error:
            self.complain(f"what was tried cannot be saved ({_why(error)})")

    def export(
        self,
        snapshot: Snapshot,
        work: IncrementalReconstruction,
        place: Store,
        state: SubmapState,
        kept: Sequence[str],
    ) -> bool:
        """Writes the place's result folder, all of it or nothing; returns whether it was written.

        The result of a snapshot that is not final lies in a folder of its own, named so, until a final one replaces
        it. `work` knows its keyframes, from which metres and landmarks come; `kept` are the names of the place's.
        """
        recipe, folder = self._config.reconstruction, self._config.out / place.scene_id
        provisional = folder.with_name(folder.name + PROVISIONAL)
        folder = folder if snapshot.final else provisional
        judged = snapshot.final or not snapshot.verdict.provisional
        before = self.places.load_cameras(place.scene_id) if judged else {}
        try:
            measured = self._metres.scale_result(snapshot, work)
            write_result_folder(measured, folder, seed=recipe.seed, preset_name="live")
            if snapshot.final:
                remove_result(provisional)
            self.places.update(_make_submap_record(place, state, folder.name, measured, kept))
            if judged:
                self.places.link_scene(place.scene_id, before)
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))
            return False
        if place.scene_id != self._store.scene_id and judged:
            self._worlds.rebuild(place.scene_id, measured.cameras)
        known = result_snapshot.format_widest_bounds(measured.cameras, measured.scale)
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians), bounds=known)
        return True

    def update_index(self, snapshot: Snapshot, state: SubmapState, kept: Sequence[str]) -> None:
        """Writes into the index what is known of the present place, which has no result in a folder."""
        self._write_index(lambda: self.places.update(_make_submap_record(self._store, state, None, snapshot, kept)))

    def add_split_submap(self, scene_id: str, names: Sequence[str]) -> None:
        """Writes into the index that these keyframes of a place that was left are one of their own."""
        self._write_index(lambda: self.places.update(make_unverified_record(scene_id, names)))

    def mark_finished(self, scene_id: str) -> None:
        """Writes into the index that the camera has left a place whose scene is final."""
        self._write_index(lambda: self.places.mark_finished(scene_id))

    def _write_index(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))


def _why(error: OSError) -> str:
    return SHORT_OF_MEMORY if is_shortage(error) else f"{error.strerror}: make room on the disk"


def _make_submap_record(
    place: Store, state: SubmapState, folder: str | None, snapshot: Snapshot, kept: Sequence[str]
) -> SubmapRecord:
    ledger = place.ledger
    return make_submap_record(
        place.scene_id, state, folder, snapshot, kept, place.frames_dropped, ledger.follows, ledger.shared
    )


# What others are told of the map: it is taken back before anything is shown that it is not of.


NO_SCENE = "none"  # in place of a scene's id


class OccupancyPublisher:
    """Says what is known of free space, each thing once. For one thread, that which shows scenes."""

    def __init__(self, server: StateServer, numbering: Numbering) -> None:
        """`numbering`: of the maps alone, in the session of the scenes."""
        self._server, self._numbering = server, numbering
        self._told: tuple[str, OccupancyResult | ProvisionalMap | str] | None = None  # scene, and its map or why not

    def serve(self) -> None:
        """Replies to who asks."""
        self._server.serve(0)

    def publish(
        self,
        found: OccupancyResult | str,
        shown: PublishedSnapshot | None,
        sequence: int,
        growing: ProvisionalMap | None = None,
    ) -> None:
        """`found` is the map of a scene, or why there is none; `shown` what viewers see, by message `sequence`.

        `growing` is the map of a scene that grows, in the world of what viewers see.
        """
        scene_id = NO_SCENE if shown is None else shown.scene_id
        now = _match_shown_scene(found, shown, growing)
        if (scene_id, now) == self._told:
            return
        self._told = scene_id, now
        numbers = self._numbering.next()
        if not isinstance(now, str):
            now = self._send_map(now, scene_id, sequence, numbers)
        if now:
            self._server.publish(no_map(scene_id, now, numbers))

    def _send_map(
        self, mapped: OccupancyResult | ProvisionalMap, scene_id: str, sequence: int, numbers: dict[str, Any]
    ) -> str:
        """Sends a map; why not, where there is none to be sent."""
        if mapped.occupancy is None:
            return mapped.why
        try:
            of, growing = mapped.of, None
            if isinstance(of, GrowingScene):
                sequence = of.sequence
                growing = make_provisional_record(of.revision, of.snapshot.cameras)
            self._server.publish(*encode_map(mapped.occupancy, scene_id, sequence, numbers, growing))
        except WireError as error:
            log.warning("the map of %s cannot be sent: %s", scene_id, error)
            return f"the map is too large: {error}; choose a larger occupancy.voxel"
        return ""


def _match_shown_scene(
    found: OccupancyResult | str, shown: PublishedSnapshot | None, growing: ProvisionalMap | None
) -> OccupancyResult | ProvisionalMap | str:
    """The map if it is of what viewers see, or grows with it; else why there is none."""
    if shown is not None and not shown.snapshot.verdict.publishable:
        verdict = shown.snapshot.verdict
        return f"there is no scene: {verdict.code.value}. {verdict.message}"
    if isinstance(found, str):
        return growing if growing is not None and found != LOST else found
    return found if shown is not None and found.of.snapshot is shown.snapshot else NOT_FINAL
