"""Query images whose lens is not the scene's: what was done to a held-out image, and the camera that it has then."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))  # in which an off-centre crop lies


@dataclass(frozen=True, eq=False)
class Query:
    """A warped image with its intrinsics. The pose is that of the image it was made of."""

    image: Image  # (H, W, 3) RGB
    K: Array | None  # (3, 3) for `image`, centre of the top-left pixel at (0.5, 0.5); None: no pinhole sees all of it
    mirrored: bool = False  # no camera takes such an image


Warp = Callable[[Image, Array, int], Query]  # of an image, its K and its number, which chooses among corners


def stretch(image: Image, K: Array, scale: tuple[float, float], offset: tuple[float, float]) -> Query:
    """The image of the same size in which pixel p lies at scale * p + offset; black where nothing is."""
    height, width = image.shape[:2]
    S = np.array([[scale[0], 0.0, offset[0]], [0.0, scale[1], offset[1]], [0.0, 0.0, 1.0]])
    at = S[:2].copy()
    at[:, 2] += 0.5 * np.array(scale) - 0.5  # OpenCV's pixels have their centre at whole numbers
    if min(scale) < 1.0:  # INTER_AREA does not exist for warps: remove what would alias
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1.0 / min(scale) ** 2 - 1.0)), np.uint8)
    warped = cv2.warpAffine(image, at, (width, height), flags=cv2.INTER_CUBIC)
    return Query(np.asarray(warped, np.uint8), S @ K)


def keep(image: Image, K: Array, _number: int) -> Query:
    return Query(image, K)


def zoom(image: Image, K: Array, _number: int, factor: float, aspect: float = 1.0) -> Query:
    """The middle of the image, enlarged to its size; `aspect` is how much more it is enlarged across than down."""
    scale = factor * aspect, factor
    middle = 0.5 * (1.0 - scale[0]) * image.shape[1], 0.5 * (1.0 - scale[1]) * image.shape[0]
    return stretch(image, K, scale, middle)


def crop_corner(image: Image, K: Array, number: int, share: float) -> Query:
    """The part of the image at one of its corners, enlarged to its size."""
    corner, scale = CORNERS[number % len(CORNERS)], 1.0 / share
    offset = (1.0 - scale) * corner[0] * image.shape[1], (1.0 - scale) * corner[1] * image.shape[0]
    return stretch(image, K, (scale, scale), offset)


def cut(image: Image, K: Array, number: int, share: float, centred: bool) -> Query:
    """A part of the image, its pixels as they are."""
    height, width = (round(share * side) for side in image.shape[:2])
    corner = (0.5, 0.5) if centred else CORNERS[number % len(CORNERS)]
    left, top = round(corner[0] * (image.shape[1] - width)), round(corner[1] * (image.shape[0] - height))
    shifted = K.copy()
    shifted[:2, 2] -= left, top
    return Query(np.ascontiguousarray(image[top : top + height, left : left + width]), shifted)


def mirror(image: Image, _K: Array, _number: int) -> Query:
    return Query(np.ascontiguousarray(image[:, ::-1]), None, mirrored=True)


def squeeze(image: Image, K: Array, _number: int, share: float) -> Query:
    """The whole image in `share` of its width, as where a recording's pixels are not square."""
    height, width = image.shape[:2]
    narrow = round(share * width)
    squeezed = cv2.resize(image, (narrow, height), interpolation=cv2.INTER_AREA)
    return Query(np.asarray(squeezed, np.uint8), np.diag([narrow / width, 1.0, 1.0]) @ K)


def bend(image: Image, K: Array, _number: int, k1: float) -> Query:
    """The image through a lens with the radial coefficient `k1`, which keeps the pose and the focal length."""
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    bent = np.stack([(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(bent, np.eye(3), np.array([k1, 0.0, 0.0, 0.0])).reshape(height, width, 2)
    at = (straight * np.diag(K)[:2] + K[:2, 2] - 0.5).astype(np.float32)
    warped = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
    return Query(np.asarray(warped, np.uint8), K)


def shear(image: Image, K: Array, _number: int, by: float) -> Query:
    """The image with its rows shifted, `by` pixels across for one down: as by a rolling shutter in a turn."""
    height, width = image.shape[:2]
    moved = np.array([[1.0, by, -by * (K[1, 2] - 0.5)], [0.0, 1.0, 0.0]])
    return Query(np.asarray(cv2.warpAffine(image, moved, (width, height), flags=cv2.INTER_CUBIC), np.uint8), K)


def blur(image: Image, K: Array, _number: int, share: float) -> Query:
    """Motion blur across `share` of the width."""
    length = max(3, round(share * image.shape[1]))
    kernel = np.full((1, length), 1.0 / length)
    return Query(np.asarray(cv2.filter2D(image, -1, kernel), np.uint8), K)


def collage(image: Image, _K: Array, number: int) -> Query:
    """Two parts of the image that change places: both have its pose, but no pinhole camera sees both."""
    axis = number % 2
    half = image.shape[axis] // 2
    first, second = np.split(image[: 2 * half] if axis == 0 else image[:, : 2 * half], 2, axis=axis)
    return Query(np.ascontiguousarray(np.concatenate([second, first], axis=axis)), None)


ZOOMS = (1.02, 1.05, 1.1, 1.2, 1.3, 1.6, 2.0, 2.5, 3.0)
CLEAN = "clean"
WARPS: Mapping[str, Warp] = {
    CLEAN: keep,
    **{f"zoom {factor}": partial(zoom, factor=factor) for factor in ZOOMS},
    "crop corner 0.8": partial(crop_corner, share=0.8),
    "cut middle 0.8": partial(cut, share=0.8, centred=True),
    "cut corner 0.8": partial(cut, share=0.8, centred=False),
    "mirror": mirror,
    "letterbox 0.75": partial(zoom, factor=0.75),
    "stretch 1.1": partial(zoom, factor=1.0, aspect=1.1),
    "squeeze 0.75": partial(squeeze, share=0.75),
    "bend -0.15": partial(bend, k1=-0.15),
    "bend 0.1": partial(bend, k1=0.1),
    **{f"shear {by}": partial(shear, by=by) for by in (0.01, -0.02, 0.04)},
    "blur 0.02": partial(blur, share=0.02),
    "collage": collage,
}
# Kinds that the bar is set for; the others show that what is not expected fails safely.
BAR = tuple(name for name in WARPS if name.split()[0] in ("zoom", "crop", "cut", "mirror"))
