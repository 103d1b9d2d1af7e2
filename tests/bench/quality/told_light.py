"""Cameras that tell their exposure: `python -m tests.bench told_light [SCENE:VIEWS ...] --out told_light.json`.

The training photographs of each set get the gains of the bench `light`. Their gains are found without a word of the
cameras, and with words of several kinds: right, too steep a curve, one photograph's wrong by a factor of 5, and the
reverse of the truth. Errors are those of the bench `light`. `left` tells whether the photographs as they were taken,
under the same words, are left as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.methods import Start, extract_start_config, find_start
from splatnode.extras.evaluate.protocol import PerceptualNetworks
from splatnode.recon.scene import exposure
from tests.bench.quality.light import ON, changed, drawn, gain_errors
from tests.bench.quality.real_sets import measure

SETS = ("fountain_p11:6", "llff_fern:6")
STEEPER, WRONG = 1.5, 5.0


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    told: str  # nothing, right, steeper, one wrong, reversed
    gain_error_percent: Sequence[float]  # median and largest, over photographs and channels
    left: bool  # the photographs as they were taken, under the same words, are left as they are


def words(gains: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """What cameras tell, logarithms by photograph, by its kind; `gains` are the true ones."""
    right = {name: float(np.log(gain)) for name, gain in gains.items()}
    first = next(iter(right))
    return {
        "nothing": {},
        "right": right,
        "steeper": {name: STEEPER * log for name, log in right.items()},
        "one wrong": right | {first: right[first] + float(np.log(WRONG))},
        "reversed": {name: -log for name, log in right.items()},
    }


def is_left(start: Start, told: Mapping[str, float]) -> bool:
    maps = list(start.estimate.pointmaps.values())
    images = {keyframe.name: keyframe.image for keyframe in start.estimate.graph.keyframes}
    return not exposure.estimate_exposures(maps, images, ON.exposure_compensation, told)


def rows(scene: EvaluationScene, split: Split, _: Sequence[str], networks: PerceptualNetworks) -> list[Row]:
    frames = scene.frames(split.train)
    true = {frame.name: own for frame, own in zip(frames, drawn(len(frames)), strict=True)}
    plain = find_start(frames, extract_start_config(ON))
    under = find_start([changed(frame, true[frame.name]) for frame in frames], extract_start_config(ON))
    return [
        Row(scene.name, len(frames), kind, gain_errors(plain, under, true, told), is_left(plain, told))
        for kind, told in words({name: float(own.mean()) for name, own in true.items()}).items()
    ]


def in_words(row: Row) -> str:
    median, largest = row.gain_error_percent
    kept = "left" if row.left else "changed"
    return (
        f"{row.scene} {row.views}, told {row.told}: gains off by {median} and {largest} %; as they were taken: {kept}"
    )


def main() -> None:
    measure("told_light", __doc__, SETS, "SCENE:VIEWS", rows, in_words)


if __name__ == "__main__":
    main()
