"""The V4L2 camera on a real driver (vivid), in a virtual machine: streaming, locks, a second reader, unplugging."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.vm.machine import Kernel, find_kernel, run


@pytest.mark.vivid
def test_a_real_camera_driver(tmp_path):
    kernel = find_kernel()
    if not isinstance(kernel, Kernel):
        pytest.skip(f"needs a virtual machine: {kernel}")
    outcome = run(kernel, Path(__file__).with_name("guest_v4l2.py"), tmp_path)
    assert outcome.code == 0, outcome.output
    result = json.loads((tmp_path / "result.json").read_text())

    (camera,) = result["found"]
    assert camera["device"].startswith("/dev/") and "vivid" in camera["description"] and "YUYV" in camera["description"]
    frames = result["frames"]
    assert all(frame["shape"] == [480, 640, 3] and frame["spread"] > 20 for frame in frames)
    stamps = np.array([frame["stamp_ns"] for frame in frames])
    assert (np.diff(stamps) > 0).all() and all(0 < frame["age_s"] < 2 for frame in frames)
    assert len({frame["name"] for frame in frames}) == len(frames)

    assert "used by another program" in result["busy"]
    assert result["held"]["gain"] is True and result["gain_is_automatic"] == 0
    assert result["unplugged"]["control"] == "Disconnect"
    assert "was unplugged" in result["unplugged"]["error"] and result["unplugged"]["seconds"] < 1

    (lost, back), ids = result["replugged"]["states"], result["replugged"]["ids"]
    assert lost[0] == "degraded" and "unplugged" in lost[1]
    assert back == ["streaming", ""] and ids[1] > ids[0]
