"""Every program of docs/python.md, one after the other in one folder, as somebody who reads the page runs them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import decode_image, encode_png
from tests.conftest import ROOT
from tests.support.exported import make_camera, make_snapshot
from tests.support.pretend_node import PretendNode

PLACE = synthetic.Config(views=4, width=320, height=240)
FILMED = 10  # frames along the same way
PATIENCE_S = 600.0
PROGRAMS = dict(
    re.findall(
        r"^## ([^\n]+)\n.*?^```python\n(.*?)^```$",
        (ROOT / "docs" / "python.md").read_text(encoding="utf-8"),
        re.DOTALL | re.MULTILINE,
    )
)
# What a program prints, by its title; each title of the page has its row.
PRINTED = {
    "Photos in, cameras and a scene out": r"All 4 photographs were placed\..*\nview_000\.png \[.*\n(view_.*\n){3}",
    "The result": r"(?s)\[\[.*\(\d+, 3\) float32 0\.\d+\n\[\] \d",
    "Metres, and a known lens": r"True 295\.15\n",
    "Render a new view": r"[1-9][\d.]* \d\d% of it two photographs have seen\n",
    "Localize a query image": r"(?s)\[.*\] 0\.\d+ 0\.\d+\nrefused: NOT_FOUND: .*\n",
    "Localize a moving camera": r"(placed at .*\n){10}",
    "A rejection is a value": r"TOO_FEW_VIEWS 1 usable photograph: .*\n0 0\n",
    "A camera loop": r"(?s)0000\.png first view.* OK 3\n.*All \d photographs were placed\. .* True\n",
    "Listen to a node": r"(?s)kitchen OK 2\nthe live camera: .*\nfree space: the node has said nothing of a map",
    "Send images to a node": r"(?s)wrist_\d+\.\d+ keyframe first view.*\d+ wait .* answered: False\n",
    "Threads and progress": r"<splatnode.Result OK: 4 .* <splatnode.Result OK: 4 .*\n.* \.\.\. .*\n",
    "Save and load": r"(<splatnode.Result OK: 4 cameras, \d+ Gaussians, 0 left out> ?){2}\n",
    "Into other tools": r"(?s)\['images/view_000\.png', .*PINHOLE 320 240",
}


@pytest.fixture(scope="module")
def reader(tmp_path_factory) -> Path:
    """A folder with `photos` and `film.mp4`, and the sockets of a node beside."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "photos").mkdir()
    for index, frame in enumerate(synthetic.stream(PLACE)):
        (folder / "photos" / f"view_{index:03d}.png").write_bytes(encode_png(frame.image))
    further = {"further": (PLACE, 1.5), "elsewhere": (msgspec.structs.replace(PLACE, seed=1), 1.0)}
    for name, (place, position) in further.items():
        image = synthetic.render_image(place, synthetic._camera_on_path(place, position), 9)
        (folder / f"{name}.png").write_bytes(encode_png(image))
    film = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 8, (PLACE.width, PLACE.height))
    for position in np.linspace(0, PLACE.views - 1, FILMED):
        image = synthetic.render_image(PLACE, synthetic._camera_on_path(PLACE, float(position)), 0)
        film.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    film.release()
    (folder / "run").mkdir(mode=0o700)
    return folder


@pytest.fixture
def node(reader) -> Iterator[PretendNode]:
    pretended = PretendNode(reader / "run")
    pretended.tracked = make_camera(7)
    scene = make_snapshot()
    images = {camera.name: np.zeros((48, 64, 3), np.uint8) for camera in scene.cameras}
    pretended.publish(replace(scene, images=images), "kitchen")
    yield pretended
    pretended.close()


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "RUNTIME_DIRECTORY": str(folder / "run")}
    environment |= {"STATE_DIRECTORY": str(folder / "state")}
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)


def test_each_program_is_tried():
    assert list(PROGRAMS) == list(PRINTED)


@pytest.mark.parametrize("title", PROGRAMS)
def test_a_program_prints_what_the_page_says(title, reader, node):
    done = run(PROGRAMS[title], reader)
    assert done.returncode == 0 and done.stderr == "", (
        f"{PROGRAMS[title]}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    )
    assert re.match(PRINTED[title], done.stdout), done.stdout


def test_what_the_programs_leave(reader):
    view = decode_image((reader / "view.png").read_bytes()).image
    assert view.shape == (240, 320, 3) and view.std() > 20
    assert (reader / "out" / "scene.ply").is_file() and (reader / "out" / "colmap" / "images.txt").is_file()
