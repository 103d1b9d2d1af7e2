"""Where a reconstruction goes: to those who look on, into the checkpoint, and as a result into a folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from splatnode.capture.process.logs import event
from splatnode.recon.daemon.checkpoint import checkpoint
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import Config
from splatnode.recon.daemon.reconstruction import LiveReconstruction
from splatnode.recon.metric import in_metres
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.write import finish

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Shown:
    """What the world may see."""

    snapshot: Snapshot
    scene_id: str


class Output:
    def __init__(
        self, config: Config, store: Store, publish: Callable[[Shown], None], complain: Callable[[str], None]
    ) -> None:
        """A disk that takes nothing costs time after a restart, or a result: `complain` is told, and all goes on."""
        self._config, self._store, self._publish, self._complain = config, store, publish, complain

    def show(self, work: LiveReconstruction, final: bool = False) -> Snapshot:
        snapshot = work.snapshot(final)
        self._publish(Shown(snapshot, self._store.scene_id))
        return snapshot

    def save(self, work: LiveReconstruction, final: bool) -> None:
        """What could be made anew from the keyframes."""
        try:
            checkpoint.save(self._store, work, final)
        except OSError as error:
            self._complain(f"the scene cannot be kept ({error.strerror}): make room on the disk")

    def export(self, snapshot: Snapshot) -> bool:
        """The result folder, whole or not at all; whether it is there."""
        recipe, folder = self._config.reconstruction, self._config.out / self._store.scene_id
        try:
            finish(in_metres(snapshot, recipe.metric), folder, seed=recipe.seed, preset_name="live")
        except OSError as error:
            self._complain(str(error))
            return False
        event(log, logging.INFO, "exported", folder=folder, gaussians=len(snapshot.gaussians))
        return True
