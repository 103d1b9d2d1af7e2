"""What benches of real scenes share: their arguments, and a raw file that grows set by set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene, load_split
from splatnode.extras.evaluate.methods import Start, continue_reconstruction
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Row, Run, Settings, evaluate, load_networks
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.snapshot import Snapshot


def timed(
    made: Callable[[], Snapshot],
    scene: EvaluationScene,
    split: Split,
    networks: PerceptualNetworks,
    settings: Settings = Settings(),  # noqa: B008 (it is frozen)
) -> tuple[Snapshot, Row, float]:
    """What `made` makes with `balanced`, its scores, and the seconds of the processor that it took."""
    begun = time.process_time()
    snapshot = made()
    seconds = time.process_time() - begun
    run = Run("balanced", 0, None, {"total": seconds}, None)
    row = evaluate(snapshot, scene, split, run, rasterize=rasterize_on_cpu, networks=networks, settings=settings)
    return snapshot, row, seconds


def last(start: Start, config: ReconstructionConfig) -> Snapshot:
    """The scene of these cameras and points, as it is in the end."""
    *_, snapshot = continue_reconstruction(start, config)
    return snapshot


def measure(
    bench: str,
    description: str | None,
    sets: Sequence[str],
    form: str,
    rows: Callable[[EvaluationScene, Split, Sequence[str], PerceptualNetworks], Sequence[Any]],
    in_words: Callable[[Any], str],
) -> None:
    """Writes what `rows` finds, dataclasses, to the file of `--out` after each set, and says it.

    `sets` are measured where none are named. `form` is SCENE:VIEWS and what may follow, which `rows` gets as strings.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", default=sets, metavar=form, help=f"default: {' '.join(sets)}")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/ and weights/")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    networks = load_networks(args.shared / "weights").quickest
    command = shlex.join(["python", "-m", "tests.bench", bench, *sys.argv[1:]])
    found: list[Any] = []
    for each in args.sets:
        name, views, *rest = each.split(":")
        folder = args.shared / "scenes" / name
        scene = load_scene(folder)
        further = rows(scene, load_split(folder, list(scene.paths), int(views)), rest, networks)
        for row in further:
            say(in_words(row))
        found += further
        args.out.write_text(json.dumps({"command": command, "rows": [asdict(row) for row in found]}, indent=1) + "\n")
