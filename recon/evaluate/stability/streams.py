"""Rows 25 to 30: frames one by one, damaged files, long streams, repetition, and budgets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import msgspec
import numpy as np

from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.quality import Limits, novelty, why_redundant
from splatnode.recon.config import Config
from splatnode.recon.evaluate.stability.case import (
    LIGHT,
    Case,
    Demand,
    Measured,
    accepted,
    described,
    frames,
    one_by_one,
    row,
    world,
)
from splatnode.recon.evaluate.stability.methods import splatnode
from splatnode.recon.evaluate.stability.places import Image, Photo, Sampler
from splatnode.recon.evaluate.stability.probes import (
    as_good_as_a_batch,
    ignores_a_bigger_budget,
    keeps_quality_when_trained_longer,
    repeatable,
)
from splatnode.recon.evaluate.stability.warps import resized
from splatnode.recon.evaluate.truth import EvaluationScene
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code

# Enough steps for a picture whose quality means something, at a size at which they are cheap.
_FITTED = msgspec.structs.replace(
    LIGHT,
    optimize=msgspec.structs.replace(LIGHT.optimize, iterations=80, half_resolution_share=0.25, refine_poses=True),
)
_SOAK_FRAMES, _SOAK_VIEWS = 500, 4
_SOAK_MARGIN_MB = 60.0  # that the peak memory may grow after the first round: the allocator is not exact
_SOAK_GAUSSIANS = 8000  # the budget of the soak


@row(25, "one by one")
def incremental(sampler: Sampler) -> Case:
    photos, scene, test = _every_second(sampler, 4)
    probe = as_good_as_a_batch(photos, scene, test)
    return replace(accepted(photos, "one by one", probe=probe), source=one_by_one(photos), config=_FITTED, stream=True)


@row(26, "damaged files")
def damaged(sampler: Sampler) -> Case:
    """Four good photographs in four formats, and four files that only look like photographs."""
    photos = sampler.photos(4)
    formats = (".jpg", ".png", ".png", ".png")
    as_stored = (photos[0].image, _with_alpha(photos[1].image), _grey(photos[2].image), _in_16_bits(photos[3].image))
    good = {f"good_{i}{formats[i]}": _encoded(image, formats[i]) for i, image in enumerate(as_stored)}
    bad = _damaged(good["good_0.jpg"])
    named = [replace(photo, name=name) for photo, name in zip(photos, good, strict=True)]
    return Case(
        note=described(photos, f"good files, and {len(bad)} damaged"),
        source=partial(_read_back, {**good, **bad}),
        demand=Demand.ACCEPT,
        codes=frozenset({Code.OK, Code.OK_PARTIAL}),
        worlds=(world(named),),
        probe=partial(_names_the_damaged, tuple(bad)),
    )


@row(26, "nothing but damaged files")
def only_damaged(sampler: Sampler) -> Case:
    (photo,) = sampler.photos(1)
    files = _damaged(_encoded(photo.image, ".jpg"))
    source = partial(_read_back, files)
    return Case(described([], f"{len(files)} damaged files"), source, Demand.REFUSE, frozenset({Code.TOO_FEW_VIEWS}))


@row(26, "a huge file")
def huge(sampler: Sampler) -> Case:
    """One of four photographs as an 8K camera would have stored it."""
    photos = sampler.photos(4)
    photos[1] = resized(photos[1], 7680 / max(photos[1].image.shape))
    files = {f"{i}.jpg": _encoded(photo.image, ".jpg") for i, photo in enumerate(photos)}
    named = [replace(photo, name=name) for photo, name in zip(photos, files, strict=True)]
    case = accepted(named, "1 of 4 files of 7680 pixels", Code.OK_PARTIAL)
    return replace(case, source=partial(_read_back, files))


@row(26, "numbers out of order")
def out_of_order(sampler: Sampler) -> Case:
    """Frames whose ids and stamps fall and repeat, as after a publisher has started again."""
    photos = sampler.photos(4)
    numbers = (2, 0, 0, 1)
    jumbled = [replace(f, frame_id=n, stamp_ns=n) for f, n in zip(frames(photos), numbers, strict=True)]
    case = accepted(photos, "4 frames with the ids 2, 0, 0, 1")
    return replace(case, source=partial(list, jumbled))


@row(27, "soak")
def soak(sampler: Sampler) -> Case:
    """A robot that goes round and round: 500 frames of few views, through the camera's own choice of frames."""
    photos = [resized(photo, min(1.0, 640 / max(photo.image.shape))) for photo in sampler.photos(_SOAK_VIEWS)]
    note = f"{_SOAK_FRAMES} frames of {_SOAK_VIEWS} views, at most {_SOAK_GAUSSIANS} Gaussians"
    config = msgspec.structs.replace(LIGHT, max_gaussians=_SOAK_GAUSSIANS)
    case = accepted(photos, note, Code.BUDGET_HIT, probe=partial(_stays_flat, frames(photos)))
    return replace(case, config=config)


