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
from splatnode.recon.evaluate.stability import warps
from splatnode.recon.evaluate.stability.case import Case, Row, either
from splatnode.recon.evaluate.stability.places import Photo, Sampler
from splatnode.recon.evaluate.truth import TrueCamera

Array = npt.NDArray[np.float64]

COUNTS = (3, 6, 12)  # images of a trial
SETTINGS = ("nothing", "exif", "given")  # what is told of the lens
_KEYSTONE_DEG = 8.0  # pitch that a keystone correction takes out
_STABILISED = 0.05  # by which a stabiliser moves the crop at most, of each side


@dataclass(frozen=True)
class Kind:
    """One way to break an assumption; `change` draws what it needs from the generator."""

    name: str
    change: Callable[[Sequence[Photo], np.random.Generator], list[Photo]]
    settings: tuple[str, ...] = SETTINGS


def with_intrinsics(photos: Sequence[Photo], setting: str) -> list[Photo]:
    """The photographs with what `setting` tells of their true lenses; EXIF knows the focal length alone."""
    if setting == "nothing":
        return [replace(photo, intrinsics=None) for photo in photos]
    told = []
    for photo in photos:
        height, width = photo.image.shape[:2]
        K = _camera_of(photo).K_for(width, height)
        fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        if setting == "exif":
            told.append(replace(photo, intrinsics=Intrinsics(width, height, fx, fx, width / 2, height / 2, "exif")))
        else:
            told.append(replace(photo, intrinsics=Intrinsics(width, height, fx, fy, cx, cy, "given")))
    return told


def through(photo: Photo, homography: Array, mark: str, T_camera_turned: Array | None = None) -> Photo:
    """The photograph through `homography` (3, 3), at its size, and the camera that shows it so.

    `T_camera_turned` (3, 3) is the part of the homography that turns the camera: K' R K^-1 with R its transpose.
    """
    height, width = photo.image.shape[:2]
    camera = _camera_of(photo)
    image = warps.warped(photo.image, homography, width, height)
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


def zoomed(photo: Photo, factor: float, across: float = 0.0, down: float = 0.0) -> Photo:
    """Enlarged about a point beside the middle by these shares of the sides, which then is in the middle."""
    height, width = photo.image.shape[:2]
    middle = np.array([width / 2, height / 2])
    source = middle + np.array([across * width, down * height])
    homography = np.diag([factor, factor, 1.0])
    homography[:2, 2] = middle - factor * source
    return through(photo, homography, f"zoom{factor:g},{across:.3f},{down:.3f}")


