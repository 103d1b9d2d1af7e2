"""What benches of real scenes share: their arguments, and a raw file that grows set by set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatnode.capture.process.progress import say
from splatnode.recon.evaluate.protocol import Networks, load_networks
from splatnode.recon.evaluate.splits import Split, load_split
from splatnode.recon.evaluate.truth import EvaluationScene, load_scene


def measure(
    bench: str,
    description: str | None,
    sets: Sequence[str],
    form: str,
    rows: Callable[[EvaluationScene, Split, Sequence[str], Networks], Sequence[Any]],
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
