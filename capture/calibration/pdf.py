"""Pages in exact millimetres as a PDF of vectors: filled rectangles and lines of text (ISO 32000-1), nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
