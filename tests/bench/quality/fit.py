"""Fits the numbers of the verdict: `python -m tests.bench fit RESULT.json ... [--write] [--out DIR]`.

The results are windows.json of `splatnode robustness --windows` (also with `--counts 2`, for pairs) and stability.json
of `splatnode robustness`. What is printed, and kept in DIR/fit.json, is cross-validated: each scene is judged by
numbers that were fitted without it. So are DIR/windows.json, with all methods of the results, and its charts. --write
puts the numbers that all scenes together give into recon/verification/fitted.py.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import msgspec

from splatnode.extras.evaluate.stability import window_campaign
from splatnode.extras.evaluate.stability.fitting import (
    fit_models,
    fit_without_each_scene,
    format_module,
    load_results,
    make_report,
    pair_held_out_models,
    read_samples,
    rejudge_rows,
)
from splatnode.extras.evaluate.stability.window_campaign import format_report, summarise
from splatnode.extras.evaluate.stability.windows import COUNTS, WindowRow
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.verification.error_model import VerdictModel, VerdictModels

KEPT = ("scene", "count", "stride", "start", "angle_deg", "method", "verdict", "published", "right")  # of a row
MODULE = Path("recon/verification/fitted.py")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="windows.json and stability.json")
    parser.add_argument("--write", action="store_true", help=f"write {MODULE}")
    parser.add_argument("--out", type=Path, help="folder for fit.json, windows.json and charts")
    arguments = parser.parse_args()
    samples = read_samples(arguments.results)
    many, pairs = ([sample for sample in samples if sample.is_pair is pair] for pair in (False, True))
    of_many, of_pairs = fit_without_each_scene(many), fit_without_each_scene(pairs)
    numbers = VerdictModels(fit_models(many), fit_models(pairs))
    found = {
        "many": {"samples": len(many), "cross_validated": make_report(pair_held_out_models(many, of_many))},
        "pair": {"samples": len(pairs), "cross_validated": make_report(pair_held_out_models(pairs, of_pairs))},
        "numbers": asdict(numbers),
    }
    print(json.dumps(found, indent=1))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        write_file(arguments.out / "fit.json", json_bytes(found))
        _windows(arguments.results, of_many, arguments.out)
    if arguments.write:
        MODULE.write_text(format_module(numbers))


def _windows(results: list[Path], numbers: Mapping[str, VerdictModel], out: Path) -> None:
    """windows.json of all windows in `results`, judged by the numbers without their scene, its charts and tables."""
    contents = [content for content in map(load_results, results) if "rows" in content]
    contents = [content for content in contents if content.get("told", "nothing") == "nothing"]
    rows = [row for content in contents for row in msgspec.convert(content["rows"], list[WindowRow])]
    judged = rejudge_rows([row for row in rows if row.count in COUNTS], numbers)
    records = [{**{name: getattr(row, name) for name in KEPT}, "found": row.outcome.value} for row in judged]
    write_file(out / "windows.json", json_bytes({"summary": summarise(judged), "rows": records}))
    window_campaign.draw(judged, out)
    print("\n".join(format_report(judged)))


if __name__ == "__main__":
    main()
