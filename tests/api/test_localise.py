"""Where a further photograph was taken, from Python: of a result at hand or saved; refusals; bad input."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from tests.api.conftest import QUICK, SMALL


@pytest.fixture(scope="module")
def between() -> np.ndarray:
    """A photograph from where none of the set was taken."""
    return synthetic.render_image(SMALL, synthetic._camera_on_path(SMALL, 1.5), 9)


def test_it_is_placed_between_its_neighbours(result, between):
    found = result.localise(between)
    assert isinstance(found, splatnode.Located), found
    before, after = (camera.centre for camera in result.cameras[1:3])
    middle, apart = (before + after) / 2, np.linalg.norm(after - before)
    assert np.linalg.norm(found.T_world_camera[:3, 3] - middle) < 0.3 * apart
    assert 0 < found.claim.rotation_deg < 5 and found.K.shape == (3, 3) and found.covariance.shape == (6, 6)
    assert np.array_equal(pickle.loads(pickle.dumps(found)).K, found.K)


def test_a_saved_result_and_a_file_say_the_same(result, between, tmp_path):
    (tmp_path / "further.png").write_bytes(encode_png(between))
    saved = splatnode.load(result.save(tmp_path / "out"))
    found, again = result.localise(between), saved.localise(tmp_path / "further.png")
    assert isinstance(found, splatnode.Located) and isinstance(again, splatnode.Located)
    assert np.allclose(found.T_world_camera, again.T_world_camera, atol=1e-3)


def test_a_known_lens_is_taken(result, between):
    K = result.cameras[0].K
    found = result.localise(between, intrinsics=K)
    assert isinstance(found, splatnode.Located) and found.K[0, 0] == pytest.approx(K[0, 0], rel=0.02)


def test_near_to_where_it_was_taken_it_is_placed_without_looking_everywhere(result, between, monkeypatch):
    found = result.localise(between)
    monkeypatch.setattr("splatnode.recon.locating.localize.localize_image", None)
    for near in (found, found.T_world_camera, result.cameras[1].T_world_camera.tolist()):
        again = result.localise(between, near=near)
        assert isinstance(again, splatnode.Located)
        assert np.allclose(again.T_world_camera, found.T_world_camera, atol=0.01)


def test_where_nothing_was_found_before_it_is_looked_for_everywhere(result, between):
    found, before = result.localise(between), result.localise(np.zeros((240, 320, 3), np.uint8))
    assert isinstance(before, splatnode.NotLocated)
    assert np.array_equal(result.localise(between, near=before).T_world_camera, found.T_world_camera)


@pytest.mark.parametrize(
    ("near", "error", "said"),
    [
        ("behind", TypeError, r"near must be what localise returned, or T_world_camera \(4, 4\), got str"),
        (np.eye(3), TypeError, r"got shape \(3, 3\)"),
        (2.0 * np.eye(4), ValueError, "near must be a rigid motion"),
        (np.full((4, 4), np.nan), ValueError, "near must be a matrix of 16 finite numbers"),
    ],
)
def test_what_is_no_place_is_told(result, between, near, error, said):
    with pytest.raises(error, match=said):
        result.localise(between, near=near)


def test_noise_is_refused(result):
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    found = result.localise(noise)
    assert isinstance(found, splatnode.NotLocated) and found.code.value == "NOT_FOUND" and found.advice


@pytest.mark.parametrize(
    ("image", "error", "said"),
    [
        (5, TypeError, "NumPy array .* or a PIL image, got int"),
        (np.zeros((2, 240, 320, 3), np.uint8), ValueError, r"must be \(H, W, 3\)"),
        ("nothing.png", FileNotFoundError, "no photograph 'nothing.png'"),
    ],
)
def test_what_is_no_photograph_is_told(result, image, error, said):
    with pytest.raises(error, match=said):
        result.localise(image)


def test_without_a_scene_there_is_nowhere_to_look(arrays):
    refused = splatnode.reconstruct(arrays[:1], config=QUICK)
    with pytest.raises(ValueError, match="TOO_FEW_VIEWS"):
        refused.localise(arrays[0])


def test_a_result_without_landmarks_says_so(result, arrays, tmp_path):
    folder = result.save(tmp_path / "older")
    (folder / "landmarks.npz").unlink()
    with pytest.raises(ValueError, match="landmarks"):
        splatnode.load(folder).localise(arrays[0])
