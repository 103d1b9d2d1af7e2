"""Pages of printed markers of one size: what is put into a scene so that it gets metres."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import cv2

from splatnode.capture.calibration.board import DICTIONARIES, marker_rectangles
from splatnode.capture.calibration.pdf import PAPERS, Page, Paper, Rectangle, Text, pdf_of
from splatnode.capture.process.durable import write_atomically
from splatnode.capture.process.folders import make_folder
from splatnode.capture.process.terminal import say

DICTIONARY = "4X4_50"  # the coarsest bits, so that it is read from the farthest; a ChArUco board has others
_MARGIN_MM = 5.0  # of the paper, which printers leave white
_TEXT_MM = 3.5
_SMALLEST_MM = 5.0


@dataclass(frozen=True)
class Markers:
    """Markers of one size, `count` of them numbered from `first` on, as many on a page as it holds."""

    side_mm: float = 100.0  # of the black square
    first: int = 0
    count: int | None = None  # None: one page
    dictionary: str = DICTIONARY

    def __post_init__(self) -> None:
        if self.side_mm < _SMALLEST_MM:
            raise ValueError(f"a marker must be {_SMALLEST_MM:g} mm wide or more, got {self.side_mm:g}")
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"a marker's dictionary must be one of {', '.join(DICTIONARIES)}; got {self.dictionary!a}")
        if self.first + (self.count or 1) > self.num_there:
            raise ValueError(
                f"markers of {self.dictionary} are numbered from 0 to {self.num_there - 1}, "
                f"got {self.first} to {self.first + (self.count or 1) - 1}"
            )

    @property
    def num_there(self) -> int:
        """Markers that the dictionary has."""
        return len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).bytesList)

    @property
    def bit_mm(self) -> float:
        """The side of one of its bits: so much white is around it, by which it is found."""
        bits = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).markerSize + 2
        return self.side_mm / bits


def marker_pages(markers: Markers, paper: Paper) -> list[Page]:
    """The pages; below each marker a line says which it is and what must be measured.

    Raises ValueError where the paper is too small for one.
    """
    cell = markers.side_mm + 2 * markers.bit_mm, markers.side_mm + 2 * markers.bit_mm + 2 * _TEXT_MM
    columns = int((paper.width_mm - 2 * _MARGIN_MM) // cell[0])
    rows = int((paper.height_mm - 2 * _MARGIN_MM) // cell[1])
    if columns * rows == 0:
        raise ValueError(
            f"a marker of {markers.side_mm:g} mm needs {cell[0] + 2 * _MARGIN_MM:.0f} x "
            f"{cell[1] + 2 * _MARGIN_MM:.0f} mm with its white border; the paper has {paper.width_mm:g} x "
            f"{paper.height_mm:g} mm. Print a smaller one."
        )
    count = markers.count or min(columns * rows, markers.num_there - markers.first)
    numbers = range(markers.first, markers.first + count)
    left, top = (paper.width_mm - columns * cell[0]) / 2, (paper.height_mm - rows * cell[1]) / 2
    corners = [(left + x * cell[0], top + y * cell[1]) for y in range(rows) for x in range(columns)]
    return [
        _page(markers, paper, numbers[begin : begin + len(corners)], corners) for begin in range(0, count, len(corners))
    ]


def _page(markers: Markers, paper: Paper, numbers: Sequence[int], corners: Sequence[tuple[float, float]]) -> Page:
    marks, notes = list[Rectangle](), list[Text]()
    for number, (x, y) in zip(numbers, corners, strict=False):
        inner = x + markers.bit_mm, y + markers.bit_mm
        marks += marker_rectangles(markers.dictionary, number, *inner, markers.side_mm)
        note = f"{markers.dictionary}, number {number}. Print at 100 %: the black square is {markers.side_mm:g} mm wide"
        foot = y + markers.side_mm + 2 * markers.bit_mm + 1.2 * _TEXT_MM
        notes.append(Text(inner[0], foot, min(_TEXT_MM, markers.side_mm / 30), note))
    return Page(paper, marks, notes)


def command(args: argparse.Namespace) -> int:
    """The verb marker: writes the PDF, and says what to do with it."""
    markers = Markers(1e3 * args.side, args.first, args.count, args.dictionary)
    pages = marker_pages(markers, PAPERS[args.paper])
    try:
        with make_folder(args.file.parent):
            write_atomically(args.file, [pdf_of(pages, f"Markers of {markers.side_mm:g} mm")])
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(args.file)) from error
    shown = sum(len(page.texts) for page in pages)
    say(
        f"{args.file}: {shown} markers of {markers.side_mm:g} mm on {len(pages)} page{'s' if len(pages) > 1 else ''}. "
        "Print at 100 %, measure the black square with a ruler, lay them flat into the scene, photograph, and give "
        f"what you measured: splatnode replay photographs --out result --marker {markers.side_mm:g}mm"
    )
    return 0
