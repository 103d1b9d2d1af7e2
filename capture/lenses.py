"""Lens models: from rays of the camera's frame to pixels of the picture and back, and frames without distortion.

OpenCV's radial-tangential lens has k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; without any it is a pinhole. The
equidistant fisheye has four terms k1 k2 k3 k4, as OpenCV's `fisheye` has it: a ray at the angle t from the camera's
axis meets the picture t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the principal point (Kannala and
Brandt, A Generic Camera Model and Calibration Method, 2006). OpenCV's functions know no skew: it is added to the
pixels that they give, and taken out of those that they get. Frames of a calibrated lens are resampled to the pinhole
with square pixels that recon models; the one of a fisheye holds what it sees, as far as a pinhole can.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import Frame, Intrinsics, RightImage, grey
from splatnode.capture.masks import Mask, fill_masked
from splatnode.capture.pose_files import binary_images, text_images
from splatnode.capture.process.config import MAX_BYTES, ConfigError, parse_yaml, record_of
from splatnode.capture.process.files import read_bounded, read_text
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text

Array = npt.NDArray[np.float64]

_COUNTS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV takes
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


def project_opencv(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame; not a number behind the camera."""
    ahead = rays[:, 2] > 0
    pixels = np.full((len(rays), 2), np.nan)
    if ahead.any():
        seen, _ = cv2.projectPoints(
            rays[ahead] / rays[ahead, 2:], np.zeros(3), np.zeros(3), camera_matrix(lens), coefficients(lens)
        )
        seen = seen[:, 0]
        seen[:, 0] += _skew_shift(seen[:, 1], lens)
        pixels[ahead] = seen + 0.5
    return pixels


