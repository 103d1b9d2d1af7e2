"""A held-out view's pose may be sought from between its neighbours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.extras.evaluate.protocol import interpolate_pose


def camera(x: float, turn_deg: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(turn_deg), 0.0]))[0]
    T[0, 3] = x
    return T


ORDER = ("a", "b", "c", "d", "e", "f")
KNOWN = {"a": camera(0, 0), "e": camera(8, 40)}


def test_the_pose_lies_between_its_neighbours_by_its_place():
    assert interpolate_pose("b", ORDER, KNOWN) == pytest.approx(camera(2, 10))
    assert interpolate_pose("d", ORDER, KNOWN) == pytest.approx(camera(6, 30))


def test_beyond_the_last_it_is_the_last():
    assert interpolate_pose("f", ORDER, KNOWN) == pytest.approx(camera(8, 40))
    assert interpolate_pose("a", ORDER, {"c": camera(3, 5)}) == pytest.approx(camera(3, 5))


def test_without_cameras_there_is_no_start():
    with pytest.raises(ValueError, match="at least one of the 6 photographs"):
        interpolate_pose("b", ORDER, {})
