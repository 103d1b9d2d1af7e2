"""Rows 12, 13, 15 to 18, 23 and 31: what light, sensor, shutter and passers-by do to the pixels, and other lenses.

Row 31 has images that break what a reconstruction assumes of lenses: one lens for all, square pixels, a centred crop.
Each kind changes undistorted photographs and says which camera is true of what they then show. What a reconstruction is
told stays as it was before the change, as EXIF and a calibration do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.capture.masks import apply_mask
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability import perturbations
from splatnode.extras.evaluate.stability.perturbations import (
    Image,
    Sampler,
    TrialImage,
    generate_noise,
    make_patchwork,
    render_poster_views,
    render_turned_crops,
)
from splatnode.extras.evaluate.stability.trial import (
    MatrixRow,
    TrialCase,
    make_accept_case,
    make_either_case,
    make_frames,
    make_refuse_case,
    row,
)
from splatnode.recon.result.verdict import Code


@row(12, "epsilon noise")
def epsilon_noise(sampler: Sampler) -> TrialCase:
    rng, sigma = sampler.rng, 1 + sampler.seed % 3
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.add_noise(image, sigma, rng))
    return make_accept_case(photos, f"{sigma} grey levels of noise")


@row(13, "texture lost in part")
def partly_flat(sampler: Sampler) -> TrialCase:
    share, side = (0.2, 0.3, 0.4)[sampler.seed % 3], 1 + 2 * int(sampler.rng.integers(2))
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.remove_texture(image, share, side))
    return make_accept_case(photos, f"{share:.0%} without texture", Code.OK_PARTIAL)


@row(13, "texture mostly lost")
def mostly_flat(sampler: Sampler) -> TrialCase:
    share, side = (0.5, 0.75)[sampler.seed % 2], 1 + 2 * int(sampler.rng.integers(2))
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.remove_texture(image, share, side))
    fitting = (Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.PLANAR_ONLY)
    return make_either_case(photos, f"{share:.0%} without texture", *fitting)


@row(13, "white wall")
def white_wall(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = [TrialImage(f"wall_{i}.png", perturbations.render_white_wall(480, 640, rng), None) for i in range(4)]
    return make_refuse_case(photos, "", Code.LOW_TEXTURE, Code.TOO_FEW_VIEWS)


@row(15, "motion blur of one frame")
def one_blurred(sampler: Sampler) -> TrialCase:
    photos, length = sampler.load_images(5), (5, 11, 21)[sampler.seed % 3]
    angle = float(sampler.rng.uniform(0, 180))
    photos[2] = replace(photos[2], image=perturbations.apply_motion_blur(photos[2].image, length, angle))
    fitting = (Code.OK_PARTIAL, Code.OUTLIER_VIEW, Code.BLUR)
    return make_accept_case(photos, f"one smeared over {length} px", *fitting)


@row(15, "motion blur of all frames")
def all_blurred(sampler: Sampler) -> TrialCase:
    length, angles = (5, 11, 21)[sampler.seed % 3], iter(sampler.rng.uniform(0, 180, 4))
    photos = _change_images(
        sampler.load_images(4), lambda image: perturbations.apply_motion_blur(image, length, float(next(angles)))
    )
    fitting = (Code.BLUR, Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    return make_either_case(photos, f"4 frames smeared over {length} px", *fitting, Code.TOO_FEW_VIEWS)


@row(16, "exposure and white balance")
def exposure(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = _change_images(
        sampler.load_images(4),
        lambda image: perturbations.change_exposure(
            image, float(2.0 ** rng.uniform(-1, 1)), float(rng.uniform(0.8, 1.25)), rng.uniform(0.8, 1.2, 3)
        ),
    )
    note = "gain 0.5 to 2, gamma, 20 % white balance"
    return make_accept_case(photos, note, Code.OK_PARTIAL)


@row(17, "lens and sensor")
def sensor_degradation(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    name, change = (
        ("60 % vignetting", lambda image: perturbations.apply_vignetting(image, 0.6)),
        ("JPEG of quality 20", lambda image: perturbations.compress_jpeg(image, 20)),
        ("low light", lambda image: perturbations.simulate_low_light(image, 400.0, rng)),
    )[sampler.seed % 3]
    return make_accept_case(_change_images(sampler.load_images(4), change), f"{name}")


@row(18, "moving object")
def moving_object(sampler: Sampler) -> TrialCase:
    """A cut-out of another place that moves by itself, of growing size."""
    share = (0.05, 0.15, 0.3)[sampler.seed % 3]
    photos = _add_passer_by(sampler, sampler.load_images(5), share)
    note, fitting = f"{share:.0%} covered", (Code.OK_PARTIAL, Code.MOVING_SCENE)
    return (make_either_case if share > 0.2 else make_accept_case)(photos, note, *fitting)


@row(18, "another thing in each frame")
def passers_by(sampler: Sampler) -> TrialCase:
    """Cut-outs of other photographs, one a frame: nothing matches them."""
    share = (0.05, 0.15, 0.3)[sampler.seed % 3]
    photos = sampler.load_images(5)
    things = [sampler.load_images(1, photos)[0].image for _ in photos]
    covered = [photo for photo, _ in _add_things(sampler, photos, things, share)]
    note, fitting = f"{share:.0%} covered", (Code.OK_PARTIAL, Code.MOVING_SCENE)
    return (make_either_case if share > 0.2 else make_accept_case)(covered, note, *fitting)


@row(18, "wrong masks")
def wrong_masks(sampler: Sampler) -> TrialCase:
    """A thing moves; the masks are those of the next frame, or are inverted: they leave nothing but the thing."""
    photos = sampler.load_images(5)
    things = [sampler.load_images(1, photos)[0].image] * len(photos)
    covered = _add_things(sampler, photos, things, share=0.15)
    free = [~thing for _, thing in covered]
    inverted = sampler.seed % 2 == 1
    masks = [~mask for mask in free] if inverted else [*free[1:], free[0]]
    changed = [photo for photo, _ in covered]
    hidden = tuple(apply_mask(frame, mask) for frame, mask in zip(make_frames(changed), masks, strict=True))
    fitting = Code.NO_PARALLAX, Code.PLANAR_ONLY, Code.NO_OVERLAP, Code.MOVING_SCENE, Code.LOW_TEXTURE, Code.AMBIGUOUS
    if inverted:
        return replace(
            make_refuse_case(changed, "masks that leave only what moves", *fitting), source=partial(list, hidden)
        )
    case = make_either_case(changed, "each with the mask of the next", Code.MOVING_SCENE, Code.AMBIGUOUS)
    return replace(case, source=partial(list, hidden))


@row(18, "own body in view")
def own_body(sampler: Sampler) -> TrialCase:
    """The robot's bumper: the lowest rows of every frame are the same."""
    photos, share = sampler.load_images(4), (0.1, 0.2)[sampler.seed % 2]
    body = sampler.load_images(1, photos)[0].image

    def paste_body(image: Image) -> Image:
        rows, width = round(share * image.shape[0]), min(image.shape[1], body.shape[1])
        bumper = body[-rows:, :width]
        return perturbations.paste_patch(image, bumper, np.ones((rows, width), np.float32), 0, image.shape[0] - rows)

    note = f"the lowest {share:.0%} are the robot itself"
    return make_accept_case(_change_images(photos, paste_body), note, Code.OK_PARTIAL, Code.MOVING_SCENE)


