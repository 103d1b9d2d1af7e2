"""Which frames of a stream become keyframes: those that are usable and add parallax or coverage, with the reason why.

Corners of the last keyframe are followed through the stream, in small images. What they tell is how much of that view
has left the picture (coverage), how far it has moved, and how much of the motion no homography explains (parallax).
The first of these that exceeds its limit makes a candidate; only candidates are examined for blur and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, reduced
from splatnode.capture.quality import Limits, assess, novelty, why_redundant, why_unusable

TRACKED_SIDE = 320  # the longer side of the images in which corners are followed is at least this
CORNERS = 100
LEAST_CORNERS = 12  # fewer tell nothing
ROUND_TRIP_PX = 1.0  # a corner that is followed there and back must come home
FOLLOWING = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03)  # iterations and pixels at which it is enough
REMEMBERED_VIEWS = 64  # of which a new one must not be a copy
DIFFERENT_GIST = 0.3  # mean difference; copies have 0.05, and a look at the gist costs nothing

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Picture = npt.NDArray  # (h, w) or (h, w, 3) uint8
Points = npt.NDArray  # (P, 1, 2) float32, as OpenCV has them


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every_frame: bool = False  # photographs: each was taken on purpose, and only unusable ones and copies are left out
    coverage: Share = 0.25  # share of the last keyframe's corners that are out of the picture
    motion: Share = 0.08  # median way of the corners, in longer sides of the image
    parallax: Share = 0.01  # median distance from the way that the best homography explains
    per_second: Annotated[float, msgspec.Meta(gt=0)] = 8.0  # frames examined; the others only pass
    patience_s: Annotated[float, msgspec.Meta(ge=0)] = 0.3  # between examinations of candidates that were unusable
    backlog: Annotated[int, msgspec.Meta(ge=1)] = 8  # with so many frames waiting for recon, twice as much is asked


@dataclass(frozen=True)
class Decision:
    take: bool
    reason: str
    candidate: bool  # it would have added something; not taken: it was unusable


@dataclass(frozen=True)
class Motion:
    """What the corners of a keyframe did since."""

    lost: float  # share that is out of the picture, or can no longer be recognised
    median: float  # way, in longer sides
    parallax: float  # distance from the best homography, in longer sides


@dataclass(frozen=True)
class _View:
    """A keyframe as it is remembered."""

    name: str
    small: Picture
    gist: Picture


class Selector:
    """Remembers the keyframes so far. Frames are given in the order of their stamps."""

    def __init__(self, config: Config, limits: Limits) -> None:
        self.config = config
        self.limits = limits
        self._views: list[_View] = []  # newest last
        self._start: Picture | None = None  # the last keyframe as it is followed, grey
        self._corners: Points = np.zeros((0, 1, 2), np.float32)
        self._now: Points = self._corners
        self._sharpest_px: float | None = None
        self._next_ns = 0  # nothing is examined before

    def decide(self, frame: Frame, waiting: int = 0) -> Decision:
        """Whether to send this frame; `waiting` frames have been sent and not yet taken over by recon."""
        if frame.stamp_ns < self._next_ns and not self.config.every_frame:
            return Decision(False, "between two examinations", False)
        self._next_ns = frame.stamp_ns + round(1e9 / self.config.per_second)
        small = reduced(frame.image, TRACKED_SIDE)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        reason, adds = self._what_it_adds(grey, patience=1 + waiting / self.config.backlog)
        if not adds:
            return Decision(False, reason, False)
        fault = self._fault(frame, small)
        if fault is not None:
            self._next_ns = frame.stamp_ns + round(1e9 * self.config.patience_s)
            return Decision(False, fault, True)
        self._remember(frame.name, small, grey)
        return Decision(True, reason, True)

    def forget_last(self) -> None:
        """The last frame taken could not be kept: what it showed may be taken again."""
        self._views = self._views[:-1]
        self._start = None
        self._next_ns += round(1e9)  # nor will there be room in a moment

    def _what_it_adds(self, grey: Picture, patience: float) -> tuple[str, bool]:
        if self.config.every_frame:
            return "every frame is taken", True
        if self._start is None or self._start.shape != grey.shape:
            return "first view of this stream", True
        if len(self._corners) < LEAST_CORNERS:
            return "the last keyframe has too few corners to follow", True
        self._now, followed = follow(self._start, grey, self._corners, self._now)
        motion = measure(self._corners, self._now, followed, max(grey.shape))
        return what_it_adds(motion, self.config, patience)

    def _fault(self, frame: Frame, small: Picture) -> str | None:
        """Why the frame cannot be used, or is one that was taken before."""
        gist = _gist(small)
        for view in reversed(self._views):
            if np.abs(gist - view.gist).mean() > DIFFERENT_GIST or view.small.shape != small.shape:
                continue
            if why_redundant(novelty(small, view.small), self.limits):
                return f"duplicate: it shows what {view.name} shows"
        quality = assess(frame.image)
        fault = why_unusable(quality, self.limits, self._sharpest_px)
        if quality.blur_px is not None:
            self._sharpest_px = min(quality.blur_px, self._sharpest_px or quality.blur_px)
        return fault

    def _remember(self, name: str, small: Picture, grey: Picture) -> None:
        self._views = [*self._views[1 - REMEMBERED_VIEWS :], _View(name, small, _gist(small))]
        self._start = grey
        found = cv2.goodFeaturesToTrack(grey, CORNERS, qualityLevel=0.01, minDistance=8)
        self._corners = self._now = np.zeros((0, 1, 2), np.float32) if found is None else found


def follow(
    start: Picture,  # (h, w) grey
    now: Picture,  # (h, w) grey
    corners: Points,  # in `start`
    guess: Points,  # where they were a moment ago
) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Where the corners are now, and which of them were found: those that are in the picture and come home."""
    window = {"winSize": (11, 11), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW, "criteria": FOLLOWING}
    there, found, _ = cv2.calcOpticalFlowPyrLK(start, now, corners, guess.copy(), **window)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(now, start, there, corners.copy(), **window)
    home = np.linalg.norm(back - corners, axis=2).ravel() < ROUND_TRIP_PX
    inside = np.all((there >= 0) & (there < (start.shape[1], start.shape[0])), axis=2).ravel()
    followed = (found[:, 0] == 1) & (returned[:, 0] == 1) & home & inside
    return np.where(followed[:, None, None], there, guess), followed