def unproject_opencv(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays of the camera's frame that meet pixels (M, 2), found by iteration."""
    points = np.ascontiguousarray(pixels[:, None] - 0.5)
    points[..., 0] -= _skew_shift(points[..., 1], lens)
    at_depth_1 = cv2.undistortPoints(
        points, camera_matrix(lens), coefficients(lens), None, np.eye(3), np.eye(3), _CRITERIA
    )[:, 0]
    rays = np.column_stack([at_depth_1, np.ones(len(at_depth_1))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def coefficients(lens: Intrinsics) -> Array:
    """The lens' coefficients, filled up with zeros to a number that OpenCV takes."""
    values = lens.distortion or (0.0,)
    wanted = next(count for count in _COUNTS if count >= len(values))
    return np.array([*values, *[0.0] * (wanted - len(values))])


def camera_matrix(lens: Intrinsics) -> Array:
    """K (3, 3) as OpenCV has it: with the centre of the top-left pixel at (0, 0), and without skew."""
    return np.array([[lens.fx, 0.0, lens.cx - 0.5], [0.0, lens.fy, lens.cy - 0.5], [0.0, 0.0, 1.0]])


def _skew_shift(rows: npt.NDArray[Any], lens: Intrinsics) -> npt.NDArray[Any]:
    """How many pixels the skew moves to the right what is seen in `rows`; OpenCV's first row has its centre at 0."""
    return lens.fx * lens.skew / lens.fy * (rows - (lens.cy - 0.5)) if lens.skew else np.zeros_like(rows)


_BISECTIONS = 60  # of the angle: to the last bit of a double


def project_fisheye(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of the camera's frame, which may come from behind it.

    Not a number beyond the angle up to which the terms grow: no picture shows such a ray.
    """
    across = np.hypot(rays[:, 0], rays[:, 1])
    angles = np.arctan2(across, rays[:, 2])
    directions = rays[:, :2] / np.maximum(across, 1e-300)[:, None]
    pixels = directions * distort_angles(angles, lens)[:, None] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    pixels[angles > largest_angle(lens)] = np.nan
    return pixels


def unproject_fisheye(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays of the camera's frame that meet pixels (M, 2); not a number where no ray does."""
    points = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    radii = np.linalg.norm(points, axis=1)
    low, high = np.zeros(len(radii)), np.full(len(radii), largest_angle(lens))
    reached = radii <= distort_angles(high, lens)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        further = distort_angles(middle, lens) < radii
        low, high = np.where(further, middle, low), np.where(further, high, middle)
    angles = (low + high) / 2
    directions = points / np.maximum(radii, 1e-300)[:, None]
    rays = np.column_stack([directions * np.sin(angles)[:, None], np.cos(angles)])
    rays[~reached] = np.nan
    return rays


def distort_angles(angles: Array, lens: Intrinsics) -> Array:
    """How far from the principal point, in focal lengths, rays at `angles` (M,) from the axis, radians, are seen."""
    squared = angles**2
    growth = np.ones_like(angles)
    for power, term in enumerate(lens.distortion, start=1):
        growth = growth + term * squared**power
    return angles * growth


def largest_angle(lens: Intrinsics) -> float:
    """The angle from the axis, radians, up to which rays farther out are seen farther out; pi where all are."""
    derivative = [1.0, *((2 * power + 1) * term for power, term in enumerate(lens.distortion, start=1))]
    roots = np.roots(derivative[::-1])  # of the squared angle
    turns = [root.real for root in roots if abs(root.imag) < 1e-9 * abs(root) + 1e-12 and root.real > 0]
    return float(min(np.pi, *(np.sqrt(turn) for turn in turns))) if turns else float(np.pi)


_PROJECT = {"opencv": project_opencv, "fisheye": project_fisheye}
_UNPROJECT = {"opencv": unproject_opencv, "fisheye": unproject_fisheye}


def project(rays: Array, lens: Intrinsics) -> Array:
    """(M, 2) pixels of rays (M, 3) of any length, camera frame; the top-left pixel's centre is at (0.5, 0.5).

    Not a number where the lens does not see the ray.
    """
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise ValueError(f"rays must be (M, 3), got {rays.shape}")
    return _PROJECT[lens.model](np.asarray(rays, np.float64), lens)


def unproject(pixels: Array, lens: Intrinsics) -> Array:
    """(M, 3) unit rays, camera frame, of pixels (M, 2); not a number where no ray meets the pixel."""
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels must be (M, 2), got {pixels.shape}")
    return _UNPROJECT[lens.model](np.asarray(pixels, np.float64), lens)


# From the axis to each side. A pinhole spends 1 / cos^2 as many pixels on a degree there as in its middle: four times
# as many at 60 degrees, 33 times at 80.
MOST_DEG = 60.0
_LARGEST = math.tan(math.radians(MOST_DEG))  # the same at depth 1
_FURTHEST = math.atan(math.hypot(_LARGEST, _LARGEST))  # radians, of a corner that is kept


def wide_pinhole(name: str, given: Intrinsics) -> Intrinsics:
    """A pinhole with square pixels of as many pixels in all, which a fisheye's picture is resampled to.

    Left, right, up and down it sees as far as the fisheye does there, at most MOST_DEG from the axis. Raises
    ValueError for terms that turn back within the picture, and for a picture that is not around the axis.
    """
    corners = [(x - given.cx, y - given.cy) for x in (0, given.width) for y in (0, given.height)]
    furthest = max(math.hypot(x / given.fx, y / given.fy) for x, y in corners)
    turn = largest_angle(given)
    if turn < _FURTHEST and float(distort_angles(np.array(turn), given)) < furthest:
        raise ValueError(
            f"{name}: the fisheye terms {given.distortion} turn back {math.degrees(turn):.0f} degrees from the axis, "
            "within the picture, which no lens does. Calibrate again, with the pattern in the corners of the picture "
            "too, or give model: opencv if the terms are k1 k2 p1 p2."
        )
    if not (0 < given.cx < given.width and 0 < given.cy < given.height):
        raise ValueError(
            f"{name}: the principal point ({given.cx:g}, {given.cy:g}) of a fisheye must be within its picture of "
            f"{given.width} x {given.height} pixels. Give the calibration of the whole picture."
        )
    sides = [[0.0, given.cy], [given.width, given.cy], [given.cx, 0.0], [given.cx, given.height]]
    left, right, top, bottom = (_slope(ray) for ray in unproject(np.array(sides), given))
    focal = math.sqrt(given.width * given.height / ((left + right) * (top + bottom)))
    width, height = round(focal * (left + right)), round(focal * (top + bottom))
    return replace(
        given, width=width, height=height, fx=focal, fy=focal, cx=focal * left, cy=focal * top, distortion=(),
        model="opencv",
    )  # fmt: skip


def _slope(ray: np.ndarray) -> float:
    """How far from the axis a ray (3,) is at depth 1, at most as far as is kept; the most where no ray is."""
    across = math.hypot(ray[0], ray[1])
    return float(across / ray[2]) if ray[2] > 0 and across < _LARGEST * ray[2] else _LARGEST


SQUARE_TOLERANCE = 0.002  # relative difference of fx and fy below which pixels are square: a pixel in 500
_MIN_SIDE = 0.3  # shorter side of the rectangle that is kept, over the undistorted one's: less is no picture
_EDGE_PX = 0.01  # beyond the picture's border that still counts as seen: what rounding moves
_POINTS_A_SIDE = 33  # of the picture's border that are undistorted, to find the rectangle between them
_MAX_ROUND_TRIP_PX = 0.5  # from a border point to its ray and back: a model that folds over misses by many pixels


def undistort_frame(frame: Frame) -> Frame:
    """The frame without its lens' distortion and skew, with fx = fy; the frame itself where there is nothing to undo.

    It has the same size in pixels and shows the largest rectangle without unseen corners, whose pixels would be
    invented. A fisheye's has as many pixels in another shape, and a mask where the fisheye saw nothing
    (`wide_pinhole`). Its right image, if it has one, is taken the same way, since both have one lens. An aligned depth
    image keeps its pixels, and gets the lens that they were seen through. Raises
    ValueError for coefficients that fold the picture over, and for a skew that leaves no rectangle.
    """
    if frame.right is None:
        return _undistort_single(frame)
    seen = cv2.cvtColor(frame.right.image, cv2.COLOR_GRAY2RGB).astype(np.uint8, copy=False)
    left, right = (
        _undistort_single(replace(frame, right=None)),
        _undistort_single(replace(frame, image=seen, mask=None, right=None)),
    )
    return replace(left, right=RightImage(grey(right.image), frame.right.baseline))


def straighten_depth(frame: Frame) -> DepthImage | None:
    """The frame's depth image as `undistort_frame` leaves it: aligned with resampled pixels, it has their old lens."""
    given, depth = frame.intrinsics, frame.depth
    if depth is None or given is None or not is_resampled(frame):
        return depth
    return depth.apply_lens(given.resized(frame.width, frame.height))


def is_resampled(frame: Frame) -> bool:
    """Whether `undistort_frame` makes another picture of the frame: its lens is no pinhole with square, upright pixels.

    Any skew counts, since nothing that takes a pinhole reads one.
    """
    given = frame.intrinsics
    return given is not None and (given.model == "fisheye" or not _is_square_pinhole(given))


def _is_square_pinhole(given: Intrinsics) -> bool:
    return not any(given.distortion) and not given.skew and abs(given.fx / given.fy - 1.0) < SQUARE_TOLERANCE


def _undistort_single(frame: Frame) -> Frame:
    """As `undistort_frame`, of a frame without a right image."""
    given = frame.intrinsics
    if given is None:
        return frame
    given = given.resized(frame.width, frame.height)
    if frame.depth is not None:
        frame = replace(frame, depth=straighten_depth(frame))
    if given.model == "fisheye":
        return _undistort_fisheye(frame, given)
    if _is_square_pinhole(given):
        return frame if given == frame.intrinsics else replace(frame, intrinsics=given)
    terms = coefficients(given)
    left, top, right, bottom = _find_inner_rectangle(frame.name, given, terms)
    focal = max(frame.width / (right - left), frame.height / (bottom - top))
    pinhole = replace(
        given,
        fx=focal,
        fy=focal,
        cx=frame.width / 2 - focal * (left + right) / 2,
        cy=frame.height / 2 - focal * (top + bottom) / 2,
        distortion=(),
        skew=0.0,
    )
    columns, rows = cv2.initUndistortRectifyMap(
        camera_matrix(given),
        terms,
        np.eye(3),
        camera_matrix(pinhole),
        (frame.width, frame.height),
        cv2.CV_32FC1,
    )
    columns += _skew_shift(rows, given)
    image = cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = None if frame.mask is None else _remap_mask(frame.mask, columns, rows)
    return replace(frame, image=image.astype(np.uint8), intrinsics=pinhole, mask=mask)


def undistort_image(image: npt.NDArray[np.uint8], lens: Intrinsics | None) -> npt.NDArray[np.uint8]:
    """A photograph (H, W, 3), at any size, as `undistort_frame` shows it; itself without a lens. Raises likewise."""
    return image if lens is None else undistort_frame(Frame(0, "photograph", 0, image, lens)).image


def _remap_mask(mask: npt.NDArray[np.bool_], columns: npt.NDArray, rows: npt.NDArray) -> npt.NDArray[np.bool_]:
    """The mask (H, W) as its photograph is resampled; a pixel is used where all that it is made of is."""
    return cv2.remap(mask.astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 0.999


def _undistort_fisheye(frame: Frame, given: Intrinsics) -> Frame:
    """The frame as a pinhole would have seen it; what the fisheye did not see is filled and masked."""
    pinhole = wide_pinhole(frame.name, given)
    across, down = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    slopes = (across - pinhole.cx) / pinhole.fx, (down - pinhole.cy) / pinhole.fy
    rays = np.asarray(np.stack([*slopes, np.ones_like(across)], -1).reshape(-1, 3), np.float64)
    pixels = project(rays, given).reshape(*across.shape, 2)
    size = frame.width, frame.height
    used: Mask = np.all((pixels >= -_EDGE_PX) & (pixels <= np.array(size) + _EDGE_PX), axis=-1)
    columns, rows = np.moveaxis(np.nan_to_num(pixels - 0.5, nan=-1.0), -1, 0).astype(np.float32)
    image = cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)
    if frame.mask is not None:
        used = used & _remap_mask(frame.mask, columns, rows)
    if used.all():
        return replace(frame, image=image, intrinsics=pinhole, mask=None)
    return replace(frame, image=fill_masked(image, used), intrinsics=pinhole, mask=used)


def _find_inner_rectangle(name: str, given: Intrinsics, coefficients: Array) -> tuple[float, float, float, float]:
    """Left, top, right and bottom, at depth 1, of the largest upright rectangle of rays that the picture has.

    Raises ValueError where the distortion folds the picture over, and where the skew leaves no rectangle.
    """
    across, down = (np.linspace(0.0, side, _POINTS_A_SIDE) - 0.5 for side in (given.width, given.height))
    ends = [
        np.stack([np.full_like(down, across[0]), down], 1),
        np.stack([across, np.full_like(across, down[0])], 1),
        np.stack([np.full_like(down, across[-1]), down], 1),
        np.stack([across, np.full_like(across, down[-1])], 1),
    ]
    for side in ends:
        side[:, 0] -= _skew_shift(side[:, 1], given)
    matrix = camera_matrix(given)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    straight = [
        cv2.undistortPoints(side[:, None], matrix, coefficients, None, np.eye(3), np.eye(3), criteria)[:, 0]
        for side in ends
    ]
    again = [
        cv2.projectPoints(np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.zeros(3), matrix, coefficients)
        for rays in straight
    ]
    error = max(float(np.abs(points[:, 0] - side).max()) for (points, _), side in zip(again, ends, strict=True))
    left, top = float(straight[0][:, 0].max()), float(straight[1][:, 1].max())
    right, bottom = float(straight[2][:, 0].min()), float(straight[3][:, 1].min())
    plain = min(given.width / given.fx, given.height / given.fy)
    is_small = min(right - left, bottom - top) < _MIN_SIDE * plain
    if is_small and given.skew and error < _MAX_ROUND_TRIP_PX:
        raise ValueError(
            f"{name}: without its skew of {given.skew:g} the picture of {given.width} x {given.height} pixels has no "
            "upright rectangle that is large enough. Give the skew that it has, or the picture before it was sheared."
        )
    if is_small or not error < _MAX_ROUND_TRIP_PX:
        raise ValueError(
            f"{name}: distortion {given.distortion} folds the picture over at its border. "
            "Calibrate again, with the pattern in the corners of the picture too."
        )
    return left, top, right, bottom


# Lenses in a file: YAML as a camera's configuration has it, a model of COLMAP, or a camchain of Kalibr.
#
# Sources of the formats: COLMAP's page on its output (text), Kalibr's wiki on its YAML formats.

# Lenses that are given: of which images each of them can be, and what is said where it is of none.

ALL = "*"  # the key of a lens that is of all images
_AFTER_CAMERA = "/_-. "  # what may follow the name of a camera in the name of an image


@dataclass(frozen=True)
class Lenses:
    """Lenses by the images that they took.

    A key is the name of an image, with or without its suffix; a camera id; the name of a camera, as `Frame.camera` has
    it or with which the names of its images begin (`left` for left/0001.png and left_0001.png); or a pattern, such as
    `left*.png`.
    The first kind of key that an image matches counts, in this order.
    """

    by_key: Mapping[str, Intrinsics]

    def find_key(self, name: str, camera: str = "", camera_id: str = "") -> str | None:
        """Returns the key of the lens of an image; None where no lens is of it."""
        return find_key(self.by_key, name, camera, camera_id)

    def apply(self, each: Any) -> Any:
        """Returns the frame with its lens; as it is where no lens is of it, or one of another aspect ratio.

        Where lenses differ, the key becomes the frame's camera: images of different cameras share no lens.
        """
        if not isinstance(each, Frame) or (key := self.find_key(each.name, each.camera, each.camera_id)) is None:
            return each
        lens = self.by_key[key]
        seen = assign_lens(each, lens)
        if seen is each or len(set(self.by_key.values())) == 1:
            return seen
        first = next(other for other, known in self.by_key.items() if known == lens)
        return replace(seen, camera=sanitize_text(first, LONGEST_NAME))

    def check(self, images: Iterable[tuple[str, str, str, int, int]]) -> None:
        """Raises ValueError where a lens is of no image, or of none of its aspect ratio.

        `images` are names, cameras, camera ids, widths and heights of all that there are.
        """
        sizes: dict[str, set[tuple[int, int]]] = {key: set() for key in self.by_key}
        names = []
        for name, camera, camera_id, width, height in images:
            names.append(name)
            if (key := self.find_key(name, camera, camera_id)) is not None:
                sizes[key].add((width, height))
        for key, found in sizes.items():
            if found:
                check_fits(self.by_key[key], found)
            elif names:
                raise ValueError(
                    f"intrinsics has a lens of {sanitize_text(key, 100)!r}, which is no photograph's: they are called "
                    f"{sanitize_text(min(names), 100)} to {sanitize_text(max(names), 100)}. Name a photograph, a "
                    "camera with "
                    "which names begin, or a pattern such as left*.png"
                )


def find_key(keys: Collection[str], name: str, camera: str = "", camera_id: str = "") -> str | None:
    """Returns which of the keys an image with this name, of this camera, matches; None: none. See `Lenses`."""
    for exact in (name, name.rpartition(".")[0], PurePosixPath(name).name, camera_id, camera):
        if exact and exact in keys:
            return exact
    begins = (key for key in keys if key and name.startswith(key) and name[len(key) : len(key) + 1] in _AFTER_CAMERA)
    patterns = (key for key in keys if fnmatchcase(name, key))
    return next(begins, None) or next(patterns, None)


def describe_image(frame: Frame) -> tuple[str, str, str, int, int]:
    """Returns what `Lenses.check` asks of an image: name, camera, camera id, width and height."""
    return frame.name, frame.camera, frame.camera_id, frame.width, frame.height


def same_aspect(intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Whether an image of this size can be one of the camera's, resized."""
    return abs(intrinsics.width * height - intrinsics.height * width) <= max(width, height)


def assign_lens(each: Any, known: Intrinsics) -> Any:
    """The frame with this lens, if it can be one of its images."""
    if not isinstance(each, Frame) or not same_aspect(known, each.width, each.height):
        return each
    return replace(each, intrinsics=known.resized(each.width, each.height))


def check_fits(known: Intrinsics, sizes: Collection[tuple[int, int]]) -> None:
    """Raises ValueError where there are photographs, of these sizes, and the lens can be of none of them."""
    if sizes and not any(same_aspect(known, *size) for size in sizes):
        shown = ", ".join(f"{width} x {height}" for width, height in sorted(set(sizes)))
        raise ValueError(
            f"intrinsics must be of images of the photographs' aspect ratio, got those of {known.width} x "
            f"{known.height} for {shown}. Give the size of the images that were calibrated, or photographs of its "
            "aspect ratio"
        )


# What each of COLMAP's models holds, in its order. f is fx and fy.
_COLMAP = {
    "SIMPLE_PINHOLE": ("opencv", "f cx cy"),
    "PINHOLE": ("opencv", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("opencv", "f cx cy k1"),
    "RADIAL": ("opencv", "f cx cy k1 k2"),
    "OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
}
_KALIBR = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}
_OF_OURS = "width, height, fx, fy, cx and cy of a lens, as `intrinsics` of a camera does"
_READ = f"{_OF_OURS}, or be a cameras.txt of COLMAP or a camchain YAML of Kalibr"


class UnusableLens(ValueError):
    """A file that gives no lens; the text says what was expected."""


def read_lens(path: Path) -> Intrinsics:
    """Returns the one lens that a file gives. Raises UnusableLens, also where it gives several."""
    lenses = read_lenses(path).by_key
    if len(lenses) > 1:
        raise UnusableLens(
            f"{sanitize_text(str(path))} must be of one camera here, it has "
            f"{', '.join(map(sanitize_text, list(lenses)[:5]))}; "
            "leave the one that took the photographs"
        )
    return next(iter(lenses.values()))


def read_lenses(path: Path) -> Lenses:
    """Returns the lenses that a file gives, by the images or cameras that they are of; one lens alone is of all.

    `path` is YAML with a lens, or with `cameras`: a mapping of images, cameras or patterns to lenses; cameras.txt of
    COLMAP, or the folder of a model, whose images.txt or images.bin says which camera took which image; or a camchain
    of Kalibr, whose cameras are called cam0, cam1 and so on. `source` of each is "calibration" unless the file says
    otherwise. Raises UnusableLens.
    """
    if path.is_dir():
        path = path / "cameras.txt"
    shown = sanitize_text(str(path))
    text = read_text(path, MAX_BYTES, UnusableLens, shown, _READ)
    with guard_untrusted(UnusableLens, shown):
        return _parse(path, shown, text)


def _parse(path: Path, shown: str, text: str) -> Lenses:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and all(len(words) > 4 and words[0].isdigit() and words[1].isupper() for words in lines):
        return _parse_colmap(path, shown, lines)
    if text.startswith("%YAML:"):
        raise UnusableLens(
            f"{shown} is a file of OpenCV's own format, which is not read; it must give {_READ}. Of OpenCV's camera "
            "matrix, give fx, fy, and cx and cy plus 0.5"
        )
    try:
        content = parse_yaml(text, shown)
    except ConfigError as error:  # on several lines, of which the first says it; it names the file already
        raise UnusableLens(f"{' '.join(str(error).split())}; it must give {_READ}") from error
    if not isinstance(content, dict):
        raise UnusableLens(f"{shown} must give {_READ}; it holds no keys and values")
    cameras = {name: each for name, each in content.items() if isinstance(each, dict) and "camera_model" in each}
    if cameras:
        return _name_lenses({str(name): _parse_kalibr(shown, name, each) for name, each in cameras.items()})
    several = content.get("cameras")
    if isinstance(several, dict) and several and all(isinstance(each, dict) for each in several.values()):
        return Lenses(
            {str(name): _parse_own(f"{shown}: {sanitize_text(name)}", each) for name, each in several.items()}
        )
    return Lenses({ALL: _parse_own(shown, content)})


def _name_lenses(lenses: Mapping[str, Intrinsics]) -> Lenses:
    """The lenses by their keys; a single one is of all images."""
    return Lenses(lenses if len(lenses) > 1 else {ALL: next(iter(lenses.values()))})


def _parse_own(shown: str, content: Mapping[str, Any]) -> Intrinsics:
    """A lens, also below `intrinsics` or `camera`, as the configuration of a capture has it."""
    nested = content.get("camera")
    content = nested if isinstance(nested, dict) and "intrinsics" in nested else content
    fields = content.get("intrinsics", content)
    fields = {"source": "calibration", **fields} if isinstance(fields, dict) else fields
    known = {field.name for field in dataclasses.fields(Intrinsics)}
    try:
        lens = record_of(fields, Intrinsics)
    except msgspec.ValidationError as error:
        raise UnusableLens(f"{shown} must give {_READ}: {error}") from error
    if unknown := sorted(set(fields) - known):
        raise UnusableLens(
            f"{shown}: a lens has no {', '.join(map(sanitize_text, unknown))}; there are {', '.join(sorted(known))}"
        )
    return lens


def _parse_colmap(path: Path, shown: str, lines: Sequence[Sequence[str]]) -> Lenses:
    """Lenses by camera id; by the images' names where cameras differ, as the model's images say."""
    if len({tuple(words[1:]) for words in lines}) == 1:
        return Lenses({ALL: _parse_colmap_lens(shown, lines[0])})
    lenses = {int(words[0]): _parse_colmap_lens(shown, words) for words in lines}
    for name, parse in (("images.txt", lambda data: text_images(data.decode())), ("images.bin", binary_images)):
        beside = path.parent / name
        if beside.is_file():
            data = read_bounded(beside, MAX_BYTES, UnusableLens, sanitize_text(str(beside)))
            with guard_untrusted(UnusableLens, sanitize_text(str(beside))):
                taken = {row.name: row.camera_id for row in parse(data)}
            if lost := sorted(set(taken.values()) - set(lenses)):
                raise UnusableLens(f"{shown} must have all cameras of {name}, it lacks {lost[:5]}")
            return Lenses(_shorten_names({name: lenses[camera] for name, camera in taken.items()}))
    raise UnusableLens(
        f"{shown} has {len(lenses)} cameras that differ, and no images.txt or images.bin beside it says which of them "
        "took which photograph; put one there, or leave the line of the one that took the photographs"
    )


def _shorten_names(lenses: Mapping[str, Intrinsics]) -> dict[str, Intrinsics]:
    """The lenses by the names of images without their folders, where these are all different."""
    short = {PurePosixPath(name).name: lens for name, lens in lenses.items()}
    return short if len(short) == len(lenses) else dict(lenses)


def _parse_colmap_lens(shown: str, words: Sequence[str]) -> Intrinsics:
    _, model, width, height, *numbers = words
    if model not in _COLMAP:
        raise UnusableLens(f"{shown}: the lens must be one of {', '.join(_COLMAP)}, got {sanitize_text(model, 40)}")
    kind, names = _COLMAP[model][0], _COLMAP[model][1].split()
    if len(numbers) != len(names):
        raise UnusableLens(f"{shown}: {model} must have {len(names)} numbers ({' '.join(names)}), got {len(numbers)}")
    try:
        given = dict(zip(names, map(float, numbers), strict=True))
        size = int(width), int(height)
    except ValueError as error:
        raise UnusableLens(
            f"{shown}: {model} must have a size in pixels and numbers: {sanitize_text(error)}"
        ) from error
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    terms = tuple(number for name, number in given.items() if name[0] in "kp")
    if model == "RADIAL":
        terms = (*terms, 0.0, 0.0)
    return _lens(shown, *size, fx, fy, given["cx"], given["cy"], "calibration", terms, kind)


def _parse_kalibr(shown: str, name: object, given: Mapping[str, Any]) -> Intrinsics:
    projection, bending = given["camera_model"], given.get("distortion_model", "none")
    if projection != "pinhole" or str(bending) not in _KALIBR:
        raise UnusableLens(
            f"{shown}: {sanitize_text(name)} must have camera_model pinhole and distortion_model "
            f"{', '.join(_KALIBR)}, got "
            f"{sanitize_text(projection, 40)} and {sanitize_text(bending, 40)}; calibrate with pinhole-radtan or "
            "pinhole-equi"
        )
    try:
        width, height = (int(side) for side in given["resolution"])
        fx, fy, cx, cy = (float(number) for number in given["intrinsics"])
        terms = tuple(float(number) for number in given.get("distortion_coeffs", ()))
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableLens(
            f"{shown}: {sanitize_text(name)} must have resolution [width, height], intrinsics [fx, fy, cx, cy] and "
            f"distortion_coeffs, four numbers: {sanitize_text(error)}"
        ) from error
    terms = () if bending == "none" else terms
    if len(terms) not in (0, 4):
        raise UnusableLens(f"{shown}: {sanitize_text(name)} must have four distortion_coeffs, got {len(terms)}")
    # Kalibr has the centre of the top-left pixel at (0, 0).
    return _lens(shown, width, height, fx, fy, cx + 0.5, cy + 0.5, "calibration", terms, _KALIBR[bending])


def _lens(shown: str, *parts: Any) -> Intrinsics:
    try:
        return Intrinsics(*parts)
    except ValueError as error:
        raise UnusableLens(f"{shown}: {error}") from error
