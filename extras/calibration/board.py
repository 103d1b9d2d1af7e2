"""The ChArUco board: a chessboard with a marker in each white square, so that a corner tells which it is."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.aruco import DICTIONARIES
from splatnode.capture.process.files import make_folder, write_atomically
from splatnode.capture.process.terminal import say

# Pages in exact millimetres as a PDF of vectors: filled rectangles and lines of text (ISO 32000-1), nothing else.

_POINTS_PER_MM = 72.0 / 25.4  # the unit of a PDF is 1/72 inch


@dataclass(frozen=True)
class Paper:
    width_mm: float
    height_mm: float

    @property
    def landscape(self) -> Paper:
        return Paper(max(self.width_mm, self.height_mm), min(self.width_mm, self.height_mm))


PAPERS = {"a4": Paper(210.0, 297.0), "letter": Paper(215.9, 279.4)}


@dataclass(frozen=True)
class Rectangle:
    """A black rectangle; its left upper corner is measured from the paper's, to the right and down."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float


@dataclass(frozen=True)
class Text:
    """A line of Helvetica, which every reader of PDFs has; (x, y) is where its base line begins, y down."""

    x_mm: float
    y_mm: float
    size_mm: float  # the height of the type
    text: str  # of Latin-1: PDF's own fonts have no others


@dataclass(frozen=True)
class Page:
    paper: Paper
    rectangles: Sequence[Rectangle]
    texts: Sequence[Text] = ()


def pdf_of(pages: Sequence[Page], title: str) -> bytes:
    """The file, the same for the same pages: it says no date. Its readers are asked to print it without scaling.

    Raises ValueError: no pages, or a character that is not of Latin-1.
    """
    if not pages:
        raise ValueError("a PDF must have a page, got none")
    first = 5  # of the objects that are a page each; its content comes after it
    kids = b" ".join(b"%d 0 R" % (first + 2 * number) for number in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Count %d /Kids [%s] >>" % (len(pages), kids),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title %s >>" % _string(title),
    ]
    for number, page in enumerate(pages):
        width, height = (_number(side * _POINTS_PER_MM) for side in (page.paper.width_mm, page.paper.height_mm))
        content = _content(page)
        objects += [
            b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 %s %s] /Resources << /Font << /F 3 0 R >> >> "
            b"/Contents %d 0 R >>" % (width, height, first + 2 * number + 1),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
        ]
    return _file(objects)


def _content(page: Page) -> bytes:
    """The page's operators. All rectangles are one path: between two that touch, no reader draws a light line."""
    scale = _number(_POINTS_PER_MM)
    lines = [b"q", b"%s 0 0 %s 0 0 cm" % (scale, scale), b"0 g"]  # from here on in millimetres, y up
    for mark in page.rectangles:
        corner = mark.x_mm, page.paper.height_mm - mark.y_mm - mark.height_mm
        lines.append(b"%s %s %s %s re" % tuple(map(_number, (*corner, mark.width_mm, mark.height_mm))))
    if page.rectangles:
        lines.append(b"f")
    for mark in page.texts:
        place = mark.size_mm, mark.x_mm, page.paper.height_mm - mark.y_mm
        lines.append(b"BT /F %s Tf %s %s Td %s Tj ET" % (*map(_number, place), _string(mark.text)))
    return b"\n".join([*lines, b"Q"])


def _file(objects: Sequence[bytes]) -> bytes:
    """The objects, numbered from 1, and the table of where each begins. Object 1 is the catalogue, 4 the title."""
    file = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n"  # PrintScaling is of 1.6; the bytes above 127 say that it is no text
    begins = []
    for number, content in enumerate(objects, 1):
        begins.append(len(file))
        file += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = b"".join(b"%010d 00000 n \n" % begin for begin in begins)
    size = len(objects) + 1
    trailer = b"trailer\n<< /Size %d /Root 1 0 R /Info 4 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (size, len(file))
    return file + b"xref\n0 %d\n0000000000 65535 f \n" % size + table + trailer


def _number(value: float) -> bytes:
    """To a millionth: below what any printer can show, also times a page's many units."""
    return f"{value:.6f}".rstrip("0").rstrip(".").encode("ascii")


def _string(text: str) -> bytes:
    try:
        raw = text.encode("latin-1")
    except UnicodeEncodeError:
        raise ValueError(f"a PDF's text must be of Latin-1, got {text[:100]!a}") from None
    for special in (b"\\", b"(", b")"):
        raw = raw.replace(special, b"\\" + special)
    return b"(" + raw + b")"


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


# Where a picture shows the corners of the board.

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


# Pages of printed markers of one size: what is put into a scene so that it gets metres.

DICTIONARY = "4X4_50"  # the coarsest bits, so that it is read from the farthest; a ChArUco board has others
_MARGIN_MM = 5.0  # of the paper, which printers leave white
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


# What pictures show in which the board was not found.

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
