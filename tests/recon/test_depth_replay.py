"""A log with depth images gives a scene in metres: the built-in capture, and what a depth camera measures beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import splatnode
from splatnode import command_line
from splatnode.capture.cameras import synthetic
from splatnode.recon.result.snapshot import DepthCode
from tests.support import mcap_files
from tests.support.depth_camera import DepthCamera, measure
from tests.support.synthetic import photographs

PLACE = synthetic.Config(views=4, width=240, height=180)
QUICK: dict[str, Any] = {"size": 160, "optimize": {"iterations": 4}}
LATE_NS = 4_000_000  # a depth image after its photograph
OFFSET_M = 0.04  # by which the depth camera stands right of the colour camera
SHARE = 0.01


def write_log(file: Path, is_packed: bool, is_aligned: bool) -> Path:
    """Photographs and depth images of 2 Hz, each with a calibration; one that is not aligned has another lens."""
    depth_sensor = "color_optical" if is_aligned else "depth_optical"
    told = [mcap_files.ros_static(("link", "color_optical", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
                                  ("link", "depth_optical", (OFFSET_M, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))]  # fmt: skip
    for index, frame in enumerate(photographs(PLACE)):
        T, K = synthetic.scene_cameras(PLACE)[index]
        own_K, T_own = K.copy(), T.copy()
        if not is_aligned:
            own_K[0, 0] = own_K[1, 1] = 0.8 * K[0, 0]
            T_own[:3, 3] = T[:3, 3] + OFFSET_M * T[:3, 0]
        for topic, lens, sensor in (("/camera/color", K, "color_optical"), ("/camera/depth", own_K, depth_sensor)):
            pixels = lens - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
            size = (PLACE.width, PLACE.height)
            told.append(mcap_files.ros_lens(f"{topic}/camera_info", size, pixels.ravel().tolist(), sensor))
        ns = mcap_files.START_NS + index * 500_000_000
        told.append(mcap_files.ros_image("/camera/color/image_raw", frame.image, "rgb8", "color_optical", ns))
        z = measure(synthetic.depth_map(PLACE, (T_own, own_K)), DepthCamera(), index).values
        if is_packed:
            data, way = mcap_files.pack_depth(z), "16UC1; compressedDepth png"
            topic = "/camera/depth/image_raw/compressedDepth"
            told.append(mcap_files.ros_file(topic, data, way, depth_sensor, ns + LATE_NS))
        else:
            metres = (z / 1000).astype(np.float32)
            told.append(mcap_files.ros_image("/camera/depth/image_raw", metres, "32FC1", depth_sensor, ns + LATE_NS))
    return mcap_files.write(file, told)


def ratio(centres: np.ndarray) -> float:
    """How far the first and the last camera are apart, over what is true."""
    true = [T[:3, 3] for T, _ in synthetic.scene_cameras(PLACE)]
    return float(np.linalg.norm(centres[-1] - centres[0]) / np.linalg.norm(true[-1] - true[0]))


def test_packed_aligned_depth_gives_metres_and_replay_tells_of_it(tmp_path, caplog):
    config = tmp_path / "quick.yaml"
    config.write_text(json.dumps(QUICK))
    log = write_log(tmp_path / "drive.mcap", is_packed=True, is_aligned=True)
    caplog.set_level("INFO")
    assert command_line.main(["replay", str(log), "--out", str(tmp_path / "out"), "--config", str(config)]) == 0
    told = f'topic=/camera/depth/image_raw/compressedDepth images="{PLACE.views} of {PLACE.views}" later_ms=4.0'
    assert f"event=depth_images {told}" in caplog.text and "aligned, by its frame" in caplog.text
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [each["code"] for each in report["depth"]] == ["FITS"]
    cameras = json.loads((tmp_path / "out" / "cameras.json").read_text())
    assert cameras["scale"] == "metric"
    centres = [np.array(each["T_world_camera"])[:3, 3] for each in cameras["cameras"]]
    assert ratio(np.array(centres)) == pytest.approx(1.0, abs=SHARE)


def test_depth_of_a_camera_beside_gives_metres(tmp_path):
    log = write_log(tmp_path / "drive.mcap", is_packed=False, is_aligned=False)
    result = splatnode.reconstruct(log, config=QUICK)
    assert result.verdict.publishable and result.metric
    assert ratio(np.array([camera.centre for camera in result.cameras])) == pytest.approx(1.0, abs=SHARE)
    assert [check.code for check in result.depth_checks] == [DepthCode.FITS]