@row(23, "reflection of a lamp")
def highlight(sampler: Sampler) -> TrialCase:
    """It moves with the camera, and over the scene."""
    rng = sampler.rng
    where = rng.uniform(0.3, 0.7, 2)
    photos = _change_images(
        sampler.load_images(4),
        lambda image: perturbations.add_highlight(image, *(where + rng.uniform(-0.05, 0.05, 2)), size=0.2),
    )
    return make_accept_case(photos, "a highlight of a fifth of the width")


def _change_images(photos: Sequence[TrialImage], change: Callable[[Image], Image]) -> list[TrialImage]:
    return [replace(photo, image=change(photo.image)) for photo in photos]


def _add_passer_by(sampler: Sampler, photos: Sequence[TrialImage], share: float) -> list[TrialImage]:
    """One ellipse of another place's photograph over all frames."""
    cutout = sampler.load_images(1, photos)[0].image
    return [photo for photo, _ in _add_things(sampler, photos, [cutout] * len(photos), share)]


def _add_things(
    sampler: Sampler, photos: Sequence[TrialImage], things: Sequence[Image], share: float
) -> list[tuple[TrialImage, npt.NDArray[np.bool_]]]:
    """The photographs, over each an ellipse of its thing, covering `share` of it, on a way of its own; where it is."""
    rng = sampler.rng
    way = np.cumsum(rng.normal(scale=0.12, size=(len(photos), 2)), axis=0) + rng.uniform(0.3, 0.7, 2)
    result = []
    for photo, cutout, (across, down) in zip(photos, things, np.clip(way, 0.2, 0.8), strict=True):
        height, width = photo.image.shape[:2]
        side = np.sqrt(share * 4 / np.pi)  # of the frame's sides, so that the ellipse covers the share
        size = min(round(side * height), cutout.shape[0]), min(round(side * width), cutout.shape[1])
        left, top = round(across * width - size[1] / 2), round(down * height - size[0] / 2)
        patch = cutout[: size[0], : size[1]]
        ellipse = perturbations.make_ellipse_mask(*size)
        covered = replace(photo, image=perturbations.paste_patch(photo.image, patch, ellipse, left, top))
        black, white = np.zeros_like(photo.image), np.full((*size, 3), 255, np.uint8)
        result.append((covered, perturbations.paste_patch(black, white, ellipse, left, top).max(2) > 0))
    return result


