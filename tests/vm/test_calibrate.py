"""`splatnode calibrate` on a real driver (vivid), in a virtual machine: a board is shown to the camera."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import read_lens
from splatnode.extras.calibration.board import Board
from tests.support.board_photographs import Conditions, Photographer, waved
from tests.vm.machine import VIVID_LOOP, Kernel, find_kernel, run

LENS = Intrinsics(720, 576, 660.0, 660.0, 364.0, 285.0, "given")


@pytest.mark.vivid
def test_a_board_before_a_real_camera_driver_gives_its_lens(tmp_path):
    if not os.environ.get("SPLATNODE_SLOW"):
        pytest.skip("takes five minutes of two processors, which the machine is made of: set SPLATNODE_SLOW=1")
    kernel = find_kernel()
    if not isinstance(kernel, Kernel):
        pytest.skip(f"needs a virtual machine: {kernel}")
    photographer = Photographer(Board(), LENS, Conditions(noise=1.0))
    for number, T in enumerate(waved(Board(), LENS, 16, 1)):
        (tmp_path / f"{number:02d}.yuyv").write_bytes(yuyv(photographer.photograph(T, number)))
    script = Path(__file__).with_name("guest_calibrate.py")
    outcome = run(kernel, script, tmp_path, timeout_s=500, vivid_options=VIVID_LOOP)
    assert outcome.code == 0, outcome.output
    lens = read_lens(tmp_path / "lens.yaml")
    assert (lens.width, lens.height) == (720, 576)
    assert abs(lens.fx / LENS.fx - 1) < 0.005 and abs(lens.cx - LENS.cx) < 2.0


def yuyv(image: np.ndarray) -> bytes:
    """A grey picture (H, W, 3) as the driver takes it."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    packed = np.full((*grey.shape, 2), 128, np.uint8)
    packed[..., 0] = np.round(16 + grey * 219 / 255)
    return packed.tobytes()
