"""The programs that docs/messages.md shows: each prints the scene that a node publishes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.services import RECON_SCENE
from splatnode.capture.messaging.state import StateServer
from splatnode.capture.messaging.wire import Numbering
from splatnode.recon.result.message import to_message
from tests.conftest import ROOT
from tests.support.exported import make_snapshot

PROGRAMS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "messages.md").read_text(encoding="utf-8"), re.DOTALL)
WAIT_S = 30


@pytest.mark.parametrize("program", PROGRAMS, ids=["with splatnode", "without splatnode"])
def test_a_program_of_the_page_prints_the_scene(program, tmp_path):
    scene = make_snapshot()
    scene = replace(scene, images={camera.name: np.zeros((48, 64, 3), np.uint8) for camera in scene.cameras})
    numbers, output = Numbering(), tmp_path / "printed"
    command = [sys.executable, "-u", "-c", program.replace("/tmp/splatnode-1000", str(tmp_path))]
    environment = os.environ | {"RUNTIME_DIRECTORY": str(tmp_path), "PYTHONPATH": str(ROOT)}
    with (
        StateServer(RECON_SCENE, Network(directory=tmp_path)) as node,
        output.open("w") as printed,
        subprocess.Popen(command, env=environment, stdout=printed, stderr=printed) as listener,
    ):
        for _ in range(10 * WAIT_S):
            node.publish(*to_message(scene, "scene-0001", numbers.next()))
            node.serve(0.1)
            if listener.poll() is not None or scene.cameras[-1].name in output.read_text():
                break
        listener.kill()
    assert scene.verdict.code.value in output.read_text() and scene.cameras[-1].name in output.read_text()
