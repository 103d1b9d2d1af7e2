"""`python -m tests.bench NAME [options]` runs the benchmark NAME, a file of one of the folders beside this one.

`python -m tests.bench` lists them, with the first words of their docstrings.
"""

from __future__ import annotations

import ast
import importlib
import re
import sys
from pathlib import Path

# Folder -> its benchmarks; its other files are parts of theirs.
BENCHMARKS = {
    "node": (
        "batch_simulation",
        "batch_ray",
        "queue",
        "live",
        "growing",
        "stream",
        "building",
        "film",
        "merge",
        "faults",
        "walk_faults",
        "kills",
        "soak",
        "siege",
        "capture",
        "publisher",
    ),
    "quality": (
        "poses",
        "windows",
        "fit",
        "priors",
        "parsimony",
        "budgets",
        "spz",
        "needles",
        "locate",
        "query_lenses",
        "audit",
        "race",
        "movers",
        "fisheyes",
        "light",
        "drift",
        "free_path",
        "told_lenses",
        "told_light",
        "vignetting",
        "bent",
        "unknown_lenses",
        "calibrate",
        "occupancy",
        "walk_occupancy",
        "metres",
        "motions",
        "consistent_depth",
        "lens_assumptions",
        "registrations",
        "known_poses",
        "given_scenes",
        "odometry_sets",
        "odometry_walk",
        "plain_rooms",
        "plain_view",
        "several_cameras",
        "rigs",
        "rgbd",
        "rgbd_real",
    ),
    "speed": ("rasterize", "stereo", "growth", "throughput", "campaign"),
    "viewer": ("viewer", "dragging", "drive", "drive_web", "beside"),
}
MODULES = {name: f"tests.bench.{folder}.{name}" for folder, names in BENCHMARKS.items() for name in names}


def describe(name: str) -> str:
    """Returns what a benchmark measures: its docstring up to its command, or its first sentence."""
    path = Path(__file__).parents[2].joinpath(*MODULES[name].split(".")).with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return re.split(r":\s+`|\.\s|\.$", " ".join(text.split()))[0]


if __name__ == "__main__":
    if len(sys.argv) < 2:
        print("\n".join(f"{name:17s} {describe(name)}" for name in sorted(MODULES)))
        sys.exit()
    if sys.argv[1] not in MODULES:
        sys.exit(f"usage: python -m tests.bench {{{','.join(sorted(MODULES))}}} [options]")
    importlib.import_module(MODULES[sys.argv.pop(1)]).main()
