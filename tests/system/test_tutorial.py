"""Every command of docs/tutorial.md, one task after the other in one folder, as a newcomer types them.

The demo's photographs are small here, and with them those of the tasks after it: `.ci/run` makes the demo as it is.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

PATIENCE_S = 900.0
ENDS_ALL = "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT"  # also where a line in between fails
SMALL_DEMO = """
import sys
from functools import partial
from splatnode.__main__ import main
from splatnode.capture.cameras import synthetic
synthetic.Config = partial(synthetic.Config, width=320, height=240)
sys.exit(main())
"""
TASKS = re.findall(
    r"^## \d+\. ([^\n]+)\n.*?^```sh\n(.*?)^```$",
    (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"),
    re.DOTALL | re.MULTILINE,
)


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """An empty folder, and an environment in which `splatnode` and `python` are on the path."""
    folder = tmp_path_factory.mktemp("newcomer")
    programs, home = folder / "bin", folder / "home"
    programs.mkdir()
    home.mkdir(mode=0o700)
    (programs / "small_demo.py").write_text(SMALL_DEMO)
    small_demo = f'[ "$1" != demo ] || exec "{sys.executable}" "{programs}/small_demo.py" "$@"'
    for name, first, command in (("splatnode", small_demo, "-m splatnode"), ("python", "", "")):
        (programs / name).write_text(f'#!/bin/sh\n{first}\nexec "{sys.executable}" {command} "$@"\n')
        (programs / name).chmod(0o755)
    of_a_user = {"HOME": home, "XDG_RUNTIME_DIR": home, "XDG_STATE_HOME": home / "state", "PYTHONPATH": ROOT}
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    (folder / "work").mkdir()
    return folder / "work", os.environ | {"PATH": path} | {name: str(each) for name, each in of_a_user.items()}


def test_there_are_twenty():
    assert len(TASKS) == 20


@pytest.mark.parametrize("commands", [commands for _, commands in TASKS], ids=[name for name, _ in TASKS])
def test_the_commands_of_a_task_do_what_the_page_says(commands, newcomer):
    folder, environment = newcomer
    done = subprocess.run(
        ["bash", "-euc", f"{ENDS_ALL}\n{commands}"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, f"{commands}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    assert "Traceback" not in done.stderr


def test_what_the_tasks_leave(newcomer):
    folder, _ = newcomer
    scenes = ["demo", "scene", "three", "small", "metres", "two", "of_a_film", "live/scene-0001"]
    missing = [each for each in scenes if not (folder / each / "scene.ply").exists()]
    assert not missing
    assert not (folder / "refused" / "scene.ply").exists() and (folder / "seen.ply").exists()
    assert (folder / "scene" / "scene.spz").stat().st_size < (folder / "scene" / "scene.ply").stat().st_size / 3
    assert list((folder / "map").glob("map-scene-*/scene.ply")) or list((folder / "map").glob("scene-*/scene.ply"))
