"""The views of the board that are kept of what a camera sees."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import Board
from splatnode.capture.calibration.corners import LEAST_CORNERS, View, corner_finder
from splatnode.capture.calibration.coverage import Coverage, nothing_seen, with_picture, with_view
from splatnode.capture.calibration.lacking import TooLittle
from splatnode.capture.frame import Frame

MOST_VIEWS = 100
_STILL = 0.003  # of the longer side: a board that moved by more since the last picture may be smeared
_REPEATED = 0.02  # of the longer side: a view whose corners are nearer to those of another says nothing new
_UNSEEN = 4  # pictures without the board that are kept, to find out why


class Gathering:
    """Takes pictures one at a time. Of a `moving` board only views are kept in which it was held still."""

    def __init__(self, board: Board, moving: bool) -> None:
        self.board, self.moving = board, moving
        self.pictures = 0
        self.views: list[View] = []
        self.coverage: Coverage | None = None  # before the first picture there is none
        self.unseen: list[npt.NDArray[np.uint8]] = []
        self._find = corner_finder(board)
        self._first = ""
        self._last: View | None = None

    def take(self, frame: Frame) -> View | None:
        """The view, where it is kept. Raises TooLittle where the picture is not as large as those before."""
        self.coverage = self._same_size(frame)
        self.pictures += 1
        self.coverage = with_picture(self.coverage, frame.image)
        view, before = self._find(frame.name, frame.image), self._last
        self._last = view
        if view is None:
            if len(self.unseen) < _UNSEEN:
                self.unseen.append(frame.image)
            return None
        longer = max(frame.width, frame.height)
        if self.moving and (before is None or _moved(view, before) > _STILL * longer):
            return None
        if any(_moved(view, taken) < _REPEATED * longer for taken in self.views):
            return None
        self.views.append(view)
        self.coverage = with_view(self.coverage, view)
        return view

    def _same_size(self, frame: Frame) -> Coverage:
        if self.coverage is None:
            self._first = frame.name
            return nothing_seen(frame.width, frame.height)
        size = self.coverage.width, self.coverage.height
        if size != (frame.width, frame.height):
            raise TooLittle(
                f"pictures must be of one size: {self._first} has {size[0]} x {size[1]} pixels, {frame.name} has "
                f"{frame.width} x {frame.height}. Use one camera with one setting, and do not turn it upright"
            )
        return self.coverage


def _moved(view: View, other: View) -> float:
    """How far the corners of both lie apart, pixels, in the median; infinite where they share too few."""
    _, here, there = np.intersect1d(view.ids, other.ids, return_indices=True)
    if len(here) < LEAST_CORNERS:
        return np.inf
    return float(np.median(np.linalg.norm(view.pixels[here] - other.pixels[there], axis=1)))
