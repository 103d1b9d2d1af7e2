"""Fits the numbers of the verdict: `python -m tests.bench fit RESULT.json ... [--write] [--out DIR]`.

The results are windows.json of `splatnode stability --windows` (also with `--counts 2`, for pairs) and stability.json
of `splatnode stability`. What is printed, and kept in DIR/fit.json, is cross-validated: each scene is judged by numbers
that were fitted without it. So are DIR/windows.json, with all methods of the results, and its charts. --write puts the
numbers that all scenes together give into recon/verification/fitted.py.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import msgspec

from splatnode.recon.evaluate.stability.fitting.cross_validation import fitted, left_out, report, without_each_scene
from splatnode.recon.evaluate.stability.fitting.module import source
from splatnode.recon.evaluate.stability.fitting.rejudged import rejudged
from splatnode.recon.evaluate.stability.fitting.samples import load, read
from splatnode.recon.evaluate.stability.windows import charts
from splatnode.recon.evaluate.stability.windows.command import report_lines
from splatnode.recon.evaluate.stability.windows.row import Row
from splatnode.recon.evaluate.stability.windows.summary import summarise
from splatnode.recon.evaluate.stability.windows.window import COUNTS
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.verification.models import Fitted, Numbers

KEPT = ("scene", "count", "stride", "start", "angle_deg", "method", "verdict", "published", "right")  # of a row
MODULE = Path("recon/verification/fitted.py")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="windows.json and stability.json")
    parser.add_argument("--write", action="store_true", help=f"write {MODULE}")
    parser.add_argument("--out", type=Path, help="folder for fit.json, windows.json and charts")
    arguments = parser.parse_args()
    samples = read(arguments.results)
    many, pairs = ([sample for sample in samples if sample.pair is pair] for pair in (False, True))
    of_many, of_pairs = without_each_scene(many), without_each_scene(pairs)
    numbers = Fitted(fitted(many), fitted(pairs))
    found = {
        "many": {"samples": len(many), "cross_validated": report(left_out(many, of_many))},
        "pair": {"samples": len(pairs), "cross_validated": report(left_out(pairs, of_pairs))},
        "numbers": asdict(numbers),
    }
    print(json.dumps(found, indent=1))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        write_file(arguments.out / "fit.json", json_bytes(found))
        _windows(arguments.results, of_many, arguments.out)
    if arguments.write:
        MODULE.write_text(source(numbers))


def _windows(results: list[Path], numbers: Mapping[str, Numbers], out: Path) -> None:
    """windows.json of all windows in `results`, judged by the numbers without their scene, its charts and tables."""
    contents = [content for content in map(load, results) if "rows" in content]
    contents = [content for content in contents if content.get("told", "nothing") == "nothing"]
    rows = [row for content in contents for row in msgspec.convert(content["rows"], list[Row])]
    judged = rejudged([row for row in rows if row.count in COUNTS], numbers)
    records = [{**{name: getattr(row, name) for name in KEPT}, "found": row.found.value} for row in judged]
    write_file(out / "windows.json", json_bytes({"summary": summarise(judged), "rows": records}))
    charts.draw(judged, out)
    print("\n".join(report_lines(judged)))


if __name__ == "__main__":
    main()
