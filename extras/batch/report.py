"""index.html: counts by verdict, and a row with a picture for each recording. It needs no other file to be shown."""

from __future__ import annotations

import base64
import contextlib
import csv
import html
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from urllib.parse import quote

import cv2
import msgspec
import numpy as np

from splatnode.capture.cameras.folder import image_paths
from splatnode.capture.image_file import UnusableImage, read_image_file
from splatnode.capture.process.files import sync_folder
from splatnode.capture.process.library_lines import catch_library_lines
from splatnode.capture.process.text import cell, escape_text
from splatnode.extras.batch.batch import Outcome
from splatnode.recon.result.snapshot import format_rounded_up

# A small picture of each recording, for the page: its result's preview, or a photograph where there is no scene.

PREVIEW = "preview.png"
_WIDTH, _QUALITY = 320, 70  # pixels, of JPEG


def make_data_url(result: Path, source: Path) -> str | None:
    """A `data:` address of a JPEG; None where there is nothing to show."""
    path = result / PREVIEW
    if not path.is_file():
        photographs = image_paths(source) if source.is_dir() else []
        if not photographs:
            return None
        path = photographs[len(photographs) // 2]
    try:
        data = read_image_file(path)
    except (UnusableImage, OSError):
        return None
    with catch_library_lines():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
    return None if image is None else _encode_preview(image)


def _encode_preview(image: np.ndarray) -> str:
    height, width = image.shape[:2]
    size = min(_WIDTH, width), max(1, round(height * min(_WIDTH, width) / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


# batch.csv, and batch.parquet where pyarrow is installed: a row for each recording, written row by row.

CSV, PARQUET = "batch.csv", "batch.parquet"
COLUMNS = Outcome.__struct_fields__
BEING_WRITTEN = ".partial"  # the end of the hidden name under which a file is written; a killed process leaves it


def write_csv(path: Path, rows: Iterable[Outcome]) -> None:
    """Writes rows; the unknown is empty, text is what a spreadsheet takes for text. Raises OSError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow(map(cell, msgspec.structs.astuple(escape_source(row))))


def write_parquet(path: Path, rows: Iterable[Outcome]) -> None:
    """Raises ModuleNotFoundError without pyarrow, OSError."""
    from splatnode.extras.batch import pyarrow as batch_pyarrow  # takes half a second, and is an extra

    with replacing(path) as temporary:
        batch_pyarrow.write(temporary, map(escape_source, rows))


def escape_source(row: Outcome) -> Outcome:
    """Returns the row with its source as text: bytes of a file's name that are no UTF-8 become escapes."""
    return msgspec.structs.replace(row, source=escape_text(row.source))


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file that takes the place of `path` at the end, and is on the disk then; else it is removed."""
    temporary = path.with_name(f".{path.name}{BEING_WRITTEN}")
    temporary.unlink(missing_ok=True)
    try:
        temporary.touch(exist_ok=False)  # what the name led to, if it was a link, stays as it is
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


PAGE = "index.html"
_MOST_PICTURES = 2000  # of about 10 kB; the recordings after them are shown without
_HEADS = (
    "",
    "recording",
    "verdict",
    "directions to",
    "positions to",
    "photographs",
    "Gaussians",
    "seconds",
    "MB of memory",
)
_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1500px;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border-bottom:1px solid #ddd;padding:.3em .7em;"
    "text-align:right;vertical-align:top}td.text,th.text{text-align:left}td.text{max-width:32em;overflow-wrap:anywhere}"
    "img{display:block;width:240px}small{color:#666}tr:target{background:#fffbe0}"
)


def write_page(path: Path, rows: Iterable[Outcome], verdicts: Mapping[str, int]) -> None:
    """`rows` in the order of `verdicts`, which counts them; their results lie beside `path`. Raises OSError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(_lines(rows, verdicts, path.parent))


def _lines(rows: Iterable[Outcome], verdicts: Mapping[str, int], folder: Path) -> Iterator[str]:
    yield f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Batch</title><style>{_STYLE}</style>'
    yield f"</head><body><h1>{sum(verdicts.values())} recordings</h1>\n<table><tr>"
    yield '<th class="text">verdict</th><th>recordings</th></tr>\n'
    for code, count in verdicts.items():
        yield f'<tr><td class="text"><a href="#{_text(code)}">{_text(code)}</a></td><td>{count}</td></tr>\n'
    yield "</table>\n<p>Each claim holds for 95 % of all cameras: directions in degrees, positions in percent of the "
    yield "distance to the scene. Seconds are of one core, from the start of the process to its end.</p>\n<table><tr>"
    yield "".join(f"<th{_format_class(head)}>{head}</th>" for head in _HEADS) + "</tr>\n"
    last = None
    for number, row in enumerate(rows):
        picture = make_data_url(folder / row.name, Path(row.source)) if number < _MOST_PICTURES else None
        yield _row(row, picture, begins=row.verdict != last)
        last = row.verdict
    yield "</table></body></html>\n"


def _row(row: Outcome, picture: str | None, begins: bool) -> str:
    target = f"{row.name}.log" if row.has_failed else f"{row.name}/"
    image = f'<img src="{picture}" alt="" loading="lazy">' if picture else ""
    link = f'<a href="./{_path(target)}">{_text(row.name)}</a>'
    cells = [
        f"<td>{image}</td>",
        f'<td class="text">{link}<br><small>{_text(row.source)}</small></td>',
        f'<td class="text"><b>{_text(row.verdict)}</b><br>{_text(row.message)}</td>',
        _cell(None if row.rotation_deg is None else f"{format_rounded_up(row.rotation_deg)}°"),
        _cell(None if row.centre_percent is None else f"{format_rounded_up(row.centre_percent)} %"),
        _cell(_format_count(row.photographs, row.left_out)),
        _cell(row.gaussians),
        _cell(f"{row.seconds:.1f}"),
        _cell(f"{row.memory_mb:.0f}"),
    ]
    mark = f' id="{_text(row.verdict)}"' if begins else ""
    return f"<tr{mark}>{''.join(cells)}</tr>\n"


def _format_count(placed: int | None, left_out: int | None) -> str | None:
    if placed is None:
        return None
    return f"{placed} of {placed + left_out}" if left_out else str(placed)


def _format_class(head: str) -> str:
    return ' class="text"' if head in ("recording", "verdict") else ""


def _cell(value: object) -> str:
    return f"<td>{'' if value is None else value}</td>"


def _text(raw: str) -> str:
    """Escapes untrusted text for the page: no markup, and no character that does more than show."""
    return html.escape(escape_text(raw))


def _path(name: str) -> str:
    """A file's name as an address relative to the page; no byte of it is markup, a scheme or a question."""
    return quote(os.fsencode(name))
