"""The outputs of the reconstruction: snapshots for viewers, the checkpoint, the result folders and their index."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from splatnode.capture.process.logs import event
from splatnode.capture.process.memory_shortage import SHORT_OF_MEMORY, is_shortage
from splatnode.recon.daemon import places
from splatnode.recon.daemon.checkpoint import checkpoint
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.metres import MetricScaler
from splatnode.recon.daemon.places import SubmapIndex, SubmapRecord, SubmapState, make_submap_record
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.result import bounds_in_words
from splatnode.recon.result.export import remove_result
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.write import write_result_folder

log = logging.getLogger(__name__)

PROVISIONAL = "-provisional"  # ends the name of a result folder whose scene is not final


@dataclass(frozen=True, eq=False)
class PublishedSnapshot:
    """A snapshot that viewers may see, with the id of its scene."""

    snapshot: Snapshot
    scene_id: str


class Output:
    def __init__(
        self,
        config: DaemonConfig,
        store: Store,
        publish: Callable[[PublishedSnapshot], None],
        complain: Callable[[str], None],
    ) -> None:
        """`complain` is called where the disk is full: that costs a result, or time after a restart; no keyframe."""
        self._config, self._store, self._publish, self.complain = config, store, publish, complain
        self.places = SubmapIndex(config.out, store.identity)
        self._metres = MetricScaler(config.reconstruction.metric)

    def publish(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Shows what `work` has come to, in metres where these are known; what is shown."""
        measured = self._metres.scale_snapshot(snapshot, work)
        self._publish(PublishedSnapshot(measured, self._store.scene_id))
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
            self.places.update(_make_submap_record(place, state, folder.name, snapshot, kept))
            if judged:
                self.places.link_scene(place.scene_id, before)
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))
            return False
        known = bounds_in_words.format_widest_bounds(measured.cameras, measured.scale)
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians), bounds=known)
        return True

    def update_index(self, snapshot: Snapshot, state: SubmapState, kept: Sequence[str]) -> None:
        """Writes into the index what is known of the present place, which has no result in a folder."""
        self._write_index(lambda: self.places.update(_make_submap_record(self._store, state, None, snapshot, kept)))

    def add_split_submap(self, scene_id: str, names: Sequence[str]) -> None:
        """Writes into the index that these keyframes of a place that was left are one of their own."""
        self._write_index(lambda: self.places.update(places.make_unverified_record(scene_id, names)))

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
