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
from splatnode.recon.daemon.config import Config
from splatnode.recon.daemon.metres import Metres
from splatnode.recon.daemon.places import Place, Places, State, described
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.result import bounds_in_words
from splatnode.recon.result.export import remove_result
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.write import finish

log = logging.getLogger(__name__)

PROVISIONAL = "-provisional"  # ends the name of a result folder whose scene is not final


@dataclass(frozen=True, eq=False)
class Published:
    """A snapshot that viewers may see, with the id of its scene."""

    snapshot: Snapshot
    scene_id: str


class Output:
    def __init__(
        self, config: Config, store: Store, publish: Callable[[Published], None], complain: Callable[[str], None]
    ) -> None:
        """`complain` is called where the disk is full: that costs a result, or time after a restart; no keyframe."""
        self._config, self._store, self._publish, self.complain = config, store, publish, complain
        self.places = Places(config.out, store.identity)
        self._metres = Metres(config.reconstruction.metric)

    def publish(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Shows what `work` has come to, in metres where these are known; what is shown."""
        measured = self._metres.of_shown(snapshot, work)
        self._publish(Published(measured, self._store.scene_id))
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
        state: State,
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
        before = self.places.cameras(place.scene_id) if judged else {}
        try:
            measured = self._metres.of_written(snapshot, work)
            finish(measured, folder, seed=recipe.seed, preset_name="live")
            if snapshot.final:
                remove_result(provisional)
            self.places.tell(_described(place, state, folder.name, snapshot, kept))
            if judged:
                self.places.link(place.scene_id, before)
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))
            return False
        known = bounds_in_words.of_cameras(measured.cameras, measured.scale)
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians), bounds=known)
        return True

    def tell(self, snapshot: Snapshot, state: State, kept: Sequence[str]) -> None:
        """Writes into the index what is known of the present place, which has no result in a folder."""
        self._write(lambda: self.places.tell(_described(self._store, state, None, snapshot, kept)))

    def parted(self, scene_id: str, names: Sequence[str]) -> None:
        """Writes into the index that these keyframes of a place that was left are one of their own."""
        self._write(lambda: self.places.tell(places.not_judged(scene_id, names)))

    def finished(self, scene_id: str) -> None:
        """Writes into the index that the camera has left a place whose scene is final."""
        self._write(lambda: self.places.finished(scene_id))

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self.complain(SHORT_OF_MEMORY if is_shortage(error) else error.strerror or str(error))


def _why(error: OSError) -> str:
    return SHORT_OF_MEMORY if is_shortage(error) else f"{error.strerror}: make room on the disk"


def _described(place: Store, state: State, folder: str | None, snapshot: Snapshot, kept: Sequence[str]) -> Place:
    ledger = place.ledger
    return described(place.scene_id, state, folder, snapshot, kept, place.dropped, ledger.follows, ledger.shared)
