"""Where a picture shows the corners of the board."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import Board

Array = npt.NDArray[np.float64]

LEAST_CORNERS = 8  # of a view: six numbers of its pose, and something left to learn of the lens
_WINDOW_PX = (2, 12)  # half the side of what is looked at around a corner
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners that one picture shows."""

    name: str  # of the picture
    ids: npt.NDArray[np.intp]  # (N,) which corners of the board
    pixels: Array  # (N, 2); the centre of the top-left pixel is (0.5, 0.5)


def corner_finder(board: Board) -> Callable[[str, npt.NDArray[np.uint8]], BoardView | None]:
    """Returns the finder of the board in a named picture (H, W, 3) RGB; it gives None where too little is shown."""
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1  # beside a corner: else none is found within a square of the picture's border
    detector = cv2.aruco.CharucoDetector(board.charuco, parameters)

    def find(name: str, image: npt.NDArray[np.uint8]) -> BoardView | None:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, ids, _, _ = detector.detectBoard(grey)
        if ids is None or len(ids) < LEAST_CORNERS:
            return None
        which = ids.ravel().astype(np.intp)
        if _is_collinear(which, board):
            return None
        return BoardView(name, which, _refine_corners(grey, corners.reshape(-1, 2), which, board) + 0.5)

    return find


def _is_collinear(ids: npt.NDArray[np.intp], board: Board) -> bool:
    """Whether the corners are too much in a row to fix a pose: fewer than two rows or columns of the board."""
    across = board.columns - 1
    return len(np.unique(ids // across)) < 2 or len(np.unique(ids % across)) < 2


def _refine_corners(grey: npt.NDArray, corners: npt.NDArray, ids: npt.NDArray[np.intp], board: Board) -> Array:
    """The corners (N, 2) to a fraction of a pixel, each looked at in a window that holds no other corner or marker."""
    place = {int(each): number for number, each in enumerate(ids)}
    across = board.columns - 1
    inset = (board.square_mm - board.marker_mm) / (2 * board.square_mm)
    refined = corners.astype(np.float64)
    for number, each in enumerate(map(int, ids)):
        beside = [each + 1] if (each + 1) % across else []
        beside += [each - 1] if each % across else []
        known = [place[other] for other in (*beside, each + across, each - across) if other in place]
        if not known:
            continue
        apart = min(float(np.linalg.norm(corners[number] - corners[other])) for other in known)
        half = int(np.clip(apart * inset, *_WINDOW_PX))
        start = corners[number].reshape(1, 1, 2).astype(np.float32)
        found = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), _CRITERIA).reshape(2)
        if np.abs(found - corners[number]).max() < half:
            refined[number] = found
    return refined
