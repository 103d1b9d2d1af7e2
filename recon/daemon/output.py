"""The outputs of the reconstruction: snapshots for viewers, the checkpoint, the result folders and their index."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any
from weakref import WeakKeyDictionary

import msgspec

from splatnode.capture.frame import Frame
from splatnode.capture.messaging.messages import Numbering, WireError
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.process.system import SHORT_OF_MEMORY, is_shortage
from splatnode.capture.process.terminal import event
from splatnode.recon.daemon import WorldRevisions, checkpoint
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.free_space import (
    LOST,
    NOT_FINAL,
    GrowingScene,
    OccupancyResult,
    ProvisionalMap,
    drop_normals,
)
from splatnode.recon.daemon.submap_index import (
    SubmapIndex,
    SubmapRecord,
    SubmapState,
    make_submap_record,
    make_unverified_record,
)
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.metres import NOTHING, Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.occupancy import encode_map, make_provisional_record, no_map
from splatnode.recon.priors import Pointmap
from splatnode.recon.result import snapshot as result_snapshot
from splatnode.recon.result.export import remove_result
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import parse_frame_name

log = logging.getLogger(__name__)

# The metres of what the daemon shows and writes: what its keyframes tell of them, looked for once in each.


class MetricScaler:
    """Puts scenes into metres as `splatnode replay` does. For one thread."""

    def __init__(self, config: MetricConfig) -> None:
        self._config = config
        self._evidence: WeakKeyDictionary[Frame, Evidence] = WeakKeyDictionary()

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
            if frame not in self._evidence:
                self._evidence[frame] = gather_evidence((frame,), self._config)
        return reduce(Evidence.merge, (self._evidence[each.frame] for each in keyframes), NOTHING)


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
        metric = config.reconstruction.metric
        frame = None if metric.frame is None else parse_frame_name(metric.frame).value
        self.index = SubmapIndex(config.out, store.identity, frame)
        self._metres = MetricScaler(metric)

    def publish(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Shows what `work` has come to, in metres where these are known; what is shown."""
        measured = self._metres.scale_snapshot(snapshot, work)
        estimate = work.find_reconstruction() if self._config.localization.live else None
        mapped = self._config.occupancy.live and self._config.occupancy.provisional and not snapshot.final
        pointmaps = drop_normals(work.state.pointmaps) if mapped else None
        self._publish(PublishedSnapshot(measured, self._store.scene_id, estimate, pointmaps, shown_s=time.monotonic()))
        return measured

    def save(self, store: Store, work: IncrementalReconstruction, final: bool) -> None:
        """Writes the files of the submap's checkpoint that a restart would else have to compute again."""
        try:
            checkpoint.save(store, work, final)
        except OSError as error:
            self.complain(f"the scene cannot be saved ({_why(error)})")

    def save_fallbacks(self, store: Store, work: IncrementalReconstruction) -> None:
        """Writes which fallbacks gained nothing, so that no process tries them again."""
        try:
            checkpoint.save_fallbacks(store, work)
        except OSError as error:
            self.complain(f"what was tried cannot be saved ({_why(error)})")

    def export(
        self,
        snapshot: Snapshot,
        work: IncrementalReconstruction,
        store: Store,
        state: SubmapState,
        kept: Sequence[str],
    ) -> bool:
        """Writes the submap's result folder, all of it or nothing; returns whether it was written.

        The result of a snapshot that is not final lies in a folder of its own, named so, until a final one replaces
        it. `work` knows its keyframes, from which metres and landmarks come; `kept` are the names of the submap's.
        """
        recipe, folder = self._config.reconstruction, self._config.out / store.scene_id
        provisional = folder.with_name(folder.name + PROVISIONAL)
        folder = folder if snapshot.final else provisional
        verified = snapshot.final or not snapshot.verdict.provisional
        before = self.index.load_cameras(store.scene_id) if verified else {}
        try:
            measured = self._metres.scale_result(snapshot, work)
            write_result_folder(measured, folder, seed=recipe.seed, preset_name="live")
            if snapshot.final:
                remove_result(provisional)
            self.index.update(describe_submap(store, state, folder.name, measured, kept))
            if verified:
                self.index.link_scene(store.scene_id, before)
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))
            return False
        if store.scene_id != self._store.scene_id and verified:
            self._worlds.rebuild(store.scene_id, measured.cameras)
        known = result_snapshot.format_widest_bounds(measured.cameras, measured.scale)
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians), bounds=known)
        return True

    def update_index(self, snapshot: Snapshot, state: SubmapState, kept: Sequence[str]) -> None:
        """Writes into the index what is known of the active submap, which has no result in a folder."""
        self._write_index(lambda: self.index.update(describe_submap(self._store, state, None, snapshot, kept)))

    def add_split_submap(self, scene_id: str, names: Sequence[str]) -> None:
        """Writes into the index that these keyframes of an inactive submap are a submap of their own."""
        self._write_index(lambda: self.index.update(make_unverified_record(scene_id, names)))

    def mark_finished(self, scene_id: str) -> None:
        """Writes into the index that a submap is inactive whose scene is final."""
        self._write_index(lambda: self.index.mark_finished(scene_id))

    def _write_index(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))


def _why(error: OSError) -> str:
    return SHORT_OF_MEMORY if is_shortage(error) else f"{error.strerror}: make room on the disk"


def describe_submap(
    store: Store, state: SubmapState, folder: str | None, snapshot: Snapshot, kept: Sequence[str]
) -> SubmapRecord:
    """Describes the submap of this checkpoint as the snapshot shows it; `kept` are the names of its keyframes."""
    ledger = store.ledger
    return make_submap_record(
        store.scene_id, state, folder, snapshot, kept, store.frames_dropped, ledger.follows, ledger.shared
    )


# What others are told of the map: it is taken back before anything is shown that it is not of.


NO_SCENE = "none"  # in place of a scene's id


class OccupancyPublisher:
    """Says what is known of free space, each thing once. For one thread, that which shows scenes."""

    def __init__(self, server: StateServer, numbering: Numbering) -> None:
        """`numbering`: of the maps alone, in the session of the scenes."""
        self._server, self._numbering = server, numbering
        self._sent: tuple[str, OccupancyResult | ProvisionalMap | str] | None = None  # scene, and its map or why not

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
        if (scene_id, now) == self._sent:
            return
        self._sent = scene_id, now
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
