"""The outputs of the reconstruction: snapshots for viewers, the checkpoint, and the result folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from splatnode.capture.process.logs import event
from splatnode.recon.daemon.checkpoint import checkpoint
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import Config
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.metric import in_metres
from splatnode.recon.result import bounds_in_words
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.write import finish

log = logging.getLogger(__name__)


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
        self._config, self._store, self._publish, self._complain = config, store, publish, complain

    def publish(self, snapshot: Snapshot) -> None:
        self._publish(Published(snapshot, self._store.scene_id))

    def save(self, work: IncrementalReconstruction, final: bool) -> None:
        """Writes the checkpoint's files that a restart would else have to compute again."""
        try:
            checkpoint.save(self._store, work, final)
        except OSError as error:
            self._complain(f"the scene cannot be saved ({error.strerror}): make room on the disk")

    def export(self, snapshot: Snapshot) -> bool:
        """Writes the result folder, all of it or nothing; returns whether it was written."""
        recipe, folder = self._config.reconstruction, self._config.out / self._store.scene_id
        try:
            measured = in_metres(snapshot, recipe.metric)
            finish(measured, folder, seed=recipe.seed, preset_name="live")
        except OSError as error:
            self._complain(error.strerror or str(error))
            return False
        known = bounds_in_words.of_cameras(measured.cameras, measured.scale)
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians), bounds=known)
        return True
