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
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.stability.case import (
    LIGHT,
    Demand,
    ProbeResult,
    TrialCase,
    describe_case,
    make_accept_case,
    make_frames,
    make_stream_source,
    make_world,
    row,
)
from splatnode.recon.evaluate.stability.methods import splatnode
from splatnode.recon.evaluate.stability.places import Image, Sampler, TrialImage
from splatnode.recon.evaluate.stability.probes import (
    make_budget_probe,
    make_overfit_probe,
    make_repeatability_probe,
    make_stream_quality_probe,
)
from splatnode.recon.evaluate.stability.warps import resize_image
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
def frame_by_frame(sampler: Sampler) -> TrialCase:
    photos, scene, test = _sample_every_second(sampler, 4)
    probe = make_stream_quality_probe(photos, scene, test)
    return replace(
        make_accept_case(photos, "one by one", probe=probe),
        source=make_stream_source(photos),
        config=_FITTED,
        stream=True,
    )


@row(26, "damaged files")
def corrupt_files(sampler: Sampler) -> TrialCase:
    """Four good photographs in four formats, and four files that only look like photographs."""
    photos = sampler.load_images(4)
    formats = (".jpg", ".png", ".png", ".png")
    as_stored = (
        photos[0].image,
        _add_alpha(photos[1].image),
        _convert_to_grey(photos[2].image),
        _convert_to_16_bits(photos[3].image),
    )
    good = {f"good_{i}{formats[i]}": _encode_image(image, formats[i]) for i, image in enumerate(as_stored)}
    bad = _make_corrupt_files(good["good_0.jpg"])
    named = [replace(photo, name=name) for photo, name in zip(photos, good, strict=True)]
    return TrialCase(
        note=describe_case(photos, f"good files, and {len(bad)} damaged"),
        source=partial(_read_files, {**good, **bad}),
        demand=Demand.ACCEPT,
        codes=frozenset({Code.OK, Code.OK_PARTIAL}),
        worlds=(make_world(named),),
        probe=partial(_measure_corrupt_report, tuple(bad)),
    )


@row(26, "nothing but damaged files")
def only_corrupt_files(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    files = _make_corrupt_files(_encode_image(photo.image, ".jpg"))
    source = partial(_read_files, files)
    return TrialCase(
        describe_case([], f"{len(files)} damaged files"), source, Demand.REFUSE, frozenset({Code.TOO_FEW_VIEWS})
    )


@row(26, "a huge file")
def huge_file(sampler: Sampler) -> TrialCase:
    """One of four photographs as an 8K camera would have stored it."""
    photos = sampler.load_images(4)
    photos[1] = resize_image(photos[1], 7680 / max(photos[1].image.shape))
    files = {f"{i}.jpg": _encode_image(photo.image, ".jpg") for i, photo in enumerate(photos)}
    named = [replace(photo, name=name) for photo, name in zip(photos, files, strict=True)]
    case = make_accept_case(named, "1 of 4 files of 7680 pixels", Code.OK_PARTIAL)
    return replace(case, source=partial(_read_files, files))


@row(26, "numbers out of order")
def out_of_order(sampler: Sampler) -> TrialCase:
    """Frames whose ids and stamps fall and repeat, as after a publisher has started again."""
    photos = sampler.load_images(4)
    numbers = (2, 0, 0, 1)
    jumbled = [replace(f, frame_id=n, stamp_ns=n) for f, n in zip(make_frames(photos), numbers, strict=True)]
    case = make_accept_case(photos, "4 frames with the ids 2, 0, 0, 1")
    return replace(case, source=partial(list, jumbled))


@row(27, "soak")
def soak(sampler: Sampler) -> TrialCase:
    """A robot that goes round and round: 500 frames of few views, through the camera's own choice of frames."""
    photos = [resize_image(photo, min(1.0, 640 / max(photo.image.shape))) for photo in sampler.load_images(_SOAK_VIEWS)]
    note = f"{_SOAK_FRAMES} frames of {_SOAK_VIEWS} views, at most {_SOAK_GAUSSIANS} Gaussians"
    config = msgspec.structs.replace(LIGHT, max_gaussians=_SOAK_GAUSSIANS)
    case = make_accept_case(photos, note, Code.BUDGET_HIT, probe=partial(_measure_memory_growth, make_frames(photos)))
    return replace(case, config=config)


@row(28, "determinism")
def determinism(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    return make_accept_case(photos, "three times", probe=make_repeatability_probe(photos))


@row(29, "overfit")
def overfit(sampler: Sampler) -> TrialCase:
    photos, scene, test = _sample_every_second(sampler, 3)
    probe = make_overfit_probe(photos, scene, test)
    return replace(make_accept_case(photos, "", Code.OVERFIT, probe=probe), config=_FITTED)


@row(30, "gross model")
def gross_model(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    return make_accept_case(photos, "", probe=make_budget_probe(photos))


def _sample_every_second(sampler: Sampler, count: int) -> tuple[list[TrialImage], EvaluationScene, list[str]]:
    """`count` photographs to learn from, their scene, and the names of two between them to be tested on."""
    place, indices = sampler.choose_window(2 * count - 1, step_deg=7.0)
    return place.load_images(indices[::2]), place.scene, [place.names[i] for i in indices[1::2]][:2]


def _measure_memory_growth(same: Sequence[Frame], snapshot: Snapshot, config: ReconstructionConfig) -> ProbeResult:
    """Once every view was seen, more frames of them cost no memory and add nothing."""
    peaks: list[float] = []
    last = splatnode(_repeat_views(same, peaks), config)
    growth = peaks[-1] - peaks[0]
    values = {
        "frames": _SOAK_FRAMES,
        "peak_growth_mb": growth,
        "cameras": len(last.cameras),
        "num_gaussians": len(last.gaussians),
    }
    steady = growth < _SOAK_MARGIN_MB and len(last.cameras) == len(snapshot.cameras)
    return ProbeResult(values, held=steady and len(last.gaussians) <= _SOAK_GAUSSIANS)


def _repeat_views(views: Sequence[Frame], peaks: list[float]) -> Iterator[Frame | DroppedFrame]:
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


def _measure_corrupt_report(bad: Sequence[str], snapshot: Snapshot, _: ReconstructionConfig) -> ProbeResult:
    named = {frame.name for frame in snapshot.dropped}
    return ProbeResult({"damaged": len(bad), "named": len(named & set(bad))}, held=set(bad) <= named)


def _read_files(files: dict[str, bytes]) -> list[Frame | DroppedFrame]:
    """Reads `files` with the folder camera."""
    with TemporaryDirectory(prefix="splatnode-stability-") as place:
        for name, data in files.items():
            (Path(place) / name).write_bytes(data)
        return list(folder.stream(folder.Config(folder=Path(place))))


def _make_corrupt_files(jpeg: bytes) -> dict[str, bytes]:
    return {
        "cut_short.jpg": jpeg[: len(jpeg) // 2],
        "empty.jpg": b"",
        "text.png": b"this is not an image",
        "end_of_a_file.jpg": jpeg[len(jpeg) // 2 :],
    }


def _encode_image(image: np.ndarray, suffix: str) -> bytes:
    """`image` RGB, RGBA or grey, 8 or 16 bits, as a file."""
    if image.ndim == 3:
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    _, data = cv2.imencode(suffix, image)
    return data.tobytes()


def _add_alpha(image: Image) -> Image:
    return np.dstack([image, np.full(image.shape[:2], 128, np.uint8)])


def _convert_to_grey(image: Image) -> Image:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint8)


def _convert_to_16_bits(image: Image) -> np.ndarray:
    return image.astype(np.uint16) * 257
