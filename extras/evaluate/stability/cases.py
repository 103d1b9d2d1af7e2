"""Rows 25 to 30: frames one by one, damaged files, long streams, repetition, and budgets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import msgspec
import numpy as np

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.keyframe_selection import Limits, novelty, why_redundant
from splatnode.capture.lenses import wide_pinhole
from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera
from splatnode.extras.evaluate.stability import perturbations
from splatnode.extras.evaluate.stability.perturbations import (
    Image,
    Sampler,
    TrialImage,
    find_distant_views,
    find_parallel_sets,
    rename_images,
    resize_image,
)
from splatnode.extras.evaluate.stability.trial import (
    LIGHT,
    Demand,
    ProbeResult,
    TrialCase,
    describe_case,
    make_accept_case,
    make_budget_probe,
    make_either_case,
    make_frames,
    make_overfit_probe,
    make_refuse_case,
    make_repeatability_probe,
    make_same_cameras_probe,
    make_stream_quality_probe,
    make_stream_source,
    make_world,
    row,
    splatnode,
)
from splatnode.recon.config import ReconstructionConfig
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


# Rows 1 to 6, 9 and 24: how many photographs there are, and how the camera moved between them.


@row(1, "clean")
def clean_views(sampler: Sampler) -> TrialCase:
    count = (3, 4, 6)[sampler.seed % 3]
    return make_accept_case(sampler.load_images(count), "neighbours")


@row(1, "clean, further apart")
def clean_apart(sampler: Sampler) -> TrialCase:
    return make_accept_case(sampler.load_images(5, step_deg=20.0), "neighbours at up to 20 degrees")


@row(1, "clean, parallel views")
def parallel_views(sampler: Sampler) -> TrialCase:
    """Makes parallel views; where they are weak, a right scene is as good as a refusal."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    for place in sampler.list_scenes_in_turn():
        starts, stride = find_parallel_sets(place.Ts_world_camera, 4)
        if starts:
            start = int(sampler.rng.choice(starts))
            return make_either_case(
                place.load_images(range(start, start + 4 * stride, stride)), "views in one direction", *fitting
            )
    return make_either_case(
        _render_walk(sampler, [0.0, 0.15, 0.3, 0.45], axis=0), "15 cm further to the side each", *fitting
    )