# Rows 7, 8 and 11: photographs in which there is no depth to find, or no place at all.

_NOTHING = (Code.NO_OVERLAP, Code.LOW_TEXTURE, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)


@row(7, "pure rotation")
def pure_rotation(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    count = (3, 5)[sampler.seed % 2]
    yaws, pitches = sampler.rng.uniform(-14.0, 14.0, (2, count))
    crops = render_turned_crops(photo, yaws, pitches)
    # The true centres are one point, so that no published scene is right.
    return make_refuse_case(crops, "turned crops of one photograph", Code.NO_PARALLAX)


@row(7, "recorded rotation")
def tripod_rotation(sampler: Sampler) -> TrialCase:
    """A camera on a tripod, where there is a recording of one; else turned crops of a photograph of the built-in."""
    turned = sampler.places.turned
    if not turned:
        (photo,) = sampler.load_images(1)
        crops = render_turned_crops(photo, np.linspace(-9.0, 9.0, 4), np.zeros(4))
        return make_refuse_case(crops, "crops turned to the side", Code.NO_PARALLAX)
    place = turned[sampler.seed % len(turned)]
    chosen = sorted(sampler.rng.choice(len(place.names), 4, replace=False).tolist())
    return make_refuse_case(place.load_images(chosen), "recorded", Code.NO_PARALLAX, Code.NO_OVERLAP)


@row(8, "poster")
def poster(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    count = (3, 5)[sampler.seed % 2]
    views = render_poster_views(photo, np.linspace(-25.0, 25.0, count), distance=sampler.rng.uniform(1.0, 1.3))
    return make_refuse_case(views, "views of one photograph", Code.PLANAR_ONLY)


@row(11, "every frame from elsewhere")
def one_frame_per_scene(sampler: Sampler) -> TrialCase:
    """Every frame is of a place that is not in the truth: whatever is published is wrong."""
    photos = sampler.load_one_per_scene(4)
    views = [
        replace(photo, image=np.ascontiguousarray(photo.image[:, :: (-1) ** number]), camera=None)
        for number, photo in enumerate(photos)
    ]
    return make_refuse_case(views, "one of each, every second mirrored", *_NOTHING)


@row(11, "pure noise")
def pure_noise(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    frames = [TrialImage(f"noise_{i}.png", generate_noise(480, 640, rng), None) for i in range(4)]
    return make_refuse_case(frames, "", *_NOTHING)


@row(11, "patchwork")
def patches(sampler: Sampler) -> TrialCase:
    """Pieces of real photographs without an order: features everywhere, matches here and there, and no place."""
    images = [photo.image for photo in sampler.load_one_per_scene(4)]
    rng = sampler.rng
    frames = [TrialImage(f"patchwork_{i}.png", make_patchwork(images, 600, 800, 6, rng), None) for i in range(4)]
    return make_refuse_case(frames, "36 pieces each of 4 photographs", *_NOTHING, Code.MOVING_SCENE)


Array = npt.NDArray[np.float64]

COUNTS = (3, 6, 12)  # images of a trial
SETTINGS = ("nothing", "exif", "given")  # what is told of the lens
_KEYSTONE_DEG = 8.0  # pitch that a keystone correction takes out
_STABILISED = 0.05  # by which a stabiliser moves the crop at most, of each side


@dataclass(frozen=True)
class AssumptionBreak:
    """One way to break an assumption; `change` draws what it needs from the generator."""

    name: str
    change: Callable[[Sequence[TrialImage], np.random.Generator], list[TrialImage]]
    settings: tuple[str, ...] = SETTINGS


def set_intrinsics(photos: Sequence[TrialImage], setting: str) -> list[TrialImage]:
    """The photographs with what `setting` tells of their true lenses; EXIF knows the focal length alone."""
    if setting == "nothing":
        return [replace(photo, intrinsics=None) for photo in photos]
    trial_images = []
    for photo in photos:
        height, width = photo.image.shape[:2]
        K = _require_camera(photo).K_for(width, height)
        fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        if setting == "exif":
            trial_images.append(
                replace(photo, intrinsics=Intrinsics(width, height, fx, fx, width / 2, height / 2, "exif"))
            )
        else:
            trial_images.append(replace(photo, intrinsics=Intrinsics(width, height, fx, fy, cx, cy, "given")))
    return trial_images


def apply_homography(
    photo: TrialImage, homography: Array, mark: str, T_camera_turned: Array | None = None
) -> TrialImage:
    """The photograph through `homography` (3, 3), at its size, and the camera that shows it so.

    `T_camera_turned` (3, 3) is the part of the homography that turns the camera: K' R K^-1 with R its transpose.
    """
    height, width = photo.image.shape[:2]
    camera = _require_camera(photo)
    image = perturbations.warp_image(photo.image, homography, width, height)
    K, T_world_camera = camera.K_for(width, height), camera.T_world_camera.copy()
    if T_camera_turned is None:
        K = homography @ K
    else:
        K = homography @ K @ T_camera_turned
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ T_camera_turned
    return replace(
        photo,
        name=f"{mark}_{photo.name}",
        image=image,
        camera=TrueCamera(T_world_camera, K / K[2, 2], width, height),
    )


def zoom_image(photo: TrialImage, factor: float, across: float = 0.0, down: float = 0.0) -> TrialImage:
    """Enlarged about a point beside the middle by these shares of the sides, which then is in the middle."""
    height, width = photo.image.shape[:2]
    middle = np.array([width / 2, height / 2])
    source = middle + np.array([across * width, down * height])
    homography = np.diag([factor, factor, 1.0])
    homography[:2, 2] = middle - factor * source
    return apply_homography(photo, homography, f"zoom{factor:g},{across:.3f},{down:.3f}")


def squeeze_width(photo: TrialImage, across: float) -> TrialImage:
    """Scales the width by `across`, so that pixels are not square."""
    height, width = photo.image.shape[:2]
    size = max(1, round(across * width)), height
    image = cv2.resize(photo.image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    camera = TrueCamera(_require_camera(photo).T_world_camera, _require_camera(photo).K_for(*size), *size)
    intrinsics = photo.intrinsics and photo.intrinsics.resized(*size)
    return replace(photo, name=f"squeezed_{photo.name}", image=image, camera=camera, intrinsics=intrinsics)


def correct_keystone(photo: TrialImage, pitch_deg: float) -> TrialImage:
    """Upright lines made parallel as an editor does it: the camera turned level, its picture moved to the middle."""
    height, width = photo.image.shape[:2]
    K = _require_camera(photo).K_for(width, height)
    turn = np.asarray(cv2.Rodrigues(np.radians([pitch_deg, 0.0, 0.0]))[0], np.float64)
    homography = K @ turn @ np.linalg.inv(K)
    middle = homography @ np.array([width / 2, height / 2, 1.0])
    recentre = np.eye(3)
    recentre[:2, 2] = np.array([width / 2, height / 2]) - middle[:2] / middle[2]
    return apply_homography(photo, recentre @ homography, f"keystone{pitch_deg:g}", turn.T)


def letterbox_image(photo: TrialImage, share: float) -> TrialImage:
    """Shrunk to `share` of its sides, with black bars around it."""
    height, width = photo.image.shape[:2]
    homography = np.diag([share, share, 1.0])
    homography[:2, 2] = (1.0 - share) / 2 * np.array([width, height])
    changed = apply_homography(photo, homography, f"letterbox{share:g}")
    inside = np.zeros((height, width), bool)
    left, top = round((1.0 - share) / 2 * width), round((1.0 - share) / 2 * height)
    inside[top : height - top, left : width - left] = True
    return replace(changed, image=np.where(inside[..., None], changed.image, 0).astype(np.uint8))


def _change_one(
    photos: Sequence[TrialImage], rng: np.random.Generator, change: Callable[[TrialImage], TrialImage]
) -> list[TrialImage]:
    chosen = int(rng.integers(len(photos)))
    return [change(photo) if index == chosen else photo for index, photo in enumerate(photos)]


def _make_zoom_kind(factor: float) -> AssumptionBreak:
    return AssumptionBreak(
        f"one zoomed {factor:g}", lambda photos, rng: _change_one(photos, rng, lambda photo: zoom_image(photo, factor))
    )


def _make_camera_mix_kind(*factors: float) -> AssumptionBreak:
    """Photographs of several cameras of one size, in turns."""

    def change(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
        return [
            photo if factors[index % len(factors)] == 1.0 else zoom_image(photo, factors[index % len(factors)])
            for index, photo in enumerate(photos)
        ]

    return AssumptionBreak("cameras 1 : " + " : ".join(f"{factor:g}" for factor in factors[1:]), change)


def _make_breathing_kind(share: float) -> AssumptionBreak:
    def change(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
        # Enlarged by 1 to 1 + 2 share, so that nothing is missing at the border.
        return [zoom_image(photo, float(1.0 + share + rng.uniform(-share, share))) for photo in photos]

    return AssumptionBreak(f"breathing {100 * share:g} %", change)


def _zoom_film(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    factors = np.linspace(1.0, 1.1, len(photos))
    return [zoom_image(photo, float(factor)) for photo, factor in zip(photos, factors, strict=True)]


def _stabilise(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    factor = 1.0 / (1.0 - 2.0 * _STABILISED)
    moved = rng.uniform(-_STABILISED, _STABILISED, (len(photos), 2))
    return [zoom_image(photo, factor, float(x), float(y)) for photo, (x, y) in zip(photos, moved, strict=True)]


def _crop_one_off_centre(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    x, y = (0.1 * sign for sign in rng.choice([-1.0, 1.0], 2))
    return _change_one(photos, rng, lambda photo: zoom_image(photo, 1.25, float(x), float(y)))


def _crop_all_off_centre(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    x, y = (float(0.04 * sign) for sign in rng.choice([-1.0, 1.0], 2))
    return [zoom_image(photo, 1.1, x, y) for photo in photos]


def _distort_one(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return _change_one(
        photos, rng, lambda photo: replace(perturbations.distort_image(photo, -0.15), name=f"bent_{photo.name}")
    )


def _squeeze_all(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return [squeeze_width(photo, 0.75) for photo in photos]


def _falsify_fx(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return [
        replace(photo, intrinsics=photo.intrinsics and replace(photo.intrinsics, fx=1.05 * photo.intrinsics.fx))
        for photo in photos
    ]


def _falsify_principal_point(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    x, y = 0.04 * rng.choice([-1.0, 1.0], 2)
    changed = []
    for photo in photos:
        given = photo.intrinsics
        if given is not None:
            given = replace(given, cx=given.cx + float(x) * given.width, cy=given.cy + float(y) * given.height)
        changed.append(replace(photo, intrinsics=given))
    return changed


KINDS: Mapping[str, AssumptionBreak] = {
    kind.name: kind
    for kind in (
        AssumptionBreak("clean", lambda photos, rng: list(photos)),
        *(_make_zoom_kind(factor) for factor in (1.05, 1.1, 1.3, 2.0)),
        _make_camera_mix_kind(1.0, 1.02),
        _make_camera_mix_kind(1.0, 1.06),
        _make_camera_mix_kind(1.0, 1.12),
        _make_camera_mix_kind(1.0, 1.5),
        _make_camera_mix_kind(1.0, 1.1, 1.25),
        _make_breathing_kind(0.01),
        _make_breathing_kind(0.02),
        AssumptionBreak("zooming film", _zoom_film),
        AssumptionBreak(
            "letterbox", lambda photos, rng: _change_one(photos, rng, lambda photo: letterbox_image(photo, 0.75))
        ),
        AssumptionBreak("one off-centre crop", _crop_one_off_centre),
        AssumptionBreak("all off-centre crops", _crop_all_off_centre),
        AssumptionBreak(
            "one keystone", lambda photos, rng: _change_one(photos, rng, lambda p: correct_keystone(p, _KEYSTONE_DEG))
        ),
        AssumptionBreak(
            "all keystone", lambda photos, rng: [correct_keystone(photo, _KEYSTONE_DEG) for photo in photos]
        ),
        AssumptionBreak("one distorted", _distort_one),
        AssumptionBreak("stabilised", _stabilise),
        AssumptionBreak("pixels not square", _squeeze_all, ("nothing",)),
        AssumptionBreak("wrong fx", _falsify_fx, ("given",)),
        AssumptionBreak("wrong principal point", _falsify_principal_point, ("given",)),
    )
}


# Kinds that were made after all numbers were fitted, which no number is fitted to.

_SHEARED = 0.05  # of the width: 30 ms of a pan by 100 degrees a second, where the picture spans 60
_STRETCHED = 0.12  # of the logarithm of the height


def _crop_to_squares(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    cropped = [perturbations.crop_to_square(photo, float(rng.uniform())) for photo in photos]
    return [replace(photo, name=f"square_{photo.name}") for photo in cropped]


def _crop_alike(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    left, top = rng.uniform(size=2).tolist()
    cropped = [perturbations.crop_image(photo, 0.75, left, top) for photo in photos]
    return [replace(photo, name=f"cropped_{photo.name}") for photo in cropped]


def _zoom_third(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    chosen = rng.permutation(len(photos))[: max(2, len(photos) // 3)].tolist()
    return [
        zoom_image(photo, float(rng.uniform(1.1, 1.8))) if index in chosen else photo
        for index, photo in enumerate(photos)
    ]


def _zoom_all(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return [zoom_image(photo, float(rng.uniform(1.0, 1.6))) for photo in photos]


def _zoom_one_aside(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    across, down = rng.uniform(-0.15, 0.15, 2).tolist()
    return _change_one(photos, rng, lambda photo: zoom_image(photo, 1.5, across, down))


def _shear_one(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    def shear(photo: TrialImage) -> TrialImage:
        return replace(perturbations.apply_rolling_shutter(photo, _SHEARED), name=f"sheared_{photo.name}")

    return _change_one(photos, rng, shear)


def change_shape(photo: TrialImage, down: float = 1.0, shear: float = 0.0) -> TrialImage:
    """Enlarged downwards by a factor, and sheared by `shear` pixels across for one down, about the middle."""
    height, width = photo.image.shape[:2]
    middle = np.array([[1.0, 0.0, width / 2], [0.0, 1.0, height / 2], [0.0, 0.0, 1.0]])
    shape = np.array([[1.0, shear, 0.0], [0.0, down, 0.0], [0.0, 0.0, 1.0]])
    return apply_homography(photo, middle @ shape @ np.linalg.inv(middle), f"shape{down:.4g},{shear:.4g}")


def _stretch_one(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    down = float(np.exp(rng.uniform(-_STRETCHED, _STRETCHED)))
    return _change_one(photos, rng, lambda photo: change_shape(photo, down))


def _stretch_all(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return [change_shape(photo, float(np.exp(rng.uniform(-_STRETCHED, _STRETCHED)))) for photo in photos]


def _shear_all(photos: Sequence[TrialImage], rng: np.random.Generator) -> list[TrialImage]:
    return [change_shape(photo, shear=float(rng.uniform(-_SHEARED, _SHEARED))) for photo in photos]


LATER_KINDS: Mapping[str, AssumptionBreak] = {
    kind.name: kind
    for kind in (
        KINDS["clean"],
        AssumptionBreak("squares", _crop_to_squares, ("nothing",)),
        AssumptionBreak("all cropped alike", _crop_alike, ("nothing",)),
        AssumptionBreak("a third zoomed", _zoom_third),
        AssumptionBreak("each zoomed", _zoom_all),
        AssumptionBreak("one zoomed 1.5, aside", _zoom_one_aside),
        AssumptionBreak("one sheared", _shear_one),
        AssumptionBreak("each sheared", _shear_all),
        AssumptionBreak("one stretched", _stretch_one),
        AssumptionBreak("each stretched", _stretch_all),
    )
}


def _make_row(kind: AssumptionBreak) -> MatrixRow:
    """Seeds take turns through the numbers of images and what is told."""

    def make(sampler: Sampler) -> TrialCase:
        count, setting = COUNTS[sampler.seed % 3], kind.settings[sampler.seed // 3 % len(kind.settings)]
        photos = kind.change(set_intrinsics(sampler.load_images(count), setting), sampler.rng)
        return make_either_case(photos, f"{kind.name}, {setting} told")

    return MatrixRow(31, f"lens: {kind.name}", make)


ROWS = tuple(_make_row(kind) for kind in KINDS.values() if kind.name != "clean")


def _require_camera(photo: TrialImage) -> TrueCamera:
    if photo.camera is None:
        raise ValueError(f"{photo.name} must have a true camera")
    return photo.camera