@row(28, "determinism")
def determinism(sampler: Sampler) -> Case:
    photos = sampler.photos(3)
    return accepted(photos, "three times", probe=repeatable(photos))


@row(29, "overfit")
def overfit(sampler: Sampler) -> Case:
    photos, scene, test = _every_second(sampler, 3)
    probe = keeps_quality_when_trained_longer(photos, scene, test)
    return replace(accepted(photos, "", Code.OVERFIT, probe=probe), config=_FITTED)


@row(30, "gross model")
def gross(sampler: Sampler) -> Case:
    photos = sampler.photos(3)
    return accepted(photos, "", probe=ignores_a_bigger_budget(photos))


def _every_second(sampler: Sampler, count: int) -> tuple[list[Photo], EvaluationScene, list[str]]:
    """`count` photographs to learn from, their scene, and the names of two between them to be tested on."""
    place, indices = sampler.window(2 * count - 1, step_deg=7.0)
    return place.photos(indices[::2]), place.scene, [place.names[i] for i in indices[1::2]][:2]


def _stays_flat(same: Sequence[Frame], snapshot: Snapshot, config: Config) -> Measured:
    """Once every view was seen, more frames of them cost no memory and add nothing."""
    peaks: list[float] = []
    last = splatnode(_round_and_round(same, peaks), config)
    growth = peaks[-1] - peaks[0]
    values = {
        "frames": _SOAK_FRAMES,
        "peak_growth_mb": growth,
        "cameras": len(last.cameras),
        "num_gaussians": len(last.gaussians),
    }
    steady = growth < _SOAK_MARGIN_MB and len(last.cameras) == len(snapshot.cameras)
    return Measured(values, held=steady and len(last.gaussians) <= _SOAK_GAUSSIANS)


def _round_and_round(views: Sequence[Frame], peaks: list[float]) -> Iterator[Frame | DroppedFrame]:
    """500 noisy frames, those that show nothing new dropped; `peaks` gets the memory after each round of all views."""
    kept: list[Frame] = []
    rng = np.random.default_rng(0)
    grain = [rng.integers(-2, 3, views[0].image.shape) for _ in range(4)]
    stay = 10  # frames that the robot stands still at each view
    for number in range(_SOAK_FRAMES):
        view = views[number // stay % len(views)]
        image = np.clip(view.image + grain[number % len(grain)], 0, 255).astype(np.uint8)
        frame = Frame(number, f"{number:03d}_{view.name}", number, image, view.intrinsics)
        reasons = [why_redundant(novelty(image, other.image), Limits()) for other in kept]
        if any(reasons):
            yield DroppedFrame(frame.name, next(reason for reason in reasons if reason))
        else:
            kept.append(frame)
            yield frame
        if number % (stay * len(views)) == stay * len(views) - 1:
            peaks.append(peak_rss_mb() or 0.0)


def _names_the_damaged(bad: Sequence[str], snapshot: Snapshot, _: Config) -> Measured:
    named = {frame.name for frame in snapshot.dropped}
    return Measured({"damaged": len(bad), "named": len(named & set(bad))}, held=set(bad) <= named)


def _read_back(files: dict[str, bytes]) -> list[Frame | DroppedFrame]:
    """What the folder camera makes of `files`."""
    with TemporaryDirectory(prefix="splatnode-stability-") as place:
        for name, data in files.items():
            (Path(place) / name).write_bytes(data)
        return list(folder.stream(folder.Config(folder=Path(place))))


def _damaged(jpeg: bytes) -> dict[str, bytes]:
    return {
        "cut_short.jpg": jpeg[: len(jpeg) // 2],
        "empty.jpg": b"",
        "text.png": b"this is not an image",
        "end_of_a_file.jpg": jpeg[len(jpeg) // 2 :],
    }


def _encoded(image: np.ndarray, suffix: str) -> bytes:
    """`image` RGB, RGBA or grey, 8 or 16 bits, as a file."""
    if image.ndim == 3:
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    _, data = cv2.imencode(suffix, image)
    return data.tobytes()


def _with_alpha(image: Image) -> Image:
    return np.dstack([image, np.full(image.shape[:2], 128, np.uint8)])


def _grey(image: Image) -> Image:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint8)


def _in_16_bits(image: Image) -> np.ndarray:
    return image.astype(np.uint16) * 257
