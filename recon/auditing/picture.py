"""An audit as a picture (SVG): a row a camera, a column a recording, another colour after each move."""

from __future__ import annotations

import html

from splatnode.recon.auditing.audit import Audit
from splatnode.recon.auditing.table import format_amount

_CELL, _GAP, _LEFT, _TOP, _LINE = 26, 2, 170, 120, 30  # pixels
_WORDS = 400  # pixels beside the cells, for what a camera did
_MOST_NAMES = 40  # recordings whose names are written; of more, some
_COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#e45756", "#72b7b2", "#9d755d", "#eeca3b")
_NOT_SEEN = "#dddddd"
_LONGEST = 22  # characters of a name that are written


def draw_audit(audit: Audit) -> bytes:
    """The picture; what a cell stands for is told where the mouse rests on it."""
    cameras = sorted({*audit.periods, *audit.not_seen})
    right = _LEFT + len(audit.recordings) * _CELL + 10
    width = right + _WORDS
    height = _TOP + len(cameras) * _LINE + 60
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    every = max(1, -(-len(audit.recordings) // _MOST_NAMES))
    for number in range(0, len(audit.recordings), every):
        x = _LEFT + number * _CELL + _CELL / 2
        name = _escape_name(audit.recordings[number])
        parts.append(f'<text transform="translate({x + 4},{_TOP - 8}) rotate(-60)">{name}</text>')
    for row, camera in enumerate(cameras):
        y = _TOP + row * _LINE
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 18}" text-anchor="end">{_escape_name(camera)}</text>')
        not_seen = {number: f"{each.code}: {each.message}" for number, each in audit.not_seen.get(camera, {}).items()}
        for number, told in {**audit.unreadable, **not_seen}.items():
            parts.append(_draw_cell(number, y, _NOT_SEEN, told))
        for index, period in enumerate(audit.periods.get(camera, ())):
            told = (
                "where it stood first" if period.came_by is None else f"moved by {format_amount(audit, period.came_by)}"
            )
            for number in period.recordings:
                parts.append(_draw_cell(number, y, _COLOURS[index % len(_COLOURS)], told))
            if period.came_by is not None:
                x = _LEFT + period.recordings[0] * _CELL - _GAP / 2
                parts.append(
                    f'<line x1="{x}" x2="{x}" y1="{y - 2}" y2="{y + _CELL + 2}" stroke="black" stroke-width="3"/>'
                )
        did = [format_amount(audit, each.came_by) for each in audit.periods.get(camera, ()) if each.came_by is not None]
        words = did[0] if len(did) == 1 else f"{len(did)} moves" if did else ""
        parts.append(f'<text x="{right}" y="{y + 18}">{html.escape(words)}</text>')
    y = _TOP + len(cameras) * _LINE + 28
    parts.append(f'<rect x="{_LEFT}" y="{y - 11}" width="12" height="12" fill="{_NOT_SEEN}"/>')
    parts.append(f'<text x="{_LEFT + 18}" y="{y}">not compared; a bar: the camera moved</text>')
    return "\n".join([*parts, "</svg>\n"]).encode()


def _draw_cell(number: int, y: float, colour: str, told: str) -> str:
    x = _LEFT + number * _CELL
    rectangle = f'<rect x="{x}" y="{y}" width="{_CELL - _GAP}" height="{_CELL}" fill="{colour}">'
    return f"{rectangle}<title>{html.escape(told)}</title></rect>"


def _escape_name(name: str) -> str:
    return html.escape(name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}")
