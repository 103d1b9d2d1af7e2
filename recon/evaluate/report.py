"""A benchmark for people to read: report.md, and report.html with charts and with renders beside their photographs."""

from __future__ import annotations

import html
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from splatnode.capture.process.printable import escape_text
from splatnode.recon.evaluate.contest import make_case_tables
from splatnode.recon.evaluate.protocol import Row
from splatnode.recon.evaluate.records import Bench, make_bench_files
from splatnode.recon.evaluate.renders import PHOTOGRAPH, find_renders
from splatnode.recon.evaluate.tables import Table, format_number, make_tables
from splatnode.recon.result.export.staged import write_files

logger = logging.getLogger(__name__)

_STARTS = {"true": "the true pose", "interpolated": "between the neighbouring cameras"}
_GAINS = {False: "", True: ", in the exposure and white balance of each held-out photograph"}
_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1500px;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0;display:block;overflow-x:auto}td,th{border-bottom:1px solid #ddd;"
    "padding:.25em .7em;text-align:right;white-space:nowrap}td:first-child,th:first-child{text-align:left}"
    "img{max-width:100%}figure{display:inline-block;width:23%;margin:.4em}figcaption{font-size:13px;color:#666}"
)


def make_report_files(bench: Bench, out_dir: Path) -> dict[str, bytes]:
    """report.md and report.html; the latter shows the charts and renders that lie in `out_dir`."""
    found = [*make_case_tables([row for row in bench.rows if row.final]), *make_tables(bench.rows)]
    return {
        "report.md": _format_markdown(bench, found).encode(),
        "report.html": _format_html(bench, found, out_dir).encode(),
    }


def redraw(bench: Bench, out_dir: Path) -> None:
    """Everything that can be made of bench.json: the file itself, as CSV, the charts and both reports."""
    write_files(out_dir, make_bench_files(bench) | _draw_charts(bench))
    write_files(out_dir, make_report_files(bench, out_dir))


def _draw_charts(bench: Bench) -> dict[str, bytes]:
    """Those that there are numbers for; none without matplotlib to draw them."""
    try:
        from splatnode.recon.evaluate import case_chart, charts
    except ImportError:
        logger.warning("no charts: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
        return {}
    drawn = charts.draw(bench.rows) | case_chart.draw(bench.rows)
    if not drawn:
        logger.warning("no charts: no run published a scene that could be scored")
    return drawn


def _format_introduction(bench: Bench) -> str:
    machine, settings = bench.machine, bench.settings
    return (
        f"Machine: {machine.get('processor')}, {machine.get('threads')} threads. Held-out views are scored after their "
        f"pose was found in the finished scene ({settings.alignment_steps} steps from {_STARTS[settings.start]}, "
        "equation 18), at "
        f"{settings.longer_side} px, without the black rim that undistortion left (`with rim`: PSNR of the whole "
        f"photograph){_GAINS[settings.best_gain]}. "
        "Seconds are wall time of the reconstruction alone, with the cameras and points that methods of "
        "one prior share; of runs that did not have their cores alone, or had other cores than the rest, there are "
        "none. Means are over the runs that every method was put to and, of these, the method's that "
        "published a scene; `±`: standard deviation "
        "between seeds; `–`: not measured."
    )


def _format_markdown(bench: Bench, found: Sequence[Table]) -> str:
    lines = [
        "# Benchmark",
        "",
        f"Command: `{escape_text(bench.command)}`",
        "",
        escape_text(_format_introduction(bench)),
    ]
    for table in found:
        head, *body = ([_escape_cell(cell) for cell in row] for row in (table.head, *table.body))
        rows = (head, ["---"] * len(head), *body)
        lines += ["", f"## {table.title}", "", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


def _escape_cell(raw: str) -> str:
    return escape_text(raw).replace("|", "\\|").replace("<", "&lt;")


def _format_html(bench: Bench, found: Sequence[Table], out_dir: Path) -> str:
    charts = [path.name for path in sorted(out_dir.glob("*.png"))]
    parts = [
        f"<h1>Benchmark</h1><p><code>{_escape_text(bench.command)}</code></p><p>{_escape_text(_format_introduction(bench))}</p>",
        *(f'<p><img src="{_quote_path(name)}" alt="{_escape_text(name)}"></p>' for name in charts),
        *(_format_html_table(table) for table in found),
        *_format_galleries([row for row in bench.rows if row.final], out_dir),
    ]
    head = f'<meta charset="utf-8"><title>Benchmark</title><style>{_STYLE}</style>'
    return f"<!DOCTYPE html><html><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _format_html_table(table: Table) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{_escape_text(cell)}</{tag}>' for cell in cells)}</tr>"

    body = "".join(line(row, "td") for row in table.body)
    return f"<h2>{_escape_text(table.title)}</h2><table>{line(table.head, 'th')}{body}</table>"


def _format_galleries(ends: Sequence[Row], out_dir: Path) -> list[str]:
    """For each set of photographs and each kept test view: the photograph, then every run's render of it."""
    parts = []
    for scene, views in dict.fromkeys((row.scene, row.views) for row in ends):
        shown: dict[str, list[str]] = {}
        for row in (row for row in ends if (row.scene, row.views) == (scene, views)):
            for view, path in find_renders(out_dir, row).items():
                photograph = _format_figure(path.parent / PHOTOGRAPH, f"{view}: photograph", out_dir)
                caption = f"{row.method}, seed {row.seed}: {format_number(row.psnr, 2)} dB over all views"
                shown.setdefault(view, [photograph]).append(_format_figure(path, caption, out_dir))
        if shown:
            parts.append(f"<h2>{_escape_text(scene)}, {views} views</h2>")
            parts += [f"<div>{''.join(figures)}</div>" for figures in shown.values()]
    return parts


def _format_figure(path: Path, caption: str, out_dir: Path) -> str:
    source = _quote_path(os.path.relpath(path, out_dir).replace(os.sep, "/"))
    return f'<figure><img src="{source}" loading="lazy"><figcaption>{_escape_text(caption)}</figcaption></figure>'


def _escape_text(raw: str) -> str:
    """Escapes a name for a page: neither markup nor a character that does more than show."""
    return html.escape(escape_text(raw))


def _quote_path(path: str) -> str:
    """A file's name as an address relative to the page; no byte of it is markup, a scheme or a question."""
    return quote(os.fsencode(path))
