"""How seconds and memory grow with the photographs: `python -m tests.bench growth --out DIR`.

The built-in capture's path in 3 to 48 steps, each reconstruction in a process of its own. With `--base FOLDER`, another
checkout, both are run in turns on the same photographs, and ratios are printed. `$SPLATNODE_ISA` narrows the core's
instruction set. `--redraw` draws the chart of docs/ from growth.json again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.dataset import write_training_images
from splatnode.extras.evaluate.report import describe_machine

ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "tests" / "bench" / "results" / "growth.json"
CHART = ROOT / "docs" / "growth.png"
COUNTS = (3, 6, 12, 24, 48)
STAGES = ("features", "matching", "mapping", "verification", "points", "refinement")


def measured(photographs: Path, preset: str) -> dict:
    """Seconds by stage, when the first scene came, and the peak memory of one reconstruction by this checkout."""
    run = Path(__file__).with_name("growth_run.py")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(run), str(photographs), preset]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def replayed(checkout: Path, photographs: Path, preset: str) -> dict:
    """The same of another checkout, by its command line: the cameras' seconds are not told apart."""
    with tempfile.TemporaryDirectory(prefix="splatnode-growth-") as out:
        command = [sys.executable, "-m", "splatnode", "replay", str(photographs), "--preset", preset, "--out", out]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.DEVNULL, check=True)
        report = json.loads(Path(out, "report.json").read_text())
    booked = report["seconds"]
    seconds = {"poses": booked["poses"], "points": booked["points"], "refinement": booked["optimise"]}
    told = {name: report[name] for name in ("num_gaussians", "peak_rss_mb")}
    found = {"verdict": report["verdict"]["code"], "cameras": len(report["cameras"])}
    return {**found, **told, "seconds": {**seconds, "total": booked["total"]}}


def rows_of(args: argparse.Namespace) -> list[dict]:
    """Every count of photographs by this checkout and the base, `--repeat` times in turns; each run is a row."""
    rows = []
    for views in args.views:
        folder = args.out / f"capture_{views}"
        if not (folder / "images").exists():
            write_training_images(folder, synthetic.Config(views=views))
        for _ in range(args.repeat):
            photographs = (folder / "images").resolve()
            found = {"new": measured(photographs, args.preset)}
            if args.base:
                found["base"] = replayed(args.base.resolve(), photographs, args.preset)
            for name, row in found.items():
                rows.append({"code": name, "views": views, **row})
                print(json.dumps(rows[-1]), flush=True)
    return rows


def quickest(rows: list[dict]) -> list[dict]:
    """Of the runs of one code with as many photographs, the one that took least: what disturbed others is left out."""
    best: dict[tuple[str, int], dict] = {}
    for row in rows:
        key = row["code"], row["views"]
        if key not in best or row["seconds"]["total"] < best[key]["seconds"]["total"]:
            best[key] = row
    return list(best.values())


def tell_ratios(rows: list[dict]) -> None:
    """Prints seconds by stage and peak memory as parts of the base's."""
    by_key = {(row["code"], row["views"]): row for row in quickest(rows)}
    for views in sorted({row["views"] for row in rows}):
        new, base = by_key["new", views], by_key["base", views]
        parts = {
            stage: round(new["seconds"][stage] / spent, 2)
            for stage, spent in base["seconds"].items()
            if spent >= 0.01 and stage in new["seconds"]
        }
        print(f"{views} views: {parts}, memory {new['peak_rss_mb'] / base['peak_rss_mb']:.2f}")


def draw(rows: list[dict], path: Path) -> None:
    """Seconds by stage as stacked bars, and peak memory, against the number of photographs."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = sorted((row for row in quickest(rows) if row["code"] == "new"), key=lambda row: row["views"])
    places, labels = range(len(rows)), [str(row["views"]) for row in rows]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.4), width_ratios=(2, 1))
    bottom = [0.0] * len(rows)
    for stage in STAGES:
        heights = [row["seconds"][stage] for row in rows]
        left.bar(places, heights, 0.7, bottom=bottom, label=stage)
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    left.set(ylabel="seconds", xlabel="photographs")
    left.legend(frameon=False, fontsize=8)
    right.bar(places, [row["peak_rss_mb"] / 1e3 for row in rows], 0.7, color="0.5")
    right.set(ylabel="peak memory, GB", xlabel="photographs")
    for axes in (left, right):
        axes.set_xticks(list(places), labels)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for the captures and growth.json")
    parser.add_argument("--base", type=Path, help="another checkout, to be run in turns with this one")
    parser.add_argument("--views", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--repeat", type=int, default=1, help="runs of each; the quickest counts")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--redraw", action="store_true", help="measure nothing: draw docs/growth.png again")
    args = parser.parse_args()
    if args.redraw:
        draw(json.loads(RESULTS.read_text())["rows"], CHART)
        return
    if args.out is None:
        parser.error("--out is needed")
    args.out.mkdir(parents=True, exist_ok=True)
    rows = rows_of(args)
    command = "python -m tests.bench " + " ".join(["growth", *sys.argv[1:]])
    machine = {**describe_machine(), "instruction_set": os.environ.get("SPLATNODE_ISA")}
    content = {"command": command, "machine": machine, "rows": rows}
    (args.out / "growth.json").write_text(json.dumps(content, indent=1) + "\n")
    draw(rows, args.out / "growth.png")
    if args.base:
        tell_ratios(rows)
