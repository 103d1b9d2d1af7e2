"""Keyframe selection: a frame of a stream is taken if it is usable and adds parallax or coverage; the reason is given.

Corners of the last keyframe are tracked through the stream, in small images. They tell what share of that view has left
the image (coverage), how far it has moved (motion), and how much of the motion no homography explains (parallax). The
first of these that exceeds its limit makes the frame a candidate; only candidates are examined for blur and exposure.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Frame, Stamp, reduce_image
from splatnode.capture.process.config import Internal
from splatnode.capture.rig import TOLERANCE_S, are_taken_together

# Image quality: blur, exposure, and whether a frame is a duplicate.
#
# Pure functions measure; why_unusable and why_redundant compare what they measure with limits. The limits are wide:
# only a frame that is useless or redundant is left out, and all others are the reconstruction's to judge.

Image = npt.NDArray[np.uint8]  # (H, W, 3) RGB
Plane = npt.NDArray  # (H, W) grey levels, uint8, or sums of at most BOX of them, uint16

MEASURED_SIDE = 640  # blur is measured with the longer side at most this
THUMBNAIL_SIDE = 160
BOX = 15  # pixels of the box that blurs again, a multiple of 3; wider edges cannot be told apart
MIN_GRADIENT = 6  # grey levels a pixel; weaker gradients may be noise
WEAK_SHARE = 0.9  # of the pixels: those with the weakest gradients are no edges
MIN_EDGE_SHARE = 0.001  # of the pixels; an image with fewer on edges has none to measure
BLACK, WHITE = 7, 251  # grey levels from which on a pixel shows no detail
MIN_UNSATURATED, MAX_UNSATURATED = 4, 245  # grey levels between which a change of exposure leaves the contrast
MIN_COMPARED_SHARE = 0.05  # of the pixels: with fewer that are unsaturated in both images, all are compared


THUMBNAIL_PX = 128  # longer side of an image below which it is taken for a thumbnail, beside larger ones
THUMBNAIL_RATIO = 3.0  # of the largest image's longer side over a thumbnail's: a scaled set is none


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Widest edges of a usable frame, pixels at 640; sharp photographs of smooth objects reach 7
    max_blur_px: float = 8.0
    # A frame is unusable when its edges are so many times as wide as the sharpest frame's
    relative_blur: Internal[float] = 3.0
    # Least share of pixels that are neither black nor white; dark backgrounds are common
    min_exposed_share: float = 0.03
    # Least standard deviation, grey levels; noise leaves up to 2, real photographs have 20
    contrast: Internal[float] = 3.0
    # A frame is a copy when it differs by less from another; 0.05 is half a pixel of motion, at 640 pixels
    min_novelty: float = 0.05


@dataclass(frozen=True)
class Quality:
    blur_px: float | None  # width of the image's edges in its most blurred direction; None: it has no edges
    dark: float  # share of pixels that are black and so without detail
    bright: float  # share of pixels that are white
    contrast: float  # standard deviation of the grey levels, noise averaged out


def assess(image: Image) -> Quality:
    """Blur, exposure and contrast of `image`."""
    pixels = image.shape[0] * image.shape[1]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return Quality(
        blur_px=_blur_width(grey),
        dark=cv2.countNonZero(cv2.inRange(image, (0,) * 3, (BLACK,) * 3)) / pixels,
        bright=cv2.countNonZero(cv2.inRange(image, (WHITE,) * 3, (255,) * 3)) / pixels,
        contrast=float(_shrink(grey, THUMBNAIL_SIDE).std()),
    )


def blur_width(image: Image) -> float | None:
    """Width of the strongest edges in pixels, at a longer side of 640, in the direction where they are widest.

    The image is blurred again by a box along each of four directions, and the loss of gradient is compared with the
    gradient (after Crete et al., "The blur effect", 2007): an edge `w` wide keeps w / BOX of its slope, whatever its
    contrast is. Motion blur widens edges in one direction only, hence the maximum. None: no edge to measure.
    """
    return _blur_width(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _blur_width(grey: Plane) -> float | None:
    small = _shrink(grey, MEASURED_SIDE)
    if min(small.shape) < 2:
        return None
    widths = [_edge_width(small, step) for step in ((0, 1), (1, 1), (1, 0), (1, -1))]
    return max((width for width in widths if width is not None), default=None)


def _edge_width(grey: Plane, step: tuple[int, int]) -> float | None:
    """Pixels along `step` (rows, columns). Whole numbers of 16 bits hold all of it, in a third of floats' time."""
    slope = _slope(grey, step)
    up_to = np.cumsum(cv2.calcHist([slope], [0], None, [256], [0, 256]))  # pixels whose slope is at most 0, 1, ...
    weakest = max(int(np.searchsorted(up_to, WEAK_SHARE * slope.size)), MIN_GRADIENT)
    strong = (slope >= weakest).view(np.uint8)
    if cv2.countNonZero(strong) < MIN_EDGE_SHARE * slope.size:
        return None
    before = np.multiply(slope, BOX, dtype=np.uint16)
    lost = cv2.subtract(before, _slope(_box_sum(grey, step), step))  # 0 where a slope grows
    return BOX * (1 - cv2.mean(lost, strong)[0] / cv2.mean(before, strong)[0])


