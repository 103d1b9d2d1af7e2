"""Global alignment of synthetic pair predictions: noise, wrong scales and outlier pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.priors.mast3r import PairPoints, align_views

HEIGHT, WIDTH, FOCAL = 36, 48, 45.0


def cameras(count: int) -> np.ndarray:
    """An arc of `count` cameras around a scene 4 units away."""
    Ts = np.tile(np.eye(4), (count, 1, 1))
    for index, angle in enumerate(np.radians(np.linspace(-35, 35, count))):
        Ts[index, :3, :3] = Rotation.from_euler("yxz", [angle, 0.1 * np.sin(3 * angle), 0.05 * angle]).as_matrix()
        Ts[index, :3, 3] = np.array([0, 0, 4.0]) - Ts[index, :3, :3] @ np.array([0, 0, 4.0 + 0.3 * np.cos(5 * angle)])
    return Ts


def depth_map(T_world_camera: np.ndarray) -> np.ndarray:
    """Depth of a wavy surface near z = 4, by marching each ray."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], -1)
    depth = np.full((HEIGHT, WIDTH), 4.0)
    for _ in range(60):
        world = (rays * depth[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        surface = 4.0 + 0.4 * np.sin(1.5 * world[..., 0]) + 0.3 * np.cos(2.0 * world[..., 1])
        depth += 0.5 * (surface - world[..., 2])
    return depth


def predictions(
    Ts: np.ndarray, noise: float, outlier_share: float, rng: np.random.Generator
) -> dict[tuple[int, int], PairPoints]:
    """Points of every ordered pair, with smooth errors of `noise` of the depth, each pair at a scale of its own."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], -1)
    own = [rays * depth_map(T)[..., None] for T in Ts]

    def predicted(points: np.ndarray) -> np.ndarray:
        return points * (1 + noise * rng.standard_normal(points.shape[:2])[..., None])

    pairs = {}
    for i in range(len(Ts)):
        for j in range(len(Ts)):
            if i == j:
                continue
            to_first = np.linalg.inv(Ts[i]) @ Ts[j]
            if rng.random() < outlier_share:
                to_first[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
                to_first[:3, 3] = rng.normal(0, 2, 3)
            second = predicted(own[j]) @ to_first[:3, :3].T + to_first[:3, 3]
            scale = np.exp(rng.normal(0, 0.5))
            confidence = (1 + rng.gamma(2.0, 1.0, (2, HEIGHT, WIDTH))).astype(np.float32)
            pairs[i, j] = PairPoints(
                (scale * predicted(own[i])).astype(np.float32), confidence[0],
                (scale * second).astype(np.float32), confidence[1],
            )  # fmt: skip
    return pairs


def intrinsics(focals: list[float]) -> np.ndarray:
    return np.stack([np.array([[f, 0, WIDTH / 2], [0, f, HEIGHT / 2], [0, 0, 1]]) for f in focals])


@pytest.mark.parametrize(("count", "outliers"), [(2, 0.0), (3, 0.0), (12, 0.2)])
def test_cameras_are_found_from_noisy_pairs(count, outliers):
    Ts = cameras(count)
    views = align_views(predictions(Ts, 0.01, outliers, np.random.default_rng(count)))
    estimated = np.stack([view.T_world_camera for view in views])
    errors = compare_cameras(estimated, Ts, intrinsics([v.focal for v in views]), intrinsics([FOCAL] * count))
    assert errors.rotation_pair_deg is not None and errors.rotation_pair_deg < 0.2
    assert errors.centre_pct is not None and (count == 2 or errors.centre_pct < 0.5)
    assert errors.focal_pct is not None and errors.focal_pct < 1.0
    np.testing.assert_allclose(views[0].T_world_camera, np.eye(4), atol=1e-12)
    assert np.median(views[0].depth) == pytest.approx(1.0)
    true_step = np.linalg.norm(Ts[1, :3, 3] - Ts[0, :3, 3]) / np.median(depth_map(Ts[0]))
    assert np.linalg.norm(estimated[1, :3, 3]) == pytest.approx(true_step, abs=0.003)
    assert np.median(views[1].depth) == pytest.approx(
        np.median(depth_map(Ts[1])) / np.median(depth_map(Ts[0])), rel=0.01
    )
    assert max(view.residual for view in views) < 0.05


def test_perfect_pairs_give_perfect_cameras():
    Ts = cameras(4)
    views = align_views(predictions(Ts, 0.0, 0.0, np.random.default_rng(0)), shared_focal=False)
    relative = np.linalg.inv(Ts[0]) @ Ts[3]
    np.testing.assert_allclose(views[3].T_world_camera[:3, :3], relative[:3, :3], atol=1e-5)
    assert views[2].focal == pytest.approx(FOCAL, rel=1e-4)


def test_wrong_pairs_leave_no_trace():
    Ts = cameras(8)
    views = align_views(predictions(Ts, 0.0, 0.2, np.random.default_rng(1)))
    estimated = np.stack([view.T_world_camera for view in views])
    errors = compare_cameras(estimated, Ts, intrinsics([v.focal for v in views]), intrinsics([FOCAL] * 8))
    assert errors.centre_pct is not None and errors.centre_pct < 0.01


def test_views_that_no_pair_connects_are_refused():
    pairs = predictions(cameras(4), 0.0, 0.0, np.random.default_rng(0))
    apart = {pair: pairs[pair] for pair in ((0, 1), (1, 0), (2, 3), (3, 2))}
    with pytest.raises(ValueError, match=r"views \[0, 1\] stand alone"):
        align_views(apart)
    with pytest.raises(ValueError, match="view 1 must be the first"):
        align_views({(0, 1): pairs[0, 1]})
