"""Memory that was freed comes back without the kernel."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from splatnode.capture.process.system import is_shortage
from tests.conftest import ROOT

FAULTS = """
import resource, sys
import numpy as np
from splatnode.capture.process.system import keep_freed
if sys.argv[1] == "kept":
    keep_freed()
def frame():
    pixels = [np.ones((720, 1280, 3), np.uint8) for _ in range(3)]  # as many as are alive at once
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
frame()
before = faults()
for _ in range(20):
    frame()
print((faults() - before) / 20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="page faults are counted as Linux does")
def test_frames_of_720p_cost_no_page_faults():
    per_frame = {
        kept: float(subprocess.check_output([sys.executable, "-c", FAULTS, kept], cwd=ROOT, text=True))
        for kept in ("kept", "given back")
    }
    assert per_frame["kept"] < 20 < per_frame["given back"]


@pytest.mark.parametrize(
    "greedy",
    [
        lambda: bytes(1 << 62),
        lambda: np.zeros(1 << 59),
        lambda: torch.zeros(1 << 45),
        lambda: cv2.resize(np.zeros((9, 9), np.uint8), ((1 << 30), (1 << 15))),
    ],
)
def test_no_memory_is_told_from_other_errors_whoever_asked_for_it(greedy):
    with pytest.raises(Exception) as caught:
        greedy()
    assert is_shortage(caught.value), caught.value
    assert not is_shortage(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))
