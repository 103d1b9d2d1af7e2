"""Rendered images in the frame of reference that is asked for: of the base, upright, or refused."""

from __future__ import annotations

import numpy as np
import pytest

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.recon.result.verdict import Code, FrameName
from tests.api.conftest import SMALL

QUICK = {"optimize": {"iterations": 5}}
TRUE = [T for T, _ in synthetic.scene_cameras(SMALL)]
APART = float(np.linalg.norm(TRUE[3][:3, 3] - TRUE[0][:3, 3]))
UP = np.array([0.0, 0.0, 1.0])


def _mount() -> np.ndarray:
    """T_base_camera (4, 4) of the first camera on a base that stands level: x ahead of it, z up."""
    ahead = TRUE[0][:3, 2] - (TRUE[0][:3, 2] @ UP) * UP
    x = ahead / np.linalg.norm(ahead)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(UP, x), UP]) @ TRUE[0][:3, :3]
    T[:3, 3] = 0.3, 0.1, 1.2
    return T


MOUNT = _mount()


def test_images_of_a_camera_on_a_base_and_what_is_written_of_them(arrays, tmp_path):
    made = splatnode.reconstruct(arrays, config=QUICK, frame="base", T_base_camera=MOUNT, scale=(0, 3, APART))
    assert made.metric and made.frame.name is FrameName.BASE
    for camera, T in zip(made.cameras, TRUE, strict=True):
        expected = MOUNT @ np.linalg.inv(TRUE[0]) @ T  # in the base's frame at the first image
        np.testing.assert_allclose(camera.T_world_camera[:3, :3], expected[:3, :3], atol=0.01)
        np.testing.assert_allclose(camera.centre, expected[:3, 3], atol=0.02 * APART)
    again = splatnode.load(made.save(tmp_path / "out"))
    assert again.frame == made.frame and again.metric
    np.testing.assert_allclose(again.cameras[2].T_world_camera, made.cameras[2].T_world_camera, atol=1e-12)
    np.testing.assert_allclose(again.frame.matrix, MOUNT, atol=1e-12)
    found = again.map()
    assert found.upright.is_of_result and found.save(tmp_path / "nav", band=(found.origin[2] + 0.3, 0.9))
    located = again.localise(arrays[1])
    assert isinstance(located, splatnode.Located)
    np.testing.assert_allclose(located.T_world_camera, made.cameras[1].T_world_camera, atol=0.02 * APART)


def test_gravity_by_image_makes_a_scene_upright(arrays):
    downs = {f"{index:04d}.png": -T[:3, :3].T @ UP for index, T in enumerate(TRUE)}
    made = splatnode.reconstruct(arrays, config=QUICK, frame="upright", gravity=downs)
    assert made.frame.name is FrameName.UPRIGHT and not made.metric
    up_in_camera = made.cameras[0].T_world_camera[:3, :3].T @ UP
    assert np.degrees(np.arccos(min(1.0, up_in_camera @ (TRUE[0][:3, :3].T @ UP)))) < 0.5
    climbs = (TRUE[3] - TRUE[0])[2, 3] / APART
    moved = made.cameras[3].centre - made.cameras[0].centre
    assert moved[2] / np.linalg.norm(moved) == pytest.approx(climbs, abs=0.02)


def test_a_session_is_refused_until_its_frame_is_known(arrays):
    with splatnode.Session(config=QUICK, every_frame=True, frame="base", T_base_camera={"": MOUNT}) as session:
        session.add(arrays[0])
        relative = session.add(arrays[1]).result
        assert relative.verdict.code is Code.FRAME_UNKNOWN and "no metres" in relative.verdict.message
        known = session.add(arrays[2], motion=np.linalg.inv(TRUE[1]) @ TRUE[2]).result
    assert known.frame.name is FrameName.BASE
    np.testing.assert_allclose(known.cameras[0].T_world_camera, MOUNT, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"frame": "base"}, ValueError, "no image tells where its camera stands"),
        ({"frame": "odometry"}, ValueError, "no image has a pose or a motion"),
        ({"frame": "earth"}, ValueError, "frame"),
        ({"T_base_camera": np.eye(3)}, TypeError, r"T_base_camera must be \(4, 4\)"),
        ({"T_base_camera": np.diag([1, 1, -1, 1])}, ValueError, "T_base_camera must be a rigid motion"),
        ({"T_base_camera": {"left": MOUNT}}, ValueError, "unknown: 'left'"),
        ({"gravity": {"x.png": (0, 1, 0)}}, ValueError, "unknown: 'x.png'"),
        ({"gravity": (0, 0)}, TypeError, r"direction \(3,\)"),
    ],
)
def test_what_cannot_be_used_is_told_before_the_work(arrays, arguments, error, said):
    with pytest.raises(error, match=said):
        splatnode.reconstruct(arrays, config=QUICK, **arguments)
