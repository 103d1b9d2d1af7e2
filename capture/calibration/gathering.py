"""The views of the board that are kept of what a camera sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import Board
from splatnode.capture.calibration.corners import LEAST_CORNERS, BoardView, corner_finder
from splatnode.capture.calibration.coverage import Coverage, add_picture, add_view, create_coverage
from splatnode.capture.calibration.lacking import TooLittle
from splatnode.capture.calibration.thinning import find_redundant_view
from splatnode.capture.frame import Frame

MOST_VIEWS = 100  # no fewer than the grid of `coverage` has cells
_STILL = 0.003  # of the longer side: a board that moved by more since the last picture may be smeared
_REPEATED = 0.01  # of the longer side: a view with nearly all corners nearer to those of another says nothing new
_HALF, _NEARLY_ALL = 0.5, 0.9  # of the corners: a tilt moves those at the board's ends, hardly those about its middle
_UNSEEN = 4  # pictures without the board that are kept, to find out why


class Gathering:
    """Takes pictures one at a time. Of a `moving` board only views are kept in which it was held still.

    Of more than MOST_VIEWS those are kept that see all that was seen, and lie farthest apart.
    """

    def __init__(self, board: Board, moving: bool) -> None:
        self.board, self.moving = board, moving
        self.pictures = 0
        self.views: list[BoardView] = []
        self.kept = 0  # views so far, with those that gave way to others
        self.coverage: Coverage | None = None  # before the first picture there is none
        self.unseen: list[npt.NDArray[np.uint8]] = []
        self._find = corner_finder(board)
        self._first = ""
        self._last: BoardView | None = None
        self._apart = np.empty((0, 0))  # (V, V) of the views, pixels; infinite on the diagonal

    @property
    def is_full(self) -> bool:
        """Whether a further view is only kept in place of another."""
        return len(self.views) == MOST_VIEWS

    def take(self, frame: Frame) -> BoardView | None:
        """The view, where it is kept. Raises TooLittle where the picture is not as large as those before."""
        self.coverage = self._same_size(frame)
        self.pictures += 1
        self.coverage = add_picture(self.coverage, frame.image)
        view, before = self._find(frame.name, frame.image), self._last
        self._last = view
        if view is None:
            if len(self.unseen) < _UNSEEN:
                self.unseen.append(frame.image)
            return None
        longer = max(frame.width, frame.height)
        if self.moving and (before is None or _compute_displacements(view, [before], _HALF)[0] > _STILL * longer):
            return None
        apart = _compute_displacements(view, self.views, _NEARLY_ALL)
        if (apart < _REPEATED * longer).any():
            return None
        return self._keep(view, apart, self.coverage)

    def _keep(self, view: BoardView, apart: npt.NDArray[np.float64], coverage: Coverage) -> BoardView | None:
        """The view, unless of all of them it is the one that says least."""
        self.views.append(view)
        self._apart = np.block([[self._apart, apart[:, None]], [apart[None], np.full((1, 1), np.inf)]])
        if len(self.views) > MOST_VIEWS:
            out = find_redundant_view(self.views, self._apart, coverage.width, coverage.height)
            self._apart = np.delete(np.delete(self._apart, out, axis=0), out, axis=1)
            if self.views.pop(out) is view:
                return None
        self.kept += 1
        self.coverage = add_view(coverage, view)  # what gave way was seen in others, too
        return view

    def _same_size(self, frame: Frame) -> Coverage:
        if self.coverage is None:
            self._first = frame.name
            return create_coverage(frame.width, frame.height)
        size = self.coverage.width, self.coverage.height
        if size != (frame.width, frame.height):
            raise TooLittle(
                f"pictures must be of one size: {self._first} has {size[0]} x {size[1]} pixels, {frame.name} has "
                f"{frame.width} x {frame.height}. Use one camera with one setting, and do not turn it upright"
            )
        return self.coverage


def _compute_displacements(
    view: BoardView, others: Sequence[BoardView], share: float
) -> npt.NDArray[np.float64]:  # (V,)
    """How far this share of corners is from those of each other at most, pixels; infinite where too few are in both."""
    numbers = 1 + max(int(each.ids.max()) for each in (view, *others))
    places = np.full((len(others), numbers, 2), np.nan)
    for place, other in zip(places, others, strict=True):
        place[other.ids] = other.pixels
    off = np.sort(np.linalg.norm(places[:, view.ids] - view.pixels, axis=-1), axis=1)  # what is not in both is last
    common = np.isfinite(off).sum(axis=1)
    last = np.maximum(np.ceil(share * common).astype(int) - 1, 0)
    return np.where(common < LEAST_CORNERS, np.inf, off[np.arange(len(others)), last])
