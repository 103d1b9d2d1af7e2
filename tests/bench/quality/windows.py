"""How often windows of consecutive photographs are answered rightly: `python -m tests.bench windows --out DIR`.

`splatnode robustness --windows`, with its options; without scenes on all of ../shared/scenes that have true cameras.
"""

from __future__ import annotations

import sys
from pathlib import Path

from splatnode.command_line import build_parser
from splatnode.command_line import main as splatnode
from splatnode.extras.evaluate.dataset import load_scene

SCENES = Path("../shared/scenes")


def main() -> None:
    command = ["robustness", "--windows", *sys.argv[1:]]
    if not build_parser().parse_args(command).scenes:
        command[2:2] = [str(folder) for folder in known_scenes(SCENES)]
    sys.exit(splatnode(command))


def known_scenes(folder: Path) -> list[Path]:
    """The scenes in `folder` that have true cameras."""
    return [scene for scene in sorted(folder.iterdir()) if scene.is_dir() and load_scene(scene).cameras]


if __name__ == "__main__":
    main()