def _box_sum(grey: Plane, step: tuple[int, int]) -> Plane:
    """Sum of the BOX pixels along `step` around each: five sums of three."""
    down, aside = BOX // 2 * abs(step[0]), BOX // 2 * abs(step[1])
    padded = cv2.copyMakeBorder(grey, down, down, aside, aside, cv2.BORDER_REFLECT_101)
    return _sums(_sums(padded, step, 3, 1), step, BOX // 3, 3)


def _sums(values: Plane, step: tuple[int, int], count: int, apart: int) -> Plane:
    """Sums of `count` values, each `apart` times `step` (rows, columns) from the last, where all are there."""
    reach = (count - 1) * apart
    left = max(-step[1], 0) * reach
    rows, columns = values.shape[0] - step[0] * reach, values.shape[1] - abs(step[1]) * reach
    total = np.zeros((rows, columns), np.uint16)
    for along in range(0, reach + 1, apart):
        top, start = along * step[0], left + along * step[1]
        total += values[top : top + rows, start : start + columns]
    return total


def _slope(values: Plane, step: tuple[int, int]) -> Plane:
    """Absolute difference between each value and the next one along `step` (rows, columns)."""
    down, right, left = step[0], max(step[1], 0), max(-step[1], 0)
    rows, columns = values.shape
    return cv2.absdiff(values[down:, right : columns - left], values[: rows - down, left : columns - right])


def novelty(image: Image, other: Image) -> float:
    """How much of `image` is not `other`: the RMS difference of thumbnails of unit contrast, about 0 to 1.5.

    Measured: 0 for a copy, up to 0.025 for one with sensor noise, 0.1 to 0.2 after a pixel of motion at 640 pixels,
    above 0.25 between neighbours of a capture. Saturated pixels, which a change of exposure alters, do not count.
    """
    if image.shape != other.shape:
        return float("inf")
    a, b = _grey(image, THUMBNAIL_SIDE), _grey(other, THUMBNAIL_SIDE)
    valid = (np.minimum(a, b) > MIN_UNSATURATED) & (np.maximum(a, b) < MAX_UNSATURATED)
    if valid.mean() < MIN_COMPARED_SHARE:
        valid[:] = True
    a, b = a[valid], b[valid]
    difference = (a - a.mean()) / (a.std() + 1) - (b - b.mean()) / (b.std() + 1)
    return float(np.sqrt(np.mean(difference**2)))


def why_unusable(quality: Quality, limits: Limits, sharpest_px: float | None = None) -> str | None:
    """Why a frame should be left out; None where it is usable. `sharpest_px`: the least blur of its stream so far."""
    exposed = 1 - quality.dark - quality.bright
    if exposed < limits.min_exposed_share:
        what, share = ("under", quality.dark) if quality.dark > quality.bright else ("over", quality.bright)
        return f"{what}exposed: {share:.0%} of its pixels show nothing"
    if quality.contrast < limits.contrast:
        return f"blank: its contrast is {quality.contrast:.1f} grey levels, at least {limits.contrast} are needed"
    if quality.blur_px is None:
        return "blank or out of focus: it has no edges"
    if quality.blur_px > limits.max_blur_px:
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, at most {limits.max_blur_px} are allowed"
    if sharpest_px is not None and quality.blur_px > limits.relative_blur * max(sharpest_px, 1):
        return f"blurred: its edges are {quality.blur_px:.1f} px wide, those of the sharpest {sharpest_px:.1f}"
    return None


def why_too_small(size: tuple[int, int], largest: int) -> str | None:
    """Why an image of this (width, height) is left out beside one whose longer side is `largest`; None: it is used.

    SIFT finds a few dozen features in so few pixels, whose pixel is as wide as a step between two photographs.
    """
    longer = max(size)
    if longer >= THUMBNAIL_PX or longer * THUMBNAIL_RATIO > largest:
        return None
    shown = f"{size[0]} x {size[1]} pixels, beside others of up to {largest}"
    return f"too small, as thumbnails are: {shown}; give it in full size"


def why_redundant(measured: float, limits: Limits) -> str | None:
    """Why a frame of this `measured` novelty adds nothing to the frame it was compared with; None for a new view."""
    if measured < limits.min_novelty:
        return (
            f"duplicate: it differs from an earlier one by {measured:.3f}, a new view by at least {limits.min_novelty}"
        )
    return None


def _grey(image: Image, longer_side: int) -> npt.NDArray[np.float32]:
    """(h, w) grey levels, area-resampled to at most `longer_side`."""
    return _shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), longer_side).astype(np.float32)