def squeezed(photo: Photo, across: float) -> Photo:
    """With a width of `across` times its own, so that pixels are not square."""
    height, width = photo.image.shape[:2]
    size = max(1, round(across * width)), height
    image = cv2.resize(photo.image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    camera = TrueCamera(_camera_of(photo).T_world_camera, _camera_of(photo).K_for(*size), *size)
    intrinsics = photo.intrinsics and photo.intrinsics.resized(*size)
    return replace(photo, name=f"squeezed_{photo.name}", image=image, camera=camera, intrinsics=intrinsics)


def keystone_corrected(photo: Photo, pitch_deg: float) -> Photo:
    """Upright lines made parallel as an editor does it: the camera turned level, its picture moved to the middle."""
    height, width = photo.image.shape[:2]
    K = _camera_of(photo).K_for(width, height)
    turn = np.asarray(cv2.Rodrigues(np.radians([pitch_deg, 0.0, 0.0]))[0], np.float64)
    homography = K @ turn @ np.linalg.inv(K)
    middle = homography @ np.array([width / 2, height / 2, 1.0])
    recentre = np.eye(3)
    recentre[:2, 2] = np.array([width / 2, height / 2]) - middle[:2] / middle[2]
    return through(photo, recentre @ homography, f"keystone{pitch_deg:g}", turn.T)


def letterboxed(photo: Photo, share: float) -> Photo:
    """Shrunk to `share` of its sides, with black bars around it."""
    height, width = photo.image.shape[:2]
    homography = np.diag([share, share, 1.0])
    homography[:2, 2] = (1.0 - share) / 2 * np.array([width, height])
    changed = through(photo, homography, f"letterbox{share:g}")
    inside = np.zeros((height, width), bool)
    left, top = round((1.0 - share) / 2 * width), round((1.0 - share) / 2 * height)
    inside[top : height - top, left : width - left] = True
    return replace(changed, image=np.where(inside[..., None], changed.image, 0).astype(np.uint8))


def _one(photos: Sequence[Photo], rng: np.random.Generator, change: Callable[[Photo], Photo]) -> list[Photo]:
    chosen = int(rng.integers(len(photos)))
    return [change(photo) if index == chosen else photo for index, photo in enumerate(photos)]


def _one_zoomed(factor: float) -> Kind:
    return Kind(f"one zoomed {factor:g}", lambda photos, rng: _one(photos, rng, lambda photo: zoomed(photo, factor)))


def _cameras(*factors: float) -> Kind:
    """Photographs of several cameras of one size, in turns."""

    def change(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
        return [
            photo if factors[index % len(factors)] == 1.0 else zoomed(photo, factors[index % len(factors)])
            for index, photo in enumerate(photos)
        ]

    return Kind("cameras 1 : " + " : ".join(f"{factor:g}" for factor in factors[1:]), change)


def _breathing(share: float) -> Kind:
    def change(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
        # Enlarged by 1 to 1 + 2 share, so that nothing is missing at the border.
        return [zoomed(photo, float(1.0 + share + rng.uniform(-share, share))) for photo in photos]

    return Kind(f"breathing {100 * share:g} %", change)


def _film(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    factors = np.linspace(1.0, 1.1, len(photos))
    return [zoomed(photo, float(factor)) for photo, factor in zip(photos, factors, strict=True)]


def _stabilised(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    factor = 1.0 / (1.0 - 2.0 * _STABILISED)
    moved = rng.uniform(-_STABILISED, _STABILISED, (len(photos), 2))
    return [zoomed(photo, factor, float(x), float(y)) for photo, (x, y) in zip(photos, moved, strict=True)]


def _off_centre(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    x, y = (0.1 * sign for sign in rng.choice([-1.0, 1.0], 2))
    return _one(photos, rng, lambda photo: zoomed(photo, 1.25, float(x), float(y)))


def _all_off_centre(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    x, y = (float(0.04 * sign) for sign in rng.choice([-1.0, 1.0], 2))
    return [zoomed(photo, 1.1, x, y) for photo in photos]


def _bent(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    return _one(photos, rng, lambda photo: replace(warps.distorted(photo, -0.15), name=f"bent_{photo.name}"))


def _squeezed_all(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    return [squeezed(photo, 0.75) for photo in photos]


def _wrong_fx(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    return [
        replace(photo, intrinsics=photo.intrinsics and replace(photo.intrinsics, fx=1.05 * photo.intrinsics.fx))
        for photo in photos
    ]


def _wrong_principal_point(photos: Sequence[Photo], rng: np.random.Generator) -> list[Photo]:
    x, y = 0.04 * rng.choice([-1.0, 1.0], 2)
    changed = []
    for photo in photos:
        given = photo.intrinsics
        if given is not None:
            given = replace(given, cx=given.cx + float(x) * given.width, cy=given.cy + float(y) * given.height)
        changed.append(replace(photo, intrinsics=given))
    return changed


KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("clean", lambda photos, rng: list(photos)),
        *(_one_zoomed(factor) for factor in (1.05, 1.1, 1.3, 2.0)),
        _cameras(1.0, 1.02),
        _cameras(1.0, 1.06),
        _cameras(1.0, 1.12),
        _cameras(1.0, 1.5),
        _cameras(1.0, 1.1, 1.25),
        _breathing(0.01),
        _breathing(0.02),
        Kind("zooming film", _film),
        Kind("letterbox", lambda photos, rng: _one(photos, rng, lambda photo: letterboxed(photo, 0.75))),
        Kind("one off-centre crop", _off_centre),
        Kind("all off-centre crops", _all_off_centre),
        Kind("one keystone", lambda photos, rng: _one(photos, rng, lambda p: keystone_corrected(p, _KEYSTONE_DEG))),
        Kind("all keystone", lambda photos, rng: [keystone_corrected(photo, _KEYSTONE_DEG) for photo in photos]),
        Kind("one distorted", _bent),
        Kind("stabilised", _stabilised),
        Kind("pixels not square", _squeezed_all, ("nothing",)),
        Kind("wrong fx", _wrong_fx, ("given",)),
        Kind("wrong principal point", _wrong_principal_point, ("given",)),
    )
}


def _row(kind: Kind) -> Row:
    """Seeds take turns through the numbers of images and what is told."""

    def make(sampler: Sampler) -> Case:
        count, setting = COUNTS[sampler.seed % 3], kind.settings[sampler.seed // 3 % len(kind.settings)]
        photos = kind.change(with_intrinsics(sampler.photos(count), setting), sampler.rng)
        return either(photos, f"{kind.name}, {setting} told")

    return Row(31, f"lens: {kind.name}", make)


ROWS = tuple(_row(kind) for kind in KINDS.values() if kind.name != "clean")


def _camera_of(photo: Photo) -> TrueCamera:
    if photo.camera is None:
        raise ValueError(f"{photo.name} must have a true camera")
    return photo.camera
