"""Files of rigs: each format gives the same rig, and what is none is refused with what is missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.rig import UnusableRig, format_rig, read_rig

T = np.array([[0.0, 0.0, 1.0, 0.2], [0.0, 1.0, 0.0, -0.1], [-1.0, 0.0, 0.0, 0.05], [0.0, 0.0, 0.0, 1.0]])
LENS = {
    "camera_model": "pinhole", "distortion_model": "radtan", "resolution": [640, 480],
    "intrinsics": [400, 400, 320, 240], "distortion_coeffs": [0, 0, 0, 0],
}  # fmt: skip


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(format_rig([("front", np.eye(4), 0.0, 0.0), ("left", T, 0.002, 0.03)], metric=True))
    rig = read_rig(file)
    left = rig.find_camera("left")
    assert left is not None and left.matrix is not None
    np.testing.assert_allclose(left.matrix, T, atol=1e-8)
    assert (left.sigma_m, left.sigma_deg) == (0.002, 0.03)


def test_a_rig_without_metres_is_not_taken_for_metres(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(format_rig([("front", np.eye(4), 0.1, 0.1), ("left", T, 0.1, 0.1)], metric=False))
    with pytest.raises(UnusableRig, match="no metres"):
        read_rig(file)


def test_colmap_and_kalibr_have_the_pose_of_the_rig_in_the_camera(tmp_path: Path) -> None:
    inverse = np.linalg.inv(T)
    quaternion = [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]
    left = {
        "image_prefix": "rig/left/", "cam_from_rig_rotation": quaternion,
        "cam_from_rig_translation": inverse[:3, 3].tolist(),
    }  # fmt: skip
    colmap = tmp_path / "rig_config.json"
    colmap.write_text(json.dumps([{"cameras": [{"image_prefix": "rig/front/", "ref_sensor": True}, left]}]))
    kalibr = tmp_path / "camchain.yaml"
    kalibr.write_text(json.dumps({"cam0": LENS, "cam1": {**LENS, "T_cn_cnm1": inverse.tolist()}}))
    for file, name in ((colmap, "left"), (kalibr, "cam1")):
        camera = read_rig(file).find_camera(name)
        assert camera is not None and camera.matrix is not None
        np.testing.assert_allclose(camera.matrix, T, atol=1e-9)
    lens = read_rig(kalibr).cameras[0].intrinsics
    assert lens is not None and lens.cx == 320.5


@pytest.mark.parametrize(
    "text",
    ["a: 1", "[]", "cameras: {a: {}}", '[{"cameras": [{}]}]', "cam0: {}", "cameras: {a: {T_rig_camera: [[1]]}, b: {}}"],
)
def test_what_is_no_rig_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match="rig.yaml"):
        read_rig(file)


GOOD = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
FRONT = '{"image_prefix": "front", "ref_sensor": true}'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"cameras: {{a: {{T_rig_camera: {GOOD}}}, left: {{T_rig_camera: 3}}}}", "camera 'left': Expected array"),
        (f"cameras: {{a: {{T_rig_camera: {GOOD}}}, left: {{T_rig: {GOOD}}}}}", "camera 'left': .*unknown field T_rig"),
        (f"cameras: {{a: {{T_rig_camera: {GOOD}}}, left: {{T_rig_camera: [[1]]}}}}", "camera 'left': the pose of left"),
        (
            f"cameras: {{a: {{T_rig_camera: {GOOD}}}, left: {{sigma_m: -1}}}}",
            "camera 'left': the sigmas of left on its",
        ),
        (f"cameras: {{a: {{T_rig_camera: {GOOD}}}, left: [1]}}", "camera 'left': Expected object"),
        ("cameras: [a, b]", "cameras must be a mapping of camera ids"),
        (f'[{{"cameras": [{FRONT}, {{"image_prefix": "left", "cam_from_rig_rotation": [1]}}]}}]', "camera 'left': not"),
        (f'[{{"cameras": [{FRONT}, {{"cam_from_rig_rotation": [1]}}]}}]', "camera '1': it has no 'image_prefix'. Each"),
        (f'[{{"cameras": [{FRONT}, {{"image_prefix": "b", "cam_from_rig_rotation": [0, 0, 0, 0]}}]}}]', "camera 'b': "),
        ('[{"cameras": 3}]', "one rig with `cameras`, a list"),
    ],
)
def test_an_error_in_a_rig_names_the_camera(tmp_path: Path, text: str, told: str) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    with pytest.raises(UnusableRig, match=told) as raised:
        read_rig(file)
    assert str(raised.value).count("rig.yaml") == 1 and "`$" not in str(raised.value)


def test_an_error_in_a_camchain_names_the_camera(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    for second, told in (
        ({**LENS}, "camera 'cam1': it has no 'T_cn_cnm1'"),
        ({**LENS, "T_cn_cnm1": [[1]]}, "'cam1': "),
    ):
        file.write_text(json.dumps({"cam0": LENS, "cam1": second}))
        with pytest.raises(UnusableRig, match=told):
            read_rig(file)
    file.write_text(json.dumps({"cam0": {**LENS, "resolution": 3}, "cam1": LENS}))
    with pytest.raises(UnusableRig) as raised:
        read_rig(file)
    assert str(raised.value).count("camchain.yaml") == 1 and "UnusableLens" not in str(raised.value)


def test_a_rig_that_is_no_yaml_is_named_once_on_one_line(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text("cameras: {a: [\nb: }")
    with pytest.raises(UnusableRig, match="rig.yaml is not YAML: .*it must give a rig") as raised:
        read_rig(file)
    said = str(raised.value)
    assert said.count(str(file)) == 1 and "ConfigError" not in said and "\n" not in said and "\\n" not in said
