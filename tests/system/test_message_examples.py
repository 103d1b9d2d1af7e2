"""The programs that docs/messages.md shows: each prints the scene, or the map, that a node publishes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_MAP, RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.recon.occupancy import encode_map as map_message
from splatnode.recon.result.message import encode_snapshot
from tests.capture.messaging.test_sockets import wait_for
from tests.conftest import ROOT
from tests.support.exported import make_snapshot
from tests.support.occupied import small_map

PROGRAMS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "messages.md").read_text(encoding="utf-8"), re.DOTALL)
WAIT_S = 30


@pytest.mark.parametrize("program", PROGRAMS[:2], ids=["with splatnode", "without splatnode"])
def test_a_program_of_the_page_prints_the_scene(program, tmp_path):
    scene = make_snapshot()
    scene = replace(scene, images={camera.name: np.zeros((48, 64, 3), np.uint8) for camera in scene.cameras})
    numbers = Numbering()
    with StateServer(RECON_SCENE, Network(directory=tmp_path)) as node:
        printed = printed_by(
            program,
            node,
            lambda: encode_snapshot(scene, "scene-0001", numbers.next()),
            scene.cameras[-1].name,
            tmp_path,
        )
    assert scene.verdict.code.value in printed and scene.cameras[-1].name in printed


def test_the_program_for_maps_prints_the_map(tmp_path):
    made, numbers = small_map(np.array([[[0, 1, 1, 2]]])), Numbering()
    with StateServer(RECON_MAP, Network(directory=tmp_path)) as node:
        said = printed_by(
            PROGRAMS[3], node, lambda: map_message(made, "scene-0001", 0, numbers.next()), "occupied", tmp_path
        )
    assert "scene-0001 {'not_seen': 0.25, 'free': 0.5, 'occupied': 0.25}" in said


def test_the_sender_without_splatnode_gets_its_images_to_recon(tmp_path):
    """It knows no module of ours; recon dies once meanwhile, and refuses one image."""
    (tmp_path / "run").mkdir(mode=0o700)
    program = PROGRAMS[2].replace("/tmp/splatnode-1000", str(tmp_path / "run"))
    assert "splatnode" not in program
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as sender:
        try:
            with KeyframeClient(Network(directory=tmp_path / "run")) as recon:
                first = wait_for(lambda: recon.receive(0.1), 20.0)
            with KeyframeClient(Network(directory=tmp_path / "run"), recon=uuid.uuid4().hex) as recon:
                came = []
                while len(came) < 3:
                    came.append(wait_for(lambda: recon.receive(0.1), 20.0))
                    if len(came) < 3:
                        recon.acknowledge(came[-1])
                recon.refuse(came[2].key, "for the test")
                wait_for(lambda: recon.receive(0.1) or sender.poll() is not None, 20.0)
            output, _ = sender.communicate(timeout=20)
        finally:
            sender.kill()
    assert [each.frame.name for each in came] == ["image_0", "image_1", "image_2"] and first.frame.name == "image_0"
    assert came[0].frame.camera_id == "wrist" and came[0].frame.image.shape == (48, 64, 3)
    assert output == "acknowledge 0 \nacknowledge 1 \nrefuse 2 for the test\n"


def printed_by(program: str, node: StateServer, message: Callable[[], tuple], until: str, folder: Path) -> str:
    """What the program has printed when `until` is in it, or time is up; the message is published again and again."""
    output = folder / "printed"
    command = [sys.executable, "-u", "-c", program.replace("/tmp/splatnode-1000", str(folder))]
    environment = os.environ | {"RUNTIME_DIRECTORY": str(folder), "PYTHONPATH": str(ROOT)}
    with (
        output.open("w") as printed,
        subprocess.Popen(command, env=environment, stdout=printed, stderr=printed) as listener,
    ):
        for _ in range(10 * WAIT_S):
            node.publish(*message())
            node.serve(0.1)
            if listener.poll() is not None or until in output.read_text():
                break
        listener.kill()
    return output.read_text()
