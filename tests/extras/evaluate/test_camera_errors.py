"""Camera errors with known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatnode.extras.evaluate.protocol import compare_cameras, compute_ate_instantsplat, compute_centre_error_pct
from splatnode.recon.geometry import Similarity, angles_deg, exp_se3, umeyama


def motion(seed: int, size: float = 1.0) -> np.ndarray:
    return exp_se3(size * torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))).numpy()


def turn_y(degrees: float) -> np.ndarray:
    return exp_se3(torch.tensor([0, 0, 0, 0, np.deg2rad(degrees), 0], dtype=torch.float64)).numpy()


def turn_z(degrees: float) -> np.ndarray:
    return exp_se3(torch.tensor([0, 0, 0, 0, 0, np.deg2rad(degrees)], dtype=torch.float64)).numpy()[:3, :3]


def arc(num_cameras: int = 6, radius: float = 4.0) -> np.ndarray:
    """(C, 4, 4) cameras on an arc of 50 degrees that look at the origin, at slightly different heights."""
    cameras = []
    for i, degrees in enumerate(np.linspace(-25, 25, num_cameras)):
        T = turn_y(degrees)
        T[:3, 3] = T[:3, :3] @ [0, 0.3 * (-1) ** i, -radius]
        cameras.append(T)
    return np.stack(cameras)


def moved(Ts: np.ndarray, scale: float = 2.5, seed: int = 3) -> np.ndarray:
    world = motion(seed)
    similarity = Similarity(scale, world[:3, :3], world[:3, 3])
    return np.stack([similarity.camera(T) for T in Ts])


def intrinsics(focals: list[float]) -> np.ndarray:
    return np.stack([np.array([[f, 0, 320.0], [0, f, 240.0], [0, 0, 1.0]]) for f in focals])


@pytest.mark.parametrize("num_points", [2, 3, 10])
def test_umeyama_recovers_a_similarity(num_points):
    points = np.random.default_rng(0).normal(size=(num_points, 3))
    world = motion(1)
    target = 0.3 * points @ world[:3, :3].T + world[:3, 3]
    found = umeyama(points, target)
    assert np.allclose(found(points), target, atol=1e-12)
    assert found.scale == pytest.approx(0.3)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_umeyama_never_reflects():
    points = np.random.default_rng(0).normal(size=(10, 3))
    assert np.linalg.det(umeyama(points, points * [1, 1, -1]).rotation) == pytest.approx(1.0)


def test_perfect_cameras_in_another_world_have_no_error():
    true = arc()
    errors = compare_cameras(moved(true), true, intrinsics([500] * 6), intrinsics([500] * 6))
    assert errors.rotation_deg == pytest.approx(0, abs=1e-10)
    assert errors.rotation_pair_deg == pytest.approx(0, abs=1e-10)
    assert errors.centre_pct == pytest.approx(0, abs=1e-10)
    assert errors.focal_pct == 0


def test_one_turned_camera_shows_its_angle():
    true = arc()
    estimated = moved(true)
    estimated[2] = estimated[2] @ turn_y(3.0)
    errors = compare_cameras(estimated, true, intrinsics([500] * 6), intrinsics([500] * 6))
    assert errors.rotation_pair_deg == pytest.approx(3.0)
    assert errors.rotation_deg == pytest.approx(3.0 * 5 / 6, abs=0.01)  # the common rotation takes a sixth of it
    assert errors.centre_pct == pytest.approx(0, abs=1e-10)


def test_focal_error_is_the_mean_of_absolute_relative_errors():
    true = arc(2)
    errors = compare_cameras(true, true, intrinsics([490, 520]), intrinsics([500, 500]))
    assert errors.focal_pct == pytest.approx(3.0)


def test_centre_error_is_in_percent_of_the_spread():
    true = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])  # RMS spread 1
    estimated = true + 0.05 * np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, -1], [0, 0, -1]])  # no similarity explains this
    assert compute_centre_error_pct(estimated, true) == pytest.approx(5.0, rel=0.01)


def test_centre_error_is_the_root_of_the_mean_square():
    """An inner ring bends like a saddle by 5 % of its radius, an outer one of twice the radius lies where it is."""
    inner = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    true = np.concatenate([inner, 2.0 * inner @ turn_z(45)])
    estimated = true + 0.05 * np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, -1], [0, 0, -1], *[[0, 0, 0]] * 4])
    rms, spread = 0.05 * 0.5**0.5, 2.5**0.5
    assert compute_centre_error_pct(estimated, true) == pytest.approx(100 * rms / spread, rel=0.01)


def test_what_cannot_be_told_is_none():
    still = np.stack([turn_y(0), turn_y(10), turn_y(20)])
    errors = compare_cameras(still, still, intrinsics([500] * 3), intrinsics([500] * 3))
    assert errors.centre_pct is None and errors.ate_instantsplat is None
    assert errors.rotation_deg == pytest.approx(0, abs=1e-10)
    one = compare_cameras(still[:1], still[:1], intrinsics([510]), intrinsics([500]))
    assert (one.rotation_deg, one.centre_pct) == (None, None)
    assert one.focal_pct == pytest.approx(2.0)
    none = compare_cameras(still[:0], still[:0], intrinsics([500])[:0], intrinsics([500])[:0])
    assert none.focal_pct is None
    with pytest.raises(ValueError, match="come in pairs"):
        compare_cameras(still, still[:2], intrinsics([500] * 3), intrinsics([500] * 3))


def test_instantsplat_ate_is_not_zero_for_a_perfect_reconstruction():
    true = arc(3)
    assert compute_ate_instantsplat(true, true) == pytest.approx(0, abs=1e-12)
    in_another_world = compute_ate_instantsplat(moved(true), true)
    assert in_another_world is not None and in_another_world > 1e-3
    assert compute_centre_error_pct(moved(true)[:, :3, 3], true[:, :3, 3]) == pytest.approx(0, abs=1e-10)


def test_angles_are_exact_where_the_arc_cosine_is_not():
    assert angles_deg(turn_y(1e-6)[:3, :3], np.eye(3)) == pytest.approx(1e-6, rel=1e-6)
    assert angles_deg(turn_y(180)[:3, :3], np.eye(3)) == pytest.approx(180)
