"""What pictures show in which the board was not found."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import DICTIONARIES, Board

_LEAST_MARKERS = 3  # in one picture: fewer are found in noise, too


def explain_missing_board(images: Sequence[npt.NDArray[np.uint8]], board: Board) -> str:
    """Why `board` was not found in any of `images` (H, W, 3), and what to do, in a sentence."""
    greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    own = _markers(greys, board.dictionary)
    if len(own) >= _LEAST_MARKERS:
        if max(own) >= board.num_markers:
            return (
                f"there are markers of {board.dictionary} up to number {max(own)}, and a board of {board.columns} x "
                f"{board.rows} squares has them up to {board.num_markers - 1}: another board. Give --columns and "
                "--rows as they were printed"
            )
        return (
            f"{len(own)} markers of {board.dictionary} are seen, but too few of the corners between them, or they do "
            f"not lie as on a board of {board.columns} x {board.rows} squares: bring it closer; if it was printed "
            "otherwise, give --columns and --rows"
        )
    if len(_markers([cv2.flip(grey, 1) for grey in greys], board.dictionary)) >= _LEAST_MARKERS:
        return "the pictures are mirrored, and markers can be read only as they are: turn mirroring off"
    others = [name for name in DICTIONARIES if _family(name) != _family(board.dictionary)]
    largest = {_family(name): name for name in sorted(others, key=_size)}
    counts = {family: len(_markers(greys, name)) for family, name in largest.items()}
    most = max(counts, key=lambda family: counts[family])
    if counts[most] >= _LEAST_MARKERS:
        advice = f"{most}_250" if f"{most}_250" in DICTIONARIES else largest[most]
        return f"the board has markers of {most}, not of {board.dictionary}: give --dictionary, such as {advice}"
    return "no marker of any known kind can be read: show the board from nearer, in more light, and sharp"


def _family(dictionary: str) -> str:
    """5X5 of 5X5_100: of all that have markers of so many bits."""
    return dictionary.partition("_")[0]


def _size(dictionary: str) -> int:
    """How many markers it has."""
    return len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]).bytesList)


def _markers(greys: Sequence[npt.NDArray], dictionary: str) -> list[int]:
    """The markers of the picture that shows most of them."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]))
    found = [detector.detectMarkers(grey)[1] for grey in greys]
    return max(([] if ids is None else [int(each) for each in ids.ravel()] for ids in found), key=len, default=[])
