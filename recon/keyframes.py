"""Keyframes: accepted frames with their features and their images at modelled size; and which frames are none.

Copies, blank and blurred frames are screened out before anything is computed from them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import keyframe_selection
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.recon.result.verdict import Code

# Thresholds in pixels hold at this longer side of an image: an error counts as error * REFERENCE_SIDE / longer side.
REFERENCE_SIDE = 1024


# What OpenCV and NumPy raise where they cannot work with the pixels or points of one image. Such a fault costs that
# image or that pair, and is logged with its name; every other exception is a fault of ours and surfaces.
LIBRARY_ERRORS = (cv2.error, np.linalg.LinAlgError)

PLAIN = 1.0  # the tilt of features of the image as it is


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of a frame at full size. A point may have several descriptors, one for each simulated tilt."""

    points: npt.NDArray[np.float64]  # (M, 2) pixels of the full-size image, top-left pixel centre at (0.5, 0.5)
    descriptors: npt.NDArray[np.uint8]  # (D, 128) as matching/features.py quantises them
    point_of: npt.NDArray[np.int64]  # (D,) the point that a descriptor describes
    # (D,) simulated tilt: by which the image's width was divided; below 1, its height was multiplied by it; 1 for none
    tilt: npt.NDArray[np.float64]

    def select_tilt(self, tilt: float) -> Features:
        """Returns the features with the descriptors of this tilt alone, in their order: the strongest first."""
        chosen = self.tilt == tilt
        return Features(self.points, self.descriptors[chosen], self.point_of[chosen], self.tilt[chosen])


_KEY_POINTS = 64  # features whose places tell any two photographs apart


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that was accepted, with what every later stage needs of it."""

    frame: Frame  # undistorted, at full size
    image: npt.NDArray[np.uint8]  # (h, w, 3) RGB at modelled size
    features: Features
    lens: Intrinsics | None = None  # estimated, whose distortion was taken out of all of it; None: nothing was
    moving: float = 0.0  # share of the frame that its mask hides because it was found to move

    @property
    def name(self) -> str:
        """Returns the frame's name, by which its point maps, views and cameras are found."""
        return self.frame.name

    @property
    def scale(self) -> tuple[float, float]:
        """Modelled width over full width, and modelled height over full height."""
        return self.image.shape[1] / self.frame.width, self.image.shape[0] / self.frame.height

    @property
    def mask(self) -> npt.NDArray[np.bool_] | None:
        """(h, w) at modelled size, True where all that a pixel is made of is used; None: all pixels are."""
        if self.frame.mask is None:
            return None
        return resize_mask(self.frame.mask, *self.image.shape[:2])


def content_key(keyframe: Keyframe) -> bytes:
    """A key to sort keyframes by what they show, so that an answer does not depend on the order in which they came."""
    return keyframe.features.points[:_KEY_POINTS].tobytes()


def longer_side(frame: Frame) -> int:
    """Returns the longer side of the frame at full size, pixels."""
    return max(frame.width, frame.height)


def principal_point(frame: Frame) -> npt.NDArray[np.float64]:
    """(2,) pixels of the frame at full size: as its intrinsics give it, else the middle of the image."""
    if frame.intrinsics is not None:
        return np.array([frame.intrinsics.cx, frame.intrinsics.cy])
    return np.array([frame.width / 2.0, frame.height / 2.0])


