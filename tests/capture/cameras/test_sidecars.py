"""A watched folder whose images have a file beside them: what it tells goes with the image, or drops it."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from splatnode.capture.frame import Clock, DroppedFrame, ExposureSettings, Frame, Stamp
from tests.capture.cameras.test_watched import photograph, watch

POSE = [0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0]
TOLD = {
    "captured_at": {"ns": 1_700_000_000_000_000_000, "clock": "utc"},
    "camera_id": "left",
    "intrinsics": {"width": 128, "height": 96, "fx": 100, "fy": 100, "cx": 64, "cy": 48, "source": "calibration"},
    "given_pose": {"T_world_camera": POSE, "sigma_m": 0.001, "sigma_deg": 0.1},
    "motion": {"chain": "wheels", "T_start_current": POSE, "sigma_m": 0.1, "sigma_deg": 3.0},
    "gravity": {"down": [0, 1, 0]},
    "exposure": {"time_s": 0.01, "iso": 200},
    "T_base_camera": POSE,
}


def write(folder, told, name="a"):
    """The sidecar file, then the image, each under another name first: so neither is ever seen half written."""
    text = told if isinstance(told, str) else json.dumps(told)
    for suffix, data in ((".json", text.encode()), (".jpg", photograph())):
        (folder / f"{name}{suffix}.tmp").write_bytes(data)
        (folder / f"{name}{suffix}.tmp").rename(folder / f"{name}{suffix}")


def test_what_the_file_tells_goes_with_the_image(tmp_path):
    write(tmp_path, TOLD)
    frame = next(watch(tmp_path, sidecars=True, camera_id="right"))
    assert frame.captured_at == Stamp(1_700_000_000_000_000_000, Clock.UTC) and frame.camera_id == "left"
    assert (frame.intrinsics.fx, frame.intrinsics.width) == (50, 64)
    assert frame.given_pose.T_world_camera == tuple(POSE) and frame.given_pose.sigma_m == 0.001
    assert (frame.motion.chain, frame.gravity.down) == ("wheels", (0, 1, 0))
    assert frame.T_base_camera == tuple(POSE)
    assert frame.exposure == ExposureSettings(0.01, 200) and frame.image.shape == (48, 64, 3)


def test_what_it_does_not_tell_is_as_without_it(tmp_path):
    write(tmp_path, {})
    frame = next(watch(tmp_path, sidecars=True, camera_id="right"))
    assert frame.camera_id == "right" and frame.given_pose is None and frame.captured_at.clock is Clock.FILE


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ("{", "a.json cannot be used: Input data was truncated"),
        ({"pose": POSE}, r"a.json cannot be used: .*unknown field `pose`"),
        ({"given_pose": {"T_world_camera": POSE[:12]}}, "length >= 16"),
        ({"given_pose": {"T_world_camera": [2.0, *POSE[1:]]}}, "a rigid motion"),
        ({"gravity": {"down": [0, 0, 0]}}, "not zero"),
        ({"T_base_camera": [2.0, *POSE[1:]]}, "T_base_camera must be a rigid motion"),
        ({"intrinsics": TOLD["intrinsics"] | {"width": 96}}, "aspect ratio"),
        ({"captured_at": {"ns": -1, "clock": "utc"}}, "a.json cannot be used"),
        (" " * 70_000, "at most 65536"),
    ],
)
def test_a_bad_one_drops_its_image_with_the_reason_and_the_next_goes_on(tmp_path, told, why):
    write(tmp_path, told)
    write(tmp_path, TOLD, "b")
    watching = watch(tmp_path, sidecars=True)
    dropped, taken = next(watching), next(watching)
    assert isinstance(dropped, DroppedFrame) and dropped.name == "a.jpg"
    with pytest.raises(ValueError, match=why):
        raise ValueError(dropped.reason)
    assert isinstance(taken, Frame) and taken.name == "b.jpg"


def test_an_image_waits_for_its_file_and_is_dropped_where_none_comes(tmp_path):
    (tmp_path / "a.jpg").write_bytes(photograph())
    late = threading.Timer(0.2, lambda: (tmp_path / "a.json").write_text(json.dumps(TOLD)))
    late.start()
    watching = watch(tmp_path, sidecars=True, file_timeout_s=5.0)
    assert next(watching).camera_id == "left"
    late.join()
    (tmp_path / "b.jpg").write_bytes(photograph(1))
    (tmp_path / "a.jpg").unlink()
    dropped = next(watch(tmp_path, sidecars=True, file_timeout_s=0.3))
    assert isinstance(dropped, DroppedFrame) and "b.json is not there" in dropped.reason


def test_without_the_option_files_beside_images_are_left_alone(tmp_path):
    write(tmp_path, "no JSON")
    frame = next(watch(tmp_path))
    assert isinstance(frame, Frame) and np.array_equal(frame.image.shape, (48, 64, 3))
