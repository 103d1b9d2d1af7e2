"""Photographs under known gains: `python -m tests.bench light [SCENE:VIEWS ...] --out light.json`.

The training photographs of each set get gains of .5 to 2, times .8 to 1.2 for each channel (clipped to
8 bits, as a camera does), drawn with seed 0. `balanced` makes a scene of them as they were taken, with the gains, and
with the gains while `exposure_compensation` is switched off. Held-out photographs are as they were taken; each render
is brought to the exposure of its photograph (`--color-correct`) before it is scored. Live, the photographs come one at
a time: scored are the scene that has grown with them, and the one that is made of all in the end. Errors of the gains
are against those drawn, times what is found for the photographs as they were taken, and after the median.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.methods import Start, extract_start_config, find_start
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Settings
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import exposure as scene_exposure
from tests.bench.quality.real_sets import last, measure, timed

SETS = ("fountain_p11:6", "llff_fern:6", "fox:12")
LEAST, MOST, BALANCE = 0.5, 2.0, 0.2
ON = preset("balanced")
OFF = msgspec.structs.replace(ON, exposure_compensation=scene_exposure.ExposureConfig(enabled=False))


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    kind: str  # one exposure; gains; gains, light off; and the same live, grown or in the end
    verdict: str
    psnr: float | None
    ssim: float | None
    lpips: float | None
    num_gaussians: int | None
    seconds: float  # of the processor, from depth on
    saturated_percent: float  # of the training photographs' pixels
    gain_error_percent: Sequence[float] = ()  # median and largest, over photographs and channels


def drawn(count: int) -> npt.NDArray[np.float64]:
    """(count, 3) the gains of photographs."""
    generator = np.random.default_rng(0)
    exposure = np.exp(generator.uniform(np.log(LEAST), np.log(MOST), count))
    return exposure[:, None] * (1.0 + generator.uniform(-BALANCE, BALANCE, (count, 3)))


def changed(frame: Frame, gains: npt.NDArray[np.float64]) -> Frame:
    image = np.clip(np.rint(frame.image * gains), 0, 255).astype(np.uint8)
    return replace(frame, image=image, encoded=None)


def logs_of(start: Start, told: Mapping[str, float] = MappingProxyType({})) -> Mapping[str, npt.NDArray[np.float64]]:
    """(3,) logarithms of the gains that are found, by photograph; `told` is what cameras say of them."""
    maps = list(start.estimate.pointmaps.values())
    images = {keyframe.name: keyframe.image for keyframe in start.estimate.graph.keyframes}
    found = scene_exposure.estimate_log_gains(maps, [images[each.name] for each in maps], told)
    return {each.name: own for each, own in zip(maps, found, strict=True)}


def gain_errors(
    plain: Start,
    under: Start,
    true: Mapping[str, npt.NDArray[np.float64]],
    told: Mapping[str, float] = MappingProxyType({}),
) -> tuple[float, float]:
    """Percent: median and largest. `told` is what cameras say of the photographs `under` gains."""
    before, after = logs_of(plain), logs_of(under, told)
    names = [name for name in after if name in before]
    off = np.array([after[name] - before[name] - np.log(true[name]) for name in names])
    errors = 100.0 * np.abs(np.expm1(off - np.median(off, axis=0)))
    return round(float(np.median(errors)), 3), round(float(errors.max()), 3)


def grown(frames: Sequence[Frame], config: ReconstructionConfig) -> IncrementalReconstruction:
    """A reconstruction that got the photographs one at a time."""
    work = IncrementalReconstruction(config)
    for frame in frames:
        work.add_frame(frame)
        work.update()
    return work


def finished(work: IncrementalReconstruction) -> Snapshot:
    """Of the scene that is made of all photographs, as the node makes it when no further one comes."""
    work.estimate_thoroughly()
    work.rebuild()
    for show in work.refine(work.initial_scene, work.config.optimize):
        work.show(show)
    return work.snapshot(final=True)


def rows(scene: EvaluationScene, split: Split, _: Sequence[str], networks: PerceptualNetworks) -> list[Row]:
    frames = scene.frames(split.train)
    gains = drawn(len(frames))
    under = [changed(frame, own) for frame, own in zip(frames, gains, strict=True)]
    starts = {kind: find_start(each, extract_start_config(ON)) for kind, each in (("plain", frames), ("under", under))}
    true = {frame.name: own for frame, own in zip(frames, gains, strict=True)}
    errors = gain_errors(starts["plain"], starts["under"], true)

    def scored(kind: str, made: Callable[[], Snapshot], shown: Sequence[Frame], *found: float) -> Row:
        _, row, seconds = timed(made, scene, split, networks, Settings(best_gain=True))
        saturated = 100.0 * float(
            np.mean([(frame.image >= scene_exposure.SATURATED).any(-1).mean() for frame in shown])
        )
        scores = row.psnr, row.ssim, row.lpips_alex, row.num_gaussians
        return Row(scene.name, len(frames), kind, row.verdict, *scores, round(seconds, 1), round(saturated, 2), found)

    def offline(kind: str, config: ReconstructionConfig) -> Callable[[], Snapshot]:
        return partial(last, starts[kind], config)

    result = [
        scored("one exposure", offline("plain", ON), frames),
        scored("gains", offline("under", ON), under, *errors),
        scored("gains, light off", offline("under", OFF), under),
    ]
    for kind, shown, config in (("one exposure", frames, ON), ("gains", under, ON), ("gains, light off", under, OFF)):
        work = grown(shown, config)
        result.append(scored(f"{kind}, live, grown", work.snapshot, shown))
        result.append(scored(f"{kind}, live, in the end", partial(finished, work), shown))
    return result


def in_words(row: Row) -> str:
    return f"{row.scene} {row.views}, {row.kind}: {row.verdict}, {row.psnr} dB"


def main() -> None:
    measure("light", __doc__, SETS, "SCENE:VIEWS", rows, in_words)


if __name__ == "__main__":
    main()