def measure(corners: Points, now: Points, followed: npt.NDArray[np.bool_], longer_side: int) -> Motion:
    """Median way and parallax of the corners that were followed; too few of them tell only that the view is lost."""
    lost = 1 - float(followed.mean())
    if followed.sum() < LEAST_CORNERS:
        return Motion(1.0, 0.0, 0.0)
    before, after = corners[followed], now[followed]
    way = np.linalg.norm(after - before, axis=2)
    homography, _ = cv2.findHomography(before, after, cv2.RANSAC, 1.5, maxIters=100)
    if homography is None:
        return Motion(lost, float(np.median(way)) / longer_side, 0.0)
    unexplained = np.linalg.norm(after - cv2.perspectiveTransform(before, homography), axis=2)
    return Motion(lost, float(np.median(way)) / longer_side, float(np.median(unexplained)) / longer_side)


def what_it_adds(motion: Motion, config: Config, patience: float = 1.0) -> tuple[str, bool]:
    """The reason to take a frame, or not to; `patience` of 2 asks for twice as much."""
    measured = {
        "coverage": (motion.lost, min(config.coverage * patience, 0.9), "of the last view is out of the picture"),
        "parallax": (motion.parallax, config.parallax * patience, "of the longer side is parallax"),
        "motion": (motion.median, config.motion * patience, "of the longer side is the median motion"),
    }
    for what, (value, limit, text) in measured.items():
        if value >= limit:
            return f"{what}: {value:.1%} {text}, {limit:.1%} are asked", True
    values = ", ".join(f"{what} {value:.1%} of {limit:.1%}" for what, (value, limit, _) in measured.items())
    return f"adds too little since the last keyframe: {values}", False


def _gist(small: Picture) -> Picture:
    """(12, 16) grey levels of unit contrast."""
    grey = cv2.cvtColor(cv2.resize(small, (16, 12), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY).astype(float)
    return (grey - grey.mean()) / (grey.std() + 1)
