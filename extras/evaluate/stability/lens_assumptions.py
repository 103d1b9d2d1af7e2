"""Row 31: images that break what a reconstruction assumes of lenses: one lens for all, square pixels, a centred crop.

Each kind changes undistorted photographs and says which camera is true of what they then show. What a reconstruction is
told stays as it was before the change, as EXIF and a calibration do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability import perturbations
from splatnode.extras.evaluate.stability.case import MatrixRow, TrialCase, make_either_case
from splatnode.extras.evaluate.stability.perturbations import Sampler, TrialImage

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
    told = []
    for photo in photos:
        height, width = photo.image.shape[:2]
        K = _require_camera(photo).K_for(width, height)
        fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        if setting == "exif":
            told.append(replace(photo, intrinsics=Intrinsics(width, height, fx, fx, width / 2, height / 2, "exif")))
        else:
            told.append(replace(photo, intrinsics=Intrinsics(width, height, fx, fy, cx, cy, "given")))
    return told


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
