"""How two scenes lie to each other: exact where they agree, and told where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.recon.daemon.pose_graph import MIN_SHARED, make_chain_edge, transfer_edge
from splatnode.recon.geometry import Similarity
from tests.support.synthetic import SMALL

TURNED = Similarity(2.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))


@pytest.fixture
def cameras():
    return {f"{i}.png": T_world_camera for i, (T_world_camera, _) in enumerate(synthetic.scene_cameras(SMALL))}


def test_a_link_carries_one_scene_onto_the_other(cameras):
    moved = {name: TURNED.inverse().camera(T) for name, T in list(cameras.items())[2:]}
    found = make_chain_edge("one", "two", cameras, moved)
    assert found is not None and found.shared == tuple(list(cameras)[2:])
    np.testing.assert_allclose(found.scale, 2.5)
    np.testing.assert_allclose(np.array(found.rotation), TURNED.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, TURNED.translation, atol=1e-9)
    assert found.rotation_deg < 1e-5 and found.centre_percent is not None and found.centre_percent < 1e-5


def test_what_the_shared_cameras_do_not_agree_on_is_told(cameras):
    other = dict(cameras)
    name = next(iter(other))
    other[name] = other[name].copy()
    other[name][:3, 3] += 0.3
    found = make_chain_edge("one", "two", cameras, other)
    assert found is not None and found.centre_percent is not None and found.centre_percent > 5


def test_too_few_shared_cameras_link_nothing(cameras):
    assert make_chain_edge("one", "two", cameras, dict(list(cameras.items())[: MIN_SHARED - 1])) is None


@pytest.mark.parametrize("again", ["one", "two"])
def test_a_link_holds_after_one_of_its_scenes_was_made_again_in_another_world(cameras, again):
    moved = {name: TURNED.inverse().camera(T) for name, T in cameras.items()}
    worlds = {"one": cameras, "two": moved}
    made = {name: TURNED.camera(T) for name, T in worlds[again].items()}
    before = make_chain_edge("one", "two", cameras, moved)
    assert before is not None
    found = transfer_edge(before, again, worlds[again], made)
    expected = make_chain_edge("one", "two", *(worlds | {again: made}).values())
    assert found is not None and expected is not None
    for field in ("scale", "rotation", "translation", "centre", "sigma_deg", "sigma_scale", "sigma_position"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-9)


def test_a_link_does_not_hold_where_the_cameras_of_a_scene_lie_otherwise_now(cameras):
    before = make_chain_edge("one", "two", cameras, cameras)
    assert before is not None
    other = dict(cameras)
    name = next(iter(other))
    other[name] = other[name].copy()
    other[name][:3, 3] += 2.0
    assert transfer_edge(before, "one", cameras, other) is None
    assert transfer_edge(before, "one", cameras, {"another.png": np.eye(4)}) is None
