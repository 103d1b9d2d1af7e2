"""How two scenes lie to each other: exact where they agree, and told where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.recon.daemon.atlas.links import MIN_SHARED, link
from splatnode.recon.geometry import Similarity
from tests.support.synthetic import SMALL

TURNED = Similarity(2.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))


@pytest.fixture
def cameras():
    return {f"{i}.png": T_world_camera for i, (T_world_camera, _) in enumerate(synthetic.scene_cameras(SMALL))}


def test_a_link_carries_one_scene_onto_the_other(cameras):
    moved = {name: TURNED.inverse().camera(T) for name, T in list(cameras.items())[2:]}
    found = link("one", "two", cameras, moved)
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
    found = link("one", "two", cameras, other)
    assert found is not None and found.centre_percent is not None and found.centre_percent > 5


def test_too_few_shared_cameras_link_nothing(cameras):
    assert link("one", "two", cameras, dict(list(cameras.items())[: MIN_SHARED - 1])) is None