def _shrink(grey: Plane, longer_side: int) -> Plane:
    """Area-resampled to at most `longer_side`."""
    scale = min(1.0, longer_side / max(grey.shape))
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


TRACKED_SIDE = 320  # pixels: the longer side of the images in which corners are tracked is at least this
MAX_CORNERS = 100
CORNER_QUALITY = 0.01  # of the strongest corner's response, Shi and Tomasi's
CORNER_DISTANCE = 8  # pixels between corners, so that they spread over the image
MIN_CORNERS = 12  # with fewer the motion is not measured; a homography alone takes 4
FORWARD_BACKWARD_PX = 1.0  # a corner tracked to the new image and back must end within this of its start
LUCAS_KANADE = {
    "winSize": (11, 11),
    "maxLevel": 3,
    "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03),  # iterations, pixels
}
HOMOGRAPHY_PX, HOMOGRAPHY_TRIALS = 1.5, 100  # of RANSAC: an inlier's error, and the number of samples at most
MAX_COVERAGE = 0.9  # share of lost corners that is always enough, however many frames wait
REMEMBERED_VIEWS = 64  # newest keyframes of which a new one must not be a copy
REMEMBERED_FILES = 100_000  # newest keyframes that came as a file, which may come again: a folder may be read anew
REMEMBERED_BLURS = 8  # candidates with which blur is compared: a soft place after a crisp one is usable soon
THUMBNAIL = 16, 12  # width and height in pixels
MAX_THUMBNAIL_DIFFERENCE = 0.3  # mean; copies have 0.05. Others are no copies, which saves a closer comparison
RETRY_S = 1.0  # after a keyframe that could not be kept
TOGETHER = "frame set: another camera adds something at this time"

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
AnyImage = npt.NDArray  # (h, w) or (h, w, 3) uint8
Points = npt.NDArray  # (P, 1, 2) float32, as OpenCV has them


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keyframe selection: a frame of a stream is taken if it is usable and adds parallax or coverage; the reason is
    given."""

    # Take all but unusable frames and copies: for photographs, each of which was taken on purpose
    every_frame: bool = False
    coverage: Share = 0.25  # take a frame when this share of the last keyframe's corners has left the image
    motion: Share = 0.08  # or when they have moved so far in the median, in longer sides of the image
    # Or when no homography explains so much of their motion, in longer sides of the image (median)
    parallax: Share = 0.01
    # Frames that are examined; the others become no keyframes. Higher: more work, finer choice
    max_fps: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    # Until the next frame is examined, after one that would have been taken but is unusable
    patience_s: Internal[Annotated[float, msgspec.Meta(ge=0)]] = 0.3
    # Live, of several cameras with ids: a keyframe of one makes keyframes of what the others took within so many
    # seconds of it, if that is usable and no copy. 0: each camera selects by itself
    frame_set_tolerance_s: Annotated[float, msgspec.Meta(ge=0, le=10)] = TOLERANCE_S
    # With so many keyframes waiting for recon, the three limits are twice as high, with more even higher
    backlog: Annotated[int, msgspec.Meta(ge=1)] = 8


@dataclass(frozen=True)
class Decision:
    take: bool
    reason: str
    candidate: bool  # it would have added something; not taken: it was unusable


@dataclass(frozen=True)
class CornerMotion:
    """How the corners of the last keyframe have moved since."""

    lost: float  # share that has left the image, or could not be tracked
    median: float  # displacement, in longer sides
    parallax: float  # median residual after the best homography, in longer sides


@dataclass(frozen=True)
class _Candidate:
    """A candidate as it is compared with others, and remembered where it becomes a keyframe."""

    name: str
    small: AnyImage
    thumbnail: AnyImage
    file: bytes | None  # digest of the file that it came as


class Selector:
    """Remembers the keyframes so far. Frames are given in the order of their stamps."""

    def __init__(self, config: Config, limits: Limits) -> None:
        self.config = config
        self.limits = limits
        self._views: list[_Candidate] = []  # newest last
        self._files: dict[bytes, None] = {}  # digests of the keyframes' files, newest last
        self._start: AnyImage | None = None  # the last keyframe, small and grey
        self._corners: Points = np.zeros((0, 1, 2), np.float32)
        self._now: Points = self._corners
        # Size and blur of the candidates that were examined, newest last
        self._blurs_px: deque[tuple[tuple[int, int], float]] = deque(maxlen=REMEMBERED_BLURS)
        self._next_ns = 0  # nothing is examined before

    def decide(self, frame: Frame, waiting: int = 0) -> Decision:
        """Whether this frame becomes a keyframe; `waiting` frames are not acknowledged by recon yet.

        Where it fails, for want of memory, the frame may be given again.
        """
        if frame.stamp_ns < self._next_ns and not self.config.every_frame:
            return Decision(False, "between two examinations", False)
        before_ns = self._next_ns
        try:
            return self._examine(frame, waiting)
        except BaseException:
            self._next_ns = before_ns
            raise

    def _examine(self, frame: Frame, waiting: int) -> Decision:
        self._next_ns = frame.stamp_ns + round(1e9 / self.config.max_fps)
        small = reduce_image(frame.image, TRACKED_SIDE)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        reason, adds = self._explain_decision(grey, strictness=1 + waiting / self.config.backlog)
        if not adds:
            return Decision(False, reason, False)
        view = _Candidate(frame.name, small, _thumbnail(small), _digest(frame.encoded))
        fault = self._find_fault(frame, view)
        if fault is not None:
            self._next_ns = frame.stamp_ns + round(1e9 * self.config.patience_s)
            return Decision(False, fault, True)
        self._remember(view, grey)
        return Decision(True, reason, True)

    def add(self, frame: Frame, reason: str) -> Decision:
        """Takes a frame whatever it adds, for this reason, unless it is unusable or a copy of a keyframe."""
        small = reduce_image(frame.image, TRACKED_SIDE)
        view = _Candidate(frame.name, small, _thumbnail(small), _digest(frame.encoded))
        if (fault := self._find_fault(frame, view)) is not None:
            return Decision(False, fault, True)
        self._remember(view, cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
        return Decision(True, reason, True)

    def forget_last(self) -> None:
        """Forgets the last keyframe, which could not be kept: a frame that shows the same may be taken."""
        for view in self._views[-1:]:
            self._files.pop(view.file or b"", None)
        self._views = self._views[:-1]
        self._start = None
        self._next_ns += round(1e9 * RETRY_S)

    def _explain_decision(self, grey: AnyImage, strictness: float) -> tuple[str, bool]:
        if self.config.every_frame:
            return "every frame is taken", True
        if self._start is None or self._start.shape != grey.shape:
            return "first view of this stream", True
        if len(self._corners) < MIN_CORNERS:
            return "the last keyframe has too few corners to track", True
        self._now, tracked = track(self._start, grey, self._corners, self._now)
        motion = measure(self._corners, self._now, tracked, max(grey.shape))
        return explain_decision(motion, self.config, strictness)

    def _find_fault(self, frame: Frame, seen: _Candidate) -> str | None:
        """Why the frame is unusable, or a copy of a keyframe; None where it is neither."""
        if seen.file in self._files:
            return "duplicate: this very file came before"
        for view in reversed(self._views):
            difference = np.abs(seen.thumbnail - view.thumbnail).mean()
            if difference > MAX_THUMBNAIL_DIFFERENCE or view.small.shape != seen.small.shape:
                continue
            if why_redundant(novelty(seen.small, view.small), self.limits):
                return f"duplicate: it shows what {view.name} shows"
        quality, size = assess(frame.image), (frame.width, frame.height)
        of_this_size = [blur_px for each, blur_px in self._blurs_px if each == size]  # others are of another camera
        fault = why_unusable(quality, self.limits, min(of_this_size, default=None))
        if quality.blur_px is not None:
            self._blurs_px.append((size, quality.blur_px))
        return fault

    def _remember(self, view: _Candidate, grey: AnyImage) -> None:
        found = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, qualityLevel=CORNER_QUALITY, minDistance=CORNER_DISTANCE)
        self._views = [*self._views[1 - REMEMBERED_VIEWS :], view]
        if view.file is not None:
            self._files[view.file] = None
            if len(self._files) > REMEMBERED_FILES:
                del self._files[next(iter(self._files))]
        self._start = grey
        self._corners = self._now = np.zeros((0, 1, 2), np.float32) if found is None else found


def _digest(file: bytes | None) -> bytes | None:
    return None if file is None else hashlib.blake2b(file, digest_size=16).digest()


def track(
    start: AnyImage,  # (h, w) grey
    now: AnyImage,  # (h, w) grey
    corners: Points,  # in `start`
    guess: Points,  # where they were in the frame before
) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Tracks the corners into the new image; returns their positions, and which were found there and back."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(start, now, corners, guess.copy(), **LUCAS_KANADE)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, start, there, corners.copy(), **LUCAS_KANADE)
    consistent = np.linalg.norm(back - corners, axis=2).ravel() < FORWARD_BACKWARD_PX
    inside = np.all((there >= 0) & (there < (start.shape[1], start.shape[0])), axis=2).ravel()
    tracked = (found[:, 0] == 1) & (returned[:, 0] == 1) & consistent & inside
    return np.where(tracked[:, None, None], there, guess), tracked


def measure(corners: Points, now: Points, tracked: npt.NDArray[np.bool_], longer_side: int) -> CornerMotion:
    """Displacement and parallax of the corners that were tracked; with too few of them the view counts as lost."""
    lost = 1 - float(tracked.mean())
    if tracked.sum() < MIN_CORNERS:
        return CornerMotion(1.0, 0.0, 0.0)
    before, after = corners[tracked], now[tracked]
    displacement = np.linalg.norm(after - before, axis=2)
    homography, _ = cv2.findHomography(before, after, cv2.RANSAC, HOMOGRAPHY_PX, maxIters=HOMOGRAPHY_TRIALS)
    if homography is None:
        return CornerMotion(lost, float(np.median(displacement)) / longer_side, 0.0)
    residuals = np.linalg.norm(after - cv2.perspectiveTransform(before, homography), axis=2)
    return CornerMotion(lost, float(np.median(displacement)) / longer_side, float(np.median(residuals)) / longer_side)


def explain_decision(motion: CornerMotion, config: Config, strictness: float = 1.0) -> tuple[str, bool]:
    """The reason to take a frame, or not to, and which of the two it is. Limits are multiplied by `strictness`."""
    measured = {
        "coverage": (
            motion.lost,
            min(config.coverage * strictness, MAX_COVERAGE),
            "of the last view is out of the image",
        ),
        "parallax": (motion.parallax, config.parallax * strictness, "of the longer side is parallax"),
        "motion": (motion.median, config.motion * strictness, "of the longer side is the median motion"),
    }
    for what, (value, limit, text) in measured.items():
        if value >= limit:
            return f"{what}: {value:.1%} {text}, {limit:.1%} are required", True
    values = ", ".join(f"{what} {value:.1%} of {limit:.1%}" for what, (value, limit, _) in measured.items())
    return f"adds too little since the last keyframe: {values}", False


def _thumbnail(small: AnyImage) -> AnyImage:
    """(12, 16) grey levels of unit contrast."""
    grey = cv2.cvtColor(cv2.resize(small, THUMBNAIL, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY).astype(float)
    return (grey - grey.mean()) / (grey.std() + 1)


class FrameSetSelector:
    """Selects the images of several cameras that were taken together as one: what one camera adds takes all of them.

    An image that is unusable, or a copy, is left out alone. Frame sets are given in the order of their stamps.
    """

    def __init__(self, config: Config, limits: Limits) -> None:
        self.config, self.limits = config, limits
        self._each_config = msgspec.structs.replace(config, max_fps=1e9, patience_s=0.0)  # sets have the pace
        self._selectors: dict[str, Selector] = {}  # by camera id
        self._next_ns = 0  # nothing is examined before

    def decide(self, frames: Sequence[Frame], waiting: int = 0) -> list[Decision]:
        """Whether each frame of a set becomes a keyframe; see `Selector.decide`."""
        if frames[0].stamp_ns < self._next_ns and not self.config.every_frame:
            return [Decision(False, "between two examinations", False) for _ in frames]
        for frame in frames:
            if frame.camera_id not in self._selectors:
                self._selectors[frame.camera_id] = Selector(self._each_config, self.limits)
        decisions = [self._selectors[frame.camera_id].decide(frame, waiting) for frame in frames]
        takes = any(decision.take for decision in decisions)
        if takes:
            decisions = [
                decision if decision.candidate else self._selectors[frame.camera_id].add(frame, TOGETHER)
                for frame, decision in zip(frames, decisions, strict=True)
            ]
        unusable = not takes and any(decision.candidate for decision in decisions)
        pause_s = self.config.patience_s if unusable else 1.0 / self.config.max_fps
        self._next_ns = frames[0].stamp_ns + round(1e9 * pause_s)
        return decisions


def group_frame_sets(
    frames: Iterable[Frame | DroppedFrame], tolerance_s: float = TOLERANCE_S
) -> Iterator[tuple[Frame, ...] | DroppedFrame]:
    """Groups frames that come in the order of their times into those that were taken together, as they come.

    See `rig.form_frame_sets`. A frame without a camera id is alone.
    """
    together: list[Frame] = []
    for each in frames:
        if isinstance(each, DroppedFrame):
            yield each
            continue
        if together and not _is_together(together, each, tolerance_s):
            yield tuple(together)
            together = []
        together.append(each)
        if not each.camera_id or each.captured_at is None:  # nothing can be together with it
            yield (each,)
            together = []
    if together:
        yield tuple(together)


def _is_together(frames: Sequence[Frame], frame: Frame, tolerance_s: float) -> bool:
    first, second = frames[0].captured_at, frame.captured_at
    if first is None or second is None or not frame.camera_id or frame.camera_id in {each.camera_id for each in frames}:
        return False
    return are_taken_together(first, second, tolerance_s)


# Keyframes of a recording: chosen as a live camera's are, and thinned evenly where they are more than can be used.

THINNED = "thinned out"  # why a keyframe was given up again


@dataclass(frozen=True, eq=False)
class Choice:
    """The keyframes of a recording, in its order, and what became of its other frames."""

    names: tuple[str, ...]  # of the keyframes
    keyframes: tuple[Frame, ...]  # none where all that there are were asked for
    dropped: tuple[DroppedFrame, ...]  # what the recording could not give
    examined: int  # frames
    taken: Mapping[str, int]  # of the keyframes, by what they add: "coverage", "parallax", ...
    left_out: Mapping[str, int]  # of the other frames, by the reason
    what: str = "frame"  # one of those that were examined: "photograph"

    def record(self) -> dict[str, object]:
        """For report.json."""
        counts = {"taken": dict(self.taken), "left_out": dict(self.left_out)}
        return {"frames": self.examined, "keyframes": len(self.names), **counts}

    def __str__(self) -> str:
        """For people: how many, and why."""
        taken = ", ".join(f"{count} {reason}" for reason, count in self.taken.items())
        others = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
        summary = f"{len(self.names)} of {self.examined} {self.what}s are keyframes ({taken})"
        return f"{summary}; the others: {others}" if others else summary


def choose(
    recording: Iterable[Frame | DroppedFrame],
    config: Config,
    limits: Limits,
    most: int | None,
    what: str = "frame",
    tolerance_s: float = TOLERANCE_S,
) -> Choice:
    """At most `most` keyframes, evenly along the way; only they are held in memory. None: the names of all.

    When there are more, every second one is given up, and from then on every second one is taken: so the camera's way
    stays covered whatever its length. Images of several cameras are chosen, and given up, by whole frame sets.
    """
    selector = FrameSetSelector(config, limits)
    kept: list[list[tuple[str, Frame | None, str]]] = []  # of each frame set
    dropped: list[DroppedFrame] = []
    left_out: Counter[str] = Counter()
    examined = found = 0
    step = 1  # one in so many of the frame sets that the selector takes is kept
    for frames in group_frame_sets(recording, tolerance_s):
        if isinstance(frames, DroppedFrame):
            dropped.append(frames)
            continue
        examined += len(frames)
        taken = []
        for frame, decision in zip(frames, selector.decide(frames), strict=True):
            reason = decision.reason.split(":")[0]
            if decision.take:
                taken.append((frame.name, None if most is None else frame, reason))
            else:
                left_out[reason] += 1
        if not taken:
            continue
        if found % step == 0:
            kept.append(taken)
        else:
            left_out[THINNED] += len(taken)
        found += 1
        while most is not None and len(kept) > 1 and sum(map(len, kept)) > most:
            left_out[THINNED] += sum(map(len, kept[1::2]))
            kept, step = kept[::2], 2 * step
    chosen = [each for taken in kept for each in taken]
    reasons = Counter(reason for *_, reason in chosen)
    names = tuple(name for name, *_ in chosen)
    keyframes = tuple(frame for _, frame, _ in chosen if frame is not None)
    return Choice(names, keyframes, tuple(dropped), examined, reasons, left_out, what)


# Live, a keyframe of one camera makes keyframes of what the others took with it, as `FrameSetSelector` has it offline.
#
# Frames come one by one, and other cameras have processes of their own: what is wanted may come before or after it.


MOST_HELD = 6  # frames of a camera that others may still want: a fifth of a second at 30 a second
_MOST_WANTED, _MOST_TAKEN = 32, 64  # stamps that are remembered


@dataclass(frozen=True)
class _Wanted:
    """A time at which a camera took a keyframe, and the cameras from which no image is missing."""

    stamp: Stamp
    done: set[str] = field(default_factory=set)


class FrameSetSelection:
    """Which frames the keyframes of other cameras want, and the last frames of each camera that became none.

    With a tolerance of 0 none is wanted: each camera selects by itself.
    """

    def __init__(self, tolerance_s: float) -> None:
        self._tolerance_ns = round(1e9 * tolerance_s)
        self._wanted: deque[_Wanted] = deque(maxlen=_MOST_WANTED)
        self._taken: deque[tuple[str, Stamp]] = deque(maxlen=_MOST_TAKEN)
        self._held: dict[str, deque[Frame]] = {}

    def want(self, stamp: Stamp, from_camera: str = "") -> list[Frame]:
        """Another camera took a keyframe then; returns what the others took with it, one frame of each at most."""
        if not self._tolerance_ns:
            return []
        done = {from_camera, *(camera for camera, at in self._taken if self._are_together(at, stamp))}
        self._wanted.append(_Wanted(stamp, done))
        found = []
        for camera, frames in self._held.items():
            near = [(abs(at.ns - stamp.ns), index, each) for index, each in enumerate(frames)
                    if (at := each.captured_at) is not None and self._are_together(at, stamp)]  # fmt: skip
            if near and camera not in done:
                found.append(min(near)[2])
                done.add(camera)
        return found

    def is_wanted(self, frame: Frame) -> bool:
        """Whether another camera took a keyframe with this frame, and this camera has given none to it."""
        at, camera = frame.captured_at, frame.camera_id
        if at is None or not camera:
            return False
        return any(camera not in each.done and self._are_together(each.stamp, at) for each in self._wanted)

    def hold(self, frame: Frame) -> None:
        """Keeps a frame that became no keyframe, for a while."""
        if self._tolerance_ns and frame.camera_id and frame.captured_at is not None:
            self._held.setdefault(frame.camera_id, deque(maxlen=MOST_HELD)).append(frame)

    def mark_taken(self, frame: Frame) -> None:
        """The frame became a keyframe, and its camera gives no other to a time that is near."""
        if frame.captured_at is not None:
            self._taken.append((frame.camera_id, frame.captured_at))
            for each in self._wanted:
                if self._are_together(each.stamp, frame.captured_at):
                    each.done.add(frame.camera_id)

    def _are_together(self, one: Stamp, other: Stamp) -> bool:
        return one.clock is other.clock and abs(one.ns - other.ns) <= self._tolerance_ns
