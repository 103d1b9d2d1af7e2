"""The ChArUco board: a chessboard with a marker in each white square, so that a corner tells which it is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.pdf import Page, Paper, Rectangle, Text

DICTIONARIES = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in sorted(dir(cv2.aruco))
    if name.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6", "DICT_7X7", "DICT_APRILTAG_36h11"))
}  # by the name that people write, such as 5X5_100
_TEXT_MM = 3.5


@dataclass(frozen=True)
class Board:
    """OpenCV's CharucoBoard (not its legacy pattern): the left upper square is black."""

    columns: int = 10  # squares
    rows: int = 7  # squares
    square_mm: float = 26.0  # A4 and Letter both hold the default board
    marker_mm: float = 19.0
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"a board must have 3 x 3 squares or more, got {self.columns} x {self.rows}")
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"a board's dictionary must be one of {', '.join(DICTIONARIES)}; got {self.dictionary!a}")
        there = len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).bytesList)
        if self.num_markers > there:
            raise ValueError(
                f"a board of {self.columns} x {self.rows} squares needs {self.num_markers} markers; "
                f"the dictionary {self.dictionary} has {there}"
            )
        if not 0.0 < self.marker_mm < self.square_mm:
            raise ValueError(
                f"a marker must be smaller than its square of {self.square_mm:g} mm, got {self.marker_mm:g}"
            )

    @property
    def num_markers(self) -> int:
        return self.columns * self.rows // 2

    @property
    def num_corners(self) -> int:
        """Returns the number of corners where four squares meet: what is measured."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def charuco(self) -> cv2.aruco.CharucoBoard:
        """The same board in millimetres, for OpenCV."""
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, dictionary)

    @property
    def corners(self) -> npt.NDArray[np.float64]:  # (num_corners, 3)
        """Millimetres from the left upper corner of the board: x right, y down, z 0."""
        return np.asarray(self.charuco.getChessboardCorners(), np.float64)

    def __str__(self) -> str:
        return f"{self.columns} x {self.rows} squares with markers of {self.dictionary}"


def marker_rectangles(dictionary: str, marker: int, x_mm: float, y_mm: float, side_mm: float) -> list[Rectangle]:
    """Returns the black rectangles of an ArUco marker at (x, y), its upper left corner, with its border of one bit."""
    definition = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    bits = definition.markerSize + 2  # a border bit on each side
    dark = cv2.aruco.generateImageMarker(definition, marker, bits) == 0
    bit = side_mm / bits
    runs = [(row, *run) for row in range(bits) for run in _runs(dark[row])]
    return [Rectangle(x_mm + a * bit, y_mm + row * bit, (b - a) * bit, bit) for row, a, b in runs]


def _runs(dark: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Finds where the dark parts of a row begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def board_page(board: Board, paper: Paper) -> Page:
    """The board in the middle of the paper laid across, with a line that says what to measure.

    Raises ValueError where the paper is too small for it.
    """
    across = paper.landscape
    width, height = board.columns * board.square_mm, board.rows * board.square_mm
    left, top = (across.width_mm - width) / 2, (across.height_mm - height) / 2
    if left < 5.0 or top < 2 * _TEXT_MM:
        raise ValueError(
            f"the board is {width:g} x {height:g} mm; paper of {across.width_mm:g} x {across.height_mm:g} mm has no "
            "room for it with its margins. Make the squares smaller."
        )
    square, inset = board.square_mm, (board.square_mm - board.marker_mm) / 2
    marks, marker = [], 0
    for row in range(board.rows):
        for column in range(board.columns):
            x, y = left + column * square, top + row * square
            if (row + column) % 2 == 0:
                marks.append(Rectangle(x, y, square, square))
            else:
                marks += marker_rectangles(board.dictionary, marker, x + inset, y + inset, board.marker_mm)
                marker += 1
    note = (
        f"splatnode calibrate: ChArUco {board}. Print at 100 %, glue it to something flat: a square must be "
        f"{square:g} mm wide, the board {width:g} mm."
    )
    return Page(across, marks, [Text(min(left, 10.0), top + height + 1.8 * _TEXT_MM, _TEXT_MM, note)])
