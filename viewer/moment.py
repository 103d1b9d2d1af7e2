"""Moments: what there was to see at one instant, and the bounded memory of them that the time axis goes through."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from recon.snapshot import CameraEstimate, Snapshot

MEMORY_BYTES = 256_000_000


@dataclass(frozen=True, eq=False)
class Moment:
    """A snapshot as it reached the viewer. Its `images` may be of any size, and may lack some cameras."""

    snapshot: Snapshot
    received_s: float  # monotonic clock of the viewer
    tracked: CameraEstimate | None = None  # where the live camera is just now; None: not known
    scene_id: str = ""  # another one is another place: a viewpoint does not carry over

    @property
    def num_bytes(self) -> int:
        gaussians = self.snapshot.gaussians
        arrays = [getattr(gaussians, field.name) for field in fields(gaussians)]
        return sum(array.nbytes for array in [*arrays, *self.snapshot.images.values()])


History = tuple[Moment, ...]  # oldest first


def remembered(history: History, moment: Moment, memory_bytes: int = MEMORY_BYTES) -> History:
    """The history with `moment` as its newest, thinned until it fits into `memory_bytes`.

    What goes first is the moment whose neighbours are closest together in time, so that the whole time axis stays
    covered. The first and the newest moment always stay.
    """
    kept = [*history, moment]
    while len(kept) > 2 and sum(one.num_bytes for one in kept) > memory_bytes:
        gaps = [after.received_s - before.received_s for before, after in zip(kept, kept[2:], strict=False)]
        del kept[1 + int(np.argmin(gaps))]
    return tuple(kept)
