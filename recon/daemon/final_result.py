"""The result of the present place's finished scene: written when the scene is, or when the disk takes it again."""

from __future__ import annotations

import math
import time

from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.output import Output
from splatnode.recon.daemon.places import SubmapState
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.result.snapshot import Snapshot

AGAIN_S = 60.0  # after the disk did not take it


class FinalResult:
    def __init__(self, store: Store, output: Output) -> None:
        self._store, self._output = store, output
        self._not_before_s = -math.inf  # monotonic
        self.names: frozenset[str] = frozenset()  # the keyframes whose scene was written as final

    def write(self, snapshot: Snapshot, work: IncrementalReconstruction) -> bool:
        """Writes the scene as the final one of its keyframes; False where the disk does not take it."""
        written = self._output.export(snapshot, work, self._store, SubmapState.HERE, sorted(self._store.names))
        # What is kept as final is not exported after a restart.
        self._output.save(self._store, work, final=written)
        self.names = frozenset(work.names) if written else frozenset()
        self._not_before_s = time.monotonic() + AGAIN_S
        return written

    def retry_write(self, shown: Snapshot | None, work: IncrementalReconstruction, at_once: bool) -> bool:
        """Writes a final scene that is shown and that the disk did not take; False where there is none, or not now."""
        if shown is None or not shown.final or self.names == frozenset(work.names):
            return False
        return (at_once or time.monotonic() >= self._not_before_s) and self.write(shown, work)
