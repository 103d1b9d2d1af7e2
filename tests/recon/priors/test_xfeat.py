"""XFeat and LighterGlue with their real weights."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from tests.support.synthetic import SMALL, photographs

onnxruntime = pytest.importorskip("onnxruntime", reason="learned features need onnxruntime")

from splatnode.recon.priors.xfeat import Keypoints, Xfeat, load_network  # noqa: E402  only where onnxruntime is


@pytest.fixture(scope="module")
def network(request) -> Xfeat:
    folder = request.getfixturevalue("shared") / "weights" / "xfeat"
    return load_network(folder / "xfeat_640x640.onnx", folder / "lighterglue_L3.onnx", threads=1)


def epipolar_distance(first: np.ndarray, second: np.ndarray, index1: int, index2: int) -> np.ndarray:
    """(M,) pixels between points of the second photograph and the true epipolar lines of those of the first."""
    (T1, K1), (T2, K2) = (synthetic.scene_cameras(SMALL)[index] for index in (index1, index2))
    motion = np.linalg.inv(T2) @ T1
    cross = np.cross(np.eye(3), motion[:3, 3]).T
    lines = np.c_[first, np.ones(len(first))] @ (np.linalg.inv(K2).T @ cross @ motion[:3, :3] @ np.linalg.inv(K1)).T
    return np.abs((np.c_[second, np.ones(len(second))] * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])


def test_matches_lie_on_the_true_epipolar_lines(network):
    frames = photographs()
    keypoints = [network.extract(frames[index].image, 1000) for index in (0, 1)]
    for found in keypoints:
        assert len(found.points) > 150
        assert (found.points >= 0).all() and (found.points <= [SMALL.width, SMALL.height]).all()
        np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-4)
    size = (SMALL.width, SMALL.height)
    matches = network.match(keypoints[0], size, keypoints[1], size)
    assert len(matches) > 60
    assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))
    distance = epipolar_distance(keypoints[0].points[matches[:, 0]], keypoints[1].points[matches[:, 1]], 0, 1)
    assert np.mean(distance < 2.0) > 0.55  # candidates: the epipolar test is still to come


def test_a_shifted_image_gives_shifted_keypoints(network):
    """Positions are pixel positions: what moves by eight pixels is found eight pixels further."""
    image = photographs()[0].image
    first, second = network.extract(image[:, :-8], 300), network.extract(image[:, 8:], 300)
    size = (SMALL.width - 8, SMALL.height)
    matches = network.match(first, size, second, size)
    step = first.points[matches[:, 0]] - second.points[matches[:, 1]]
    np.testing.assert_allclose(np.median(step, 0), [8.0, 0.0], atol=0.3)


def test_nothing_to_see_gives_no_matches(network):
    size = (64, 48)
    plain = network.extract(np.full((48, 64, 3), 128, np.uint8), 100)
    nothing = Keypoints(np.zeros((0, 2)), np.zeros((0, 64), np.float32))
    assert len(plain.points) < 20
    assert network.match(nothing, size, plain, size).shape == (0, 2)


def test_damaged_and_foreign_files_are_named(shared, tmp_path):
    (tmp_path / "broken.onnx").write_bytes(b"no network")
    folder = shared / "weights" / "xfeat"
    with pytest.raises(ValueError, match="damaged or not an ONNX file"):
        load_network(tmp_path / "broken.onnx", folder / "lighterglue_L3.onnx")
    with pytest.raises(ValueError, match="another network"):
        load_network(folder / "lighterglue_L3.onnx", folder / "lighterglue_L3.onnx")
