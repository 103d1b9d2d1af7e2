"""Frame sets and rigs: which images were taken together, and what a rig refuses."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.rig import Rig, RigCamera, form_frame_sets


def at(ms: float, clock: Clock = Clock.UTC) -> Stamp:
    return Stamp(round(ms * 1e6), clock)


def test_images_within_the_tolerance_form_a_set_with_one_of_each_camera():
    frames = [
        (f"{camera}{k}", camera, at(100 * k + offset)) for k in range(3) for camera, offset in (("a", 0), ("b", 9))
    ]
    sets = form_frame_sets(frames, 0.01)
    assert [dict(each.names) for each in sets] == [{"a": f"a{k}", "b": f"b{k}"} for k in range(3)]
    assert [each.stamp for each in sets] == [at(0), at(100), at(200)]
    assert len(form_frame_sets(frames, 0.008)) == 6


def test_a_camera_is_once_in_a_set_and_clocks_do_not_mix():
    sets = form_frame_sets([("a0", "a", at(0)), ("a1", "a", at(1)), ("b1", "b", at(2)), ("c", "c", at(2, Clock.FILE))])
    assert [dict(each.names) for each in sets] == [{"c": "c"}, {"a": "a0"}, {"a": "a1", "b": "b1"}]


def test_a_frame_of_no_camera_is_in_no_set():
    assert not form_frame_sets([("a", "", at(0))])


def test_a_rig_names_what_is_wrong():
    camera = RigCamera("left", tuple(np.eye(4).ravel()))
    with pytest.raises(ValueError, match="its own camera id"):
        Rig((camera, camera))
    with pytest.raises(ValueError, match="two cameras or more"):
        Rig((camera,))
    with pytest.raises(ValueError, match="pose of left on its rig must be a rigid motion"):
        RigCamera("left", tuple(2 * np.eye(4).ravel()))
    with pytest.raises(ValueError, match="sigmas"):
        RigCamera("left", sigma_m=0)
    right = Rig((camera, RigCamera("right"))).find_camera("right")
    assert right is not None and right.matrix is None