def compute_model_size(width: int, height: int, longer_side: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `longer_side`; images are never enlarged."""
    scale = min(1.0, longer_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_mask(mask: npt.NDArray[np.bool_], height: int, width: int) -> npt.NDArray[np.bool_]:
    """(height, width) of a mask (H, W): True where all that a pixel is made of is used."""
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.999


def resize_image(image: npt.NDArray[np.uint8], longer_side: int) -> npt.NDArray[np.uint8]:
    """`image` (H, W, 3) area-resampled to its modelled size (h, w, 3); itself where it has that size."""
    width, height = compute_model_size(image.shape[1], image.shape[0], longer_side)
    if (width, height) == (image.shape[1], image.shape[0]):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


REMEMBERED_REJECTED = 100  # frames of a stream: more of them change no verdict


class ScreeningConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Screening: copies, blank and blurred frames are left out before anything is computed from them."""

    # Those of capture, which has screened live frames already
    limits: keyframe_selection.Limits = keyframe_selection.Limits()


@dataclass(frozen=True, eq=False)
class FrameSummary:
    """The record of a frame that screening keeps."""

    name: str
    quality: keyframe_selection.Quality
    thumbnail: npt.NDArray[np.uint8]  # (h, w, 3) RGB, the longer side at most quality.THUMBNAIL_SIDE
    size: tuple[int, int]  # width and height of the frame, pixels


@dataclass(frozen=True)
class Rejected:
    """A frame that is left out, and the verdict if nothing but such frames is left."""

    name: str
    code: Code
    reason: str


def summarise(frame: Frame) -> FrameSummary:
    """The frame's quality, measured, and its thumbnail."""
    scale = min(1.0, keyframe_selection.THUMBNAIL_SIDE / max(frame.width, frame.height))
    size = max(1, round(frame.width * scale)), max(1, round(frame.height * scale))
    thumbnail = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return FrameSummary(frame.name, keyframe_selection.assess(frame.image), thumbnail, (frame.width, frame.height))


@dataclass(frozen=True, eq=False)
class ScreeningState:
    """The frames of a stream that were kept so far, by name, and those that were rejected, the latest last."""

    summaries: Mapping[str, FrameSummary] = field(default_factory=dict)
    rejected: tuple[Rejected, ...] = ()

    def add_frame(self, frame: Frame, config: ScreeningConfig) -> tuple[ScreeningState, list[Rejected]]:
        """Adds a frame; also returns which frames are now rejected: it, or earlier ones."""
        summaries = {**self.summaries, frame.name: summarise(frame)}
        _, rejected = screen(list(summaries.values()), config)
        for each in rejected:
            del summaries[each.name]
        return ScreeningState(summaries, (*self.rejected, *rejected)[-REMEMBERED_REJECTED:]), rejected

    def add_known_frame(self, frame: Frame) -> ScreeningState:
        """Adds a frame that was screened elsewhere."""
        return (
            self
            if frame.name in self.summaries
            else replace(self, summaries={**self.summaries, frame.name: summarise(frame)})
        )

    def remove_frames(self, names: Collection[str]) -> ScreeningState:
        """Without these frames, which are neither kept nor rejected."""
        return replace(self, summaries={name: summary for name, summary in self.summaries.items() if name not in names})


def screen_all(
    frames: Iterable[Frame | DroppedFrame], config: ScreeningConfig
) -> tuple[list[Frame], list[DroppedFrame], tuple[Rejected, ...]]:
    """The frames that are worth working on; those that were left out, here or before; why, of those here."""
    screened, kept, dropped = ScreeningState(), dict[str, Frame](), list[DroppedFrame]()
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            dropped.append(frame)
            continue
        screened, rejected = screened.add_frame(frame, config)
        dropped += [DroppedFrame(each.name, each.reason) for each in rejected]
        kept = {name: each for name, each in {**kept, frame.name: frame}.items() if name in screened.summaries}
    return list(kept.values()), dropped, screened.rejected


def screen(summaries: Sequence[FrameSummary], config: ScreeningConfig) -> tuple[list[int], list[Rejected]]:
    """The positions of the frames that are worth working on, and the others with the reason.

    Of copies the first is kept. Blur is compared with the sharpest frame of the same size, so that the order does not
    matter: frames of another size are of another camera, or of another lens.
    """
    sharpest = {summary.size: math.inf for summary in summaries}
    for summary in summaries:
        blur_px = summary.quality.blur_px
        sharpest[summary.size] = min(sharpest[summary.size], math.inf if blur_px is None else blur_px)
    largest = max((max(summary.size) for summary in summaries), default=0)
    kept: list[int] = []
    rejected: list[Rejected] = []
    for index, summary in enumerate(summaries):
        too_small = keyframe_selection.why_too_small(summary.size, largest)
        if too_small is not None:
            rejected.append(Rejected(summary.name, Code.TOO_FEW_VIEWS, too_small))
            continue
        why = keyframe_selection.why_unusable(summary.quality, config.limits, sharpest[summary.size])
        if why is not None:
            rejected.append(Rejected(summary.name, _code(summary.quality, config.limits), why))
            continue
        original = next((summaries[i] for i in kept if _is_copy(summary, summaries[i], config.limits)), None)
        if original is None:
            kept.append(index)
        else:
            rejected.append(Rejected(summary.name, Code.STATIC_CAMERA, f"duplicate of {original.name}"))
    return kept, rejected


def _code(measured: keyframe_selection.Quality, limits: keyframe_selection.Limits) -> Code:
    """The verdict on an unusable frame: nothing to see on it, else too blurred."""
    blank = measured.blur_px is None or measured.contrast < limits.contrast
    exposed = 1.0 - measured.dark - measured.bright >= limits.min_exposed_share
    return Code.LOW_TEXTURE if blank or not exposed else Code.BLUR


def _is_copy(one: FrameSummary, other: FrameSummary, limits: keyframe_selection.Limits) -> bool:
    if one.size != other.size:
        return False
    return (
        keyframe_selection.why_redundant(keyframe_selection.novelty(one.thumbnail, other.thumbnail), limits) is not None
    )


# The dark rim of undistorted photographs: pixels at the border that the lens has not seen.

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

MAX_RIM_WIDTH = 0.03  # of the longer side: what is dark farther inwards from the border is a dark scene
MIN_RIM_LENGTH = 0.2  # of a side: what is dark along less of it is no rim
MAX_RIM_LEVEL = 80  # of 255: shrinking a photograph mixes the black of its rim with the scene beside it


def valid_masks(images: Sequence[Image]) -> list[Mask]:
    """For each photograph (h, w, 3) the mask (h, w) of the pixels that show the scene.

    A lens leaves the same rim in all its photographs, so the rim is where all photographs of one size are dark. Of a
    size that occurs only once, all pixels count as valid.
    """
    by_size: dict[tuple[int, ...], list[Image]] = {}
    for image in images:
        by_size.setdefault(image.shape, []).append(image)
    rims = {shape: _rim(alike) for shape, alike in by_size.items()}
    return [~rims[image.shape] for image in images]


def valid_rectangle(valid: Mask) -> tuple[slice, slice]:
    """Rows and columns of an upright rectangle of valid pixels only, as large as can be found greedily.

    The side with the smallest share of valid pixels is taken away until all sides are valid. `valid` is (h, w).
    """
    top, left = 0, 0
    bottom, right = valid.shape
    while not (inside := valid[top:bottom, left:right]).all():
        sides = inside[0], inside[-1], inside[:, 0], inside[:, -1]
        worst = int(np.argmin([side.mean() for side in sides]))
        top, bottom, left, right = top + (worst == 0), bottom - (worst == 1), left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def _rim(images: Sequence[Image]) -> Mask:
    """(h, w) runs of pixels from the border inwards that are dark in all `images`, dilated by a pixel."""
    dark = reduce(np.maximum, images).max(2) <= MAX_RIM_LEVEL
    if len(images) < 2:
        return np.zeros_like(dark)
    band = max(2, round(MAX_RIM_WIDTH * max(dark.shape)))
    upright = _top_runs(dark, band) | _top_runs(dark[::-1], band)[::-1]
    across = _top_runs(dark.T, band).T | _top_runs(dark.T[::-1], band)[::-1].T
    # In a corner, a run along one side lies in the other side's rim and is longer than `band`.
    corner = np.zeros_like(dark)
    for rows in (slice(0, band), slice(-band, None)):
        for columns in (slice(0, band), slice(-band, None)):
            corner[rows, columns] = upright[rows].any() and across[:, columns].any()
    rim = upright | across | (dark & corner)
    return cv2.dilate(rim.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _top_runs(dark: Mask, band: int) -> Mask:
    """(h, w) leading dark runs per column, if at most `band` long; none if in under MIN_RIM_LENGTH of the columns."""
    run = np.zeros_like(dark)
    run[: band + 1] = np.logical_and.accumulate(dark[: band + 1], axis=0)
    run &= ~run[min(band, len(run) - 1)]
    return run & (run[0].mean() >= MIN_RIM_LENGTH)


# Black bars, as editors and recorders put them around a picture that has another shape than its frame.

_MAX_BAR_LEVEL = 24  # of 255: compressed black
_MAX_BAR_SPECKS = 0.01  # share of a bar's row that compression, or a subtitle's edge, may make brighter
_MIN_BAR_WIDTH = 0.03  # of the side that the bars shorten; a rim may be as wide
_MAX_BAR_DIFFERENCE = 0.01  # of that side, between two opposite bars: a picture is put in the middle
_MIN_PICTURE_EDGE = 0.5  # share of the row beside a bar that is no bar: else the scene itself is black there
_MIN_PICTURE = 0.3  # of a side that two bars leave
_EDGE_ROWS = 3  # beside a bar, over which shrinking and compression spread its edge


def find_picture(image: Image) -> tuple[slice, slice] | None:
    """Rows and columns of the picture between black bars on two opposite sides, or four, of an image (h, w, 3).

    None where there are no such bars. They are found where they are alike on both sides and end in a straight edge: a
    dark scene has none.
    """
    rows = _find_bars(image)
    columns = _find_bars(image[rows or slice(None)].transpose(1, 0, 2))
    if rows is None and columns is None:
        return None
    return rows or slice(0, image.shape[0]), columns or slice(0, image.shape[1])


def _find_bars(image: Image) -> slice | None:
    """The rows between two bars of black rows; None where there are none."""
    height = len(image)
    ends = image[[0, -1]].max(2) > _MAX_BAR_LEVEL
    if height < 2 or ends.mean(1).max() > _MAX_BAR_SPECKS:
        return None
    bright = (image.max(2) > _MAX_BAR_LEVEL).mean(1)
    (shown,) = np.nonzero(bright > _MAX_BAR_SPECKS)
    if not len(shown):
        return None
    top, bottom = int(shown[0]), int(shown[-1]) + 1
    bars = top, height - bottom
    alike = abs(bars[0] - bars[1]) <= max(2.0, _MAX_BAR_DIFFERENCE * height)
    wide = min(bars) >= _MIN_BAR_WIDTH * height and bottom - top >= _MIN_PICTURE * height
    edges = min(bright[top : top + _EDGE_ROWS].max(), bright[bottom - _EDGE_ROWS : bottom].max())
    return slice(top, bottom) if alike and wide and edges >= _MIN_PICTURE_EDGE else None


def mask_bars(frame: Frame) -> Frame:
    """The frame with black bars around its picture hidden by its mask; itself where it has none."""
    picture = find_picture(frame.image)
    if picture is None:
        return frame
    mask = np.zeros(frame.image.shape[:2], bool)
    mask[picture] = True if frame.mask is None else frame.mask[picture]
    return replace(frame, mask=mask)