@row(2, "shuffled")
def random_order(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(4)
    order = [photos[i] for i in sampler.rng.permutation(len(photos))]
    probe = make_same_cameras_probe(photos, rotation_deg=0.1, centre_pct=0.3)
    return make_accept_case(order, "in random order", probe=probe)


@row(3, "every frame twice")
def duplicates(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    copies = [replace(photo, name=f"copy_{photo.name}") for photo in photos]
    # Leaving the copies out is as good as placing them.
    return make_accept_case(photos + copies, "each and its copy", Code.OK_PARTIAL)


@row(3, "one frame many times")
def one_frame(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    copies = [replace(photo, name=f"copy_{i}_{photo.name}") for i in range(4)]
    return make_refuse_case(copies, "copies of one", Code.STATIC_CAMERA)


@row(4, "single view")
def single_view(sampler: Sampler) -> TrialCase:
    return make_refuse_case(sampler.load_images(1), "", Code.TOO_FEW_VIEWS)


@row(5, "two views")
def two_views(sampler: Sampler) -> TrialCase:
    place = sampler.list_scenes_in_turn()[0]
    gap = 1 if sampler.seed % 2 else max(1, (len(place.names) - 1) // 3)
    start = int(sampler.rng.integers(len(place.names) - gap))
    note = f"{gap} apart in the order of capture"
    codes = (Code.TOO_FEW_VIEWS, Code.BASELINE_TOO_SMALL, Code.FOCAL_SUSPECT, Code.NO_OVERLAP, Code.PLANAR_ONLY)
    return make_either_case(place.load_images([start, start + gap]), note, *codes)


@row(6, "tiny baseline")
def tiny_baseline(sampler: Sampler) -> TrialCase:
    """Neighbours of a video. Only the built-in place can be photographed from wherever one wants."""
    degrees = (0.05, 0.15, 0.3)[sampler.seed % 3]
    views = 4
    config = synthetic.Config(views=8, seed=sampler.seed % 2)
    (start, K), (end, _) = synthetic.scene_cameras(config)[3:5]  # 11 degrees apart
    share = degrees / 11.0
    photos = []
    for number in range(views):
        centre = start[:3, 3] + number * share * (end[:3, 3] - start[:3, 3])
        photos.append(_render_image(config, synthetic.look_at(centre, synthetic.TARGET), K, number))
    fitting = (Code.BASELINE_TOO_SMALL, Code.STATIC_CAMERA, Code.NO_PARALLAX, Code.TOO_FEW_VIEWS)
    return make_refuse_case(photos, f"{degrees} degrees apart", *fitting)


@row(9, "places that share nothing")
def places_apart(sampler: Sampler) -> TrialCase:
    chosen = sampler.load_one_per_scene(5)
    case = make_refuse_case(chosen, "one of each", Code.NO_OVERLAP, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)
    return replace(case, worlds=tuple(make_world([photo]) for photo in chosen))


@row(9, "views that share nothing")
def views_apart(sampler: Sampler) -> TrialCase:
    """The corners of an orbit, or where no place was walked around, the ends of two walks."""
    for place in sampler.list_scenes_in_turn():
        apart = find_distant_views(place, 4, 60.0, sampler.rng)
        if apart:
            note = "at least 60 degrees apart"
            # Photographs with a wide lens may share something all the same.
            fitting = (Code.NO_OVERLAP, Code.SPLIT, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)
            return make_either_case(place.load_images(apart), note, *fitting)
    first = rename_images(sampler.load_images(2), "a")
    second = rename_images(sampler.load_images(2, first), "b")
    case = make_refuse_case(first + second, "two of each", Code.NO_OVERLAP, Code.SPLIT)
    return replace(case, worlds=(make_world(first), make_world(second)))


@row(24, "forward motion")
def forward_motion(sampler: Sampler) -> TrialCase:
    """A recorded drive where there is one, else a walk towards the table of the built-in place."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.NO_OVERLAP)
    if sampler.places.forward and sampler.seed % 2:
        place = sampler.places.forward[sampler.seed // 2 % len(sampler.places.forward)]
        start = int(sampler.rng.integers(max(1, len(place.names) - 5)))
        return make_either_case(place.load_images(range(start, min(start + 5, len(place.names)))), "recorded", *fitting)
    return make_either_case(
        _render_walk(sampler, [0.0, 0.2, 0.4, 0.6, 0.8], axis=2), "20 cm further forward each", *fitting
    )


def _render_walk(sampler: Sampler, distances: Sequence[float], axis: int) -> list[TrialImage]:
    """The built-in place from a camera that moves by `distances` along its own `axis`, and does not turn."""
    config = synthetic.Config(views=8, seed=sampler.seed % 2)
    start, K = synthetic.scene_cameras(config)[int(sampler.rng.integers(2, 6))]
    photos = []
    for number, distance in enumerate(distances):
        T_world_camera = start.copy()
        T_world_camera[:3, 3] += distance * start[:3, axis]
        photos.append(_render_image(config, T_world_camera, K, number))
    return photos


def _render_image(config: synthetic.Config, T_world_camera: np.ndarray, K: np.ndarray, number: int) -> TrialImage:
    image = synthetic.render_image(config, (T_world_camera, K), noise_seed=number)
    camera = TrueCamera(T_world_camera, K, config.width, config.height)
    return TrialImage(f"view_{number}.png", image, camera, "built-in place")


# Rows 19 to 22: what is said about the camera is wrong, or the frames are not of one pinhole camera.

_SIDES = 640, 480  # pixels, of photographs through a fisheye
_DOUBTS = (Code.FOCAL_SUSPECT, Code.MIXED_CAMERAS, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)


@row(19, "true focal length given")
def true_focal(sampler: Sampler) -> TrialCase:
    photos = _set_focal_length(sampler.load_images(4), 1.0, "given")
    return make_accept_case(photos, "4 frames with their true focal length")


@row(19, "wrong focal length given")
def wrong_focal(sampler: Sampler) -> TrialCase:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _set_focal_length(sampler.load_images(5), factor, "given")
    return make_refuse_case(photos, f"given focal length x{factor}", Code.FOCAL_SUSPECT)


@row(19, "EXIF lies")
def exif_lies(sampler: Sampler) -> TrialCase:
    factor = (0.7, 1.4)[sampler.seed % 2]
    photos = _set_focal_length(sampler.load_images(5), factor, "exif")
    return make_either_case(photos, f"EXIF focal length x{factor}", *_DOUBTS)


@row(20, "radial distortion")
def distortion(sampler: Sampler) -> TrialCase:
    k1 = (-0.1, 0.1)[sampler.seed % 2]
    photos = [perturbations.distort_image(photo, k1) for photo in sampler.load_images(5)]
    return make_accept_case(photos, f"k1 {k1:+}", Code.OK_PARTIAL)


@row(20, "strong radial distortion")
def strong_distortion(sampler: Sampler) -> TrialCase:
    k1 = (-0.3, 0.3)[sampler.seed % 2]
    photos = [perturbations.distort_image(photo, k1) for photo in sampler.load_images(5)]
    return make_either_case(photos, f"k1 {k1:+}", *_DOUBTS)


@row(20, "calibrated fisheye")
def fisheye(sampler: Sampler) -> TrialCase:
    """The built-in place, through a fisheye: no recorded scene has one whose cameras are known."""
    across_deg, views = (120.0, 170.0)[sampler.seed % 2], (6, 8)[sampler.seed // 2 % 2]
    focal = _SIDES[0] / math.radians(across_deg)
    lens = Intrinsics(*_SIDES, focal, focal, _SIDES[0] / 2, _SIDES[1] / 2, "calibration", model="fisheye")
    config = synthetic.Config(views=views, seed=sampler.seed, lens=lens)
    pinhole = wide_pinhole("the photograph", lens)
    photos = []
    for index, (T_world_camera, _) in enumerate(cameras := synthetic.scene_cameras(config)):
        image = synthetic.render_image(config, cameras[index], index)
        camera = TrueCamera(T_world_camera, pinhole.K, pinhole.width, pinhole.height)
        photos.append(TrialImage(synthetic.frame_name(index), image, camera, "built-in", lens))
    return make_accept_case(photos, f"through {across_deg:g} degrees")


@row(21, "rolling shutter")
def rolling_shutter(sampler: Sampler) -> TrialCase:
    shift = (0.002, 0.01)[sampler.seed % 2]
    photos = [
        perturbations.apply_rolling_shutter(photo, shift * (-1) ** number)
        for number, photo in enumerate(sampler.load_images(4))
    ]
    note = f"rows shifted by {shift:.1%} in turns"
    return (
        make_accept_case(photos, note)
        if sampler.seed % 2 == 0
        else make_either_case(photos, note, Code.BLUR, *_DOUBTS, Code.MOVING_SCENE)
    )


@row(22, "portrait and landscape")
def portrait_and_landscape(sampler: Sampler) -> TrialCase:
    photos = [
        perturbations.rotate_image(photo) if number % 2 else photo
        for number, photo in enumerate(sampler.load_images(4))
    ]
    return make_accept_case(photos, "2 on their side", Code.OK_PARTIAL)


@row(22, "two resolutions")
def two_resolutions(sampler: Sampler) -> TrialCase:
    photos = [
        perturbations.resize_image(photo, 0.6) if number % 2 else photo
        for number, photo in enumerate(sampler.load_images(4))
    ]
    return make_accept_case(photos, "2 at 60 %", Code.OK_PARTIAL)


@row(22, "crops")
def crops(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = [
        perturbations.crop_image(photo, 0.75, *rng.uniform(size=2)) if number % 2 else photo
        for number, photo in enumerate(sampler.load_images(5))
    ]
    return make_either_case(photos, "2 cropped off-centre to 75 %", *_DOUBTS)


def _set_focal_length(photos: Sequence[TrialImage], factor: float, source: str) -> list[TrialImage]:
    """The photographs with their true focal length times `factor` as what `source` says of them."""
    changed = []
    for photo in photos:
        if photo.camera is None:
            raise ValueError(f"{photo.name} must have a true camera")
        height, width = photo.image.shape[:2]
        K = photo.camera.K_for(width, height)
        focal = factor * K[0, 0], factor * K[1, 1]
        changed.append(replace(photo, intrinsics=Intrinsics(width, height, *focal, K[0, 2], K[1, 2], source)))
    return changed


# Rows 10 and 14: frames of other places, and places that look like each other. Here wrong scenes look right.

_AMBIGUOUS = (
    Code.AMBIGUOUS,
    Code.SPLIT,
    Code.OUTLIER_VIEW,
    Code.NO_OVERLAP,
    Code.BASELINE_TOO_SMALL,
    Code.MIXED_CAMERAS,  # places are often photographed by cameras of their own
)


@row(10, "one outlier")
def outlier(sampler: Sampler) -> TrialCase:
    here = sampler.load_images(4)
    elsewhere = rename_images(sampler.load_images(1, here), "elsewhere")
    photos = here + elsewhere
    order = [photos[i] for i in sampler.rng.permutation(len(photos))]
    case = make_accept_case(order, "one of the second place", Code.OUTLIER_VIEW, Code.OK_PARTIAL)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here),))


@row(10, "two places")
def two_places(sampler: Sampler) -> TrialCase:
    here = rename_images(sampler.load_images(4), "here")
    there = rename_images(sampler.load_images(3, here), "there")
    case = make_either_case(here + there, "4 and 3", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here), make_world(there)))


@row(14, "some frames mirrored")
def some_mirrored(sampler: Sampler) -> TrialCase:
    """Mirrors some frames: what is symmetric matches, the rest belongs to a world that there is not."""
    photos = sampler.load_images(5)
    flipped = 1 + sampler.seed % 2
    plain, reflected = photos[flipped:], [perturbations.mirror_image(photo) for photo in photos[:flipped]]
    case = make_either_case(plain + reflected, f"{flipped} mirrored", *_AMBIGUOUS)
    return replace(case, worlds=(make_world(plain), make_world(reflected)))


@row(14, "as many mirrored as plain")
def half_mirrored(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    reflected = [perturbations.mirror_image(photo) for photo in photos]
    case = make_either_case(photos + reflected, "3 and their mirror images", *_AMBIGUOUS)
    return replace(case, worlds=(make_world(photos), make_world(reflected)))


@row(14, "symmetric facade")
def symmetric_facade(sampler: Sampler) -> TrialCase:
    """A flat facade whose right half mirrors its left, photographed from an arc."""
    (photo,) = sampler.load_images(1)
    half = photo.image[:, : photo.image.shape[1] // 2]
    facade = np.concatenate([half, half[:, ::-1]], axis=1)
    views = perturbations.render_poster_views(replace(photo, image=facade), np.linspace(-25.0, 25.0, 4), 1.1)
    return make_refuse_case(views, "views of a facade made of one", Code.PLANAR_ONLY, Code.AMBIGUOUS)


@row(14, "tiled facade")
def window_grid_facade(sampler: Sampler) -> TrialCase:
    """One window of a photograph over and over again: the camera may have passed any number of them."""
    (photo,) = sampler.load_images(1)
    columns = (3, 5)[sampler.seed % 2]
    height, width = photo.image.shape[:2]
    window = photo.image[height // 4 : height // 4 + height // 3, width // 4 : width // 4 + width // columns]
    facade = np.tile(window, (3, columns, 1))
    views = perturbations.render_poster_views(replace(photo, image=facade), np.linspace(-20.0, 20.0, 4), 1.2)
    return make_refuse_case(views, f"views of {columns} x 3 windows of one", Code.PLANAR_ONLY, *_AMBIGUOUS)


@row(14, "every structure twice")
def duplicate_structures(sampler: Sampler) -> TrialCase:
    """Each frame shows its left half twice: half of the matches fit the true cameras, the others a world beside it."""
    photos = [replace(photo, image=perturbations.repeat_left_half(photo.image)) for photo in sampler.load_images(4)]
    # The left half is what the true camera saw; nothing else about these frames is true.
    return make_either_case(photos, "two equal halves each", *_AMBIGUOUS, Code.FOCAL_SUSPECT)


@row(14, "opposite sides")
def opposite_sides(sampler: Sampler) -> TrialCase:
    """Neighbours from two sides of one place, which share no surface but may share its style."""
    for place in sampler.list_scenes_in_turn():
        apart = find_distant_views(place, 2, 75.0, sampler.rng)
        if apart and len(place.names) >= 10:
            indices = sorted(
                {min(max(middle + step, 0), len(place.names) - 1) for middle in apart for step in (-1, 0, 1)}
            )
            return make_either_case(place.load_images(indices), "neighbours on two sides", *_AMBIGUOUS)
    near = sampler.load_images(3)
    far = rename_images(sampler.load_images(3, near), "far")
    case = make_either_case(near + far, "3 of each", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(near), make_world(far)))


@row(14, "picture of the place elsewhere")
def picture_elsewhere(sampler: Sampler) -> TrialCase:
    """A frame of another place in which a photograph of this one hangs on the wall."""
    here = sampler.load_images(4)
    (wall,) = rename_images(sampler.load_images(1, here), "elsewhere")
    side = (0.4, 0.6)[sampler.seed % 2]
    size = round(side * wall.image.shape[1]), round(side * wall.image.shape[0])
    picture = cv2.resize(here[1].image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = (int(sampler.rng.integers(wall.image.shape[axis] - size[1 - axis])) for axis in (1, 0))
    hung = perturbations.paste_patch(wall.image, picture, np.ones(picture.shape[:2], np.float32), left, top)
    note = "one of the second place with a picture of the first"
    case = make_either_case([*here, replace(wall, image=hung, camera=None)], note, *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK})


@row(14, "the same thing in two places")
def same_thing(sampler: Sampler) -> TrialCase:
    """A big poster that hangs in both places: all frames share it, and nothing else."""
    here = rename_images(sampler.load_images(3), "here")
    there = rename_images(sampler.load_images(3, here), "there")
    (poster,) = sampler.load_images(1, here + there)
    views = perturbations.render_poster_views(poster, np.linspace(-20.0, 20.0, 6), 1.0)
    photos = [_paste_poster(photo, view) for photo, view in zip(here + there, views, strict=True)]
    case = make_either_case(photos, "one poster in all", *_AMBIGUOUS, Code.PLANAR_ONLY, Code.MOVING_SCENE)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here), make_world(there)))


def _paste_poster(photo: TrialImage, view: TrialImage) -> TrialImage:
    """The view of a poster in the middle of the photograph, over a fifth of it."""
    height, width = (round(0.45 * side) for side in photo.image.shape[:2])
    small = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = round(0.28 * photo.image.shape[1]), round(0.28 * photo.image.shape[0])
    return replace(
        photo,
        image=perturbations.paste_patch(photo.image, small, perturbations.make_ellipse_mask(height, width), left, top),
    )
