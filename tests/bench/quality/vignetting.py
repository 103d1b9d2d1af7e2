"""Lenses that dim their corners: `python -m tests.bench vignetting [SCENE:VIEWS ...] --out vignetting.json`.

All photographs of each set, training and held-out ones, get the light of a lens that keeps a share of it from the
corners (1 - loss r^2 of what reaches the middle, r = 1 at the corners). `balanced` makes a scene of them with the
vignetting taken out where it finds enough of it, and one with `light` switched off. Renders of the first get the
vignetting before they are compared with the photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.methods import extract_start_config, find_start
from splatnode.extras.evaluate.protocol import PerceptualNetworks
from splatnode.extras.evaluate.stability.perturbations import apply_vignetting
from splatnode.recon.config import preset
from splatnode.recon.scene import exposure
from tests.bench.quality.real_sets import last, measure, timed

SETS = ("fountain_p11:6", "llff_fern:6", "sceaux:6")
LOSSES = (0.0, 0.45, 0.6)  # of the light in the corners
ON = preset("balanced")
OFF = msgspec.structs.replace(ON, exposure_compensation=exposure.ExposureConfig(enabled=False))


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    loss: float  # of the light in the corners
    taken_out: bool  # where enough of it is found
    found: float  # the loss that was taken out; 0: none was
    verdict: str
    psnr: float | None
    ssim: float | None
    lpips: float | None
    num_gaussians: int | None
    seconds: float  # of the processor, from depth on


@dataclass(frozen=True, eq=False)
class Dimmed(EvaluationScene):
    """A scene as a lens shows it that keeps `loss` of the light from the corners."""

    loss: float = 0.0

    def image(self, name: str) -> npt.NDArray[np.uint8]:
        return apply_vignetting(super().image(name), self.loss)


def rows(scene: EvaluationScene, split: Split, _: Sequence[str], networks: PerceptualNetworks) -> list[Row]:
    return [row for loss in LOSSES for row in _of_a_lens(scene, split, loss, networks)]


def _of_a_lens(scene: EvaluationScene, split: Split, loss: float, networks: PerceptualNetworks) -> list[Row]:
    seen = Dimmed(scene.name, scene.paths, scene.cameras, scene.masks, loss)
    frames: list[Frame] = seen.frames(split.train)
    start = find_start(frames, extract_start_config(ON))
    result = []
    for config in (ON, OFF):
        snapshot, row, seconds = timed(partial(last, start, config), seen, split, networks)
        scores = row.psnr, row.ssim, row.lpips_alex, row.num_gaussians
        found = round(1.0 - math.exp(-max(snapshot.falloffs.values(), default=0.0)), 3)
        result.append(Row(scene.name, len(frames), loss, config is ON, found, row.verdict, *scores, round(seconds, 1)))
        if config is ON and not snapshot.falloffs and not snapshot.gains:  # the same with `light` off, then
            return [*result, replace(result[0], taken_out=False)]
    return result


def in_words(row: Row) -> str:
    return f"{row.scene} {row.views}, {row.loss} lost, {row.found} taken out: {row.verdict}, {row.psnr} dB"


def main() -> None:
    measure("vignetting", __doc__, SETS, "SCENE:VIEWS", rows, in_words)


if __name__ == "__main__":
    main()
