"""The methods that a benchmark compares, by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec

from capture.frame import Frame
from recon.config import preset
from recon.pipeline import reconstruct
from recon.snapshot import Snapshot


def by_preset(frames: Sequence[Frame], method: str, seed: int) -> Iterator[Snapshot]:
    """Runs the preset called `method`. At module level, so that a fresh process can be told to run it."""
    return reconstruct(frames, msgspec.structs.replace(preset(method), seed=seed))
