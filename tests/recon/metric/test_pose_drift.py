"""A scene lies in the world of poses as their errors tell: at their start where these add up, else amid all of them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Motion
from splatnode.recon.geometry import Similarity
from splatnode.recon.metric.measurement import MetricView
from splatnode.recon.metric.odometry import (
    PoseAlignment,
    PoseNoise,
    PoseSigmas,
    align_to_motions,
    align_to_poses,
    fit_placement,
    part_steps,
)

TOLD = PoseSigmas(0.01, 2.0, 0.02)  # as nobody tells otherwise
UNIT = 1.7  # metres a unit of the scene
STEP_M = 0.2
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()  # of the scene's axes


def make_walk(count: int, rng: np.random.Generator) -> np.ndarray:
    """(C, 4, 4) T_world_camera of a way that winds, metres; the first is the world."""
    Ts, heading = np.tile(np.eye(4), (count, 1, 1)), np.cumsum(rng.normal(0.0, 0.25, count))
    heading -= heading[0]
    Ts[:, :3, :3] = Rotation.from_euler("y", heading[:, None]).as_matrix()
    steps = STEP_M * np.column_stack([np.sin(heading), rng.normal(0.0, 0.05, count), np.cos(heading)])
    Ts[1:, :3, 3] = np.cumsum(steps[:-1], axis=0)
    return Ts


def measure(
    Ts: np.ndarray, rng: np.random.Generator, steps: tuple[float, float], own: tuple[float, float]
) -> np.ndarray:
    """(C, 4, 4) poses whose `steps`, and which by their `own`, are off: metres in each direction, degrees."""
    found = [Ts[0]]
    for before, after in pairwise(Ts):
        found.append(found[-1] @ np.linalg.inv(before) @ after @ make_error(rng, *steps))
    return np.stack([T @ make_error(rng, *own) for T in found])


def make_error(rng: np.random.Generator, metres: float, degrees: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(rng.normal(0.0, degrees, 3))).as_matrix()
    T[:3, 3] = rng.normal(0.0, metres, 3)
    return T


def make_views(Ts: np.ndarray, bounds: tuple[float, float] = (0.001, 0.05)) -> dict[str, MetricView]:
    """The true cameras, as a scene has them whose unit and axes are others; `bounds` in its unit, and in degrees."""
    found = {}
    for index, T in enumerate(Ts):
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = TURN @ T[:3, :3], TURN @ T[:3, 3] / UNIT
        found[f"{index:03d}"] = MetricView(moved, 1.0, np.zeros(2), np.zeros(2), *bounds)
    return found


def find_worst_m(by: Similarity, views: dict[str, MetricView], Ts: np.ndarray) -> float:
    placed = by(np.stack([view.centre for view in views.values()]))
    return float(np.linalg.norm(placed - Ts[:, :3, 3], axis=1).max())


def align(seed: int, count: int, steps: tuple[float, float], own: tuple[float, float]) -> tuple[float, PoseAlignment]:
    """Metres by which the camera that is worst is off where the unit is known, and the alignment."""
    rng = np.random.default_rng(seed)
    Ts = make_walk(count, rng)
    views, given = make_views(Ts), measure(Ts, rng, steps, own)
    found = align_to_poses(views, dict(zip(views, given, strict=True)), TOLD)
    assert isinstance(found, PoseAlignment), found
    return find_worst_m(found.rescale(UNIT), views, Ts), found


NONE = 0.0, 0.0


def test_poses_that_drift_place_the_scene_where_they_begin():
    worst = []
    for seed in range(6):
        off, found = align(seed, 40, (0.002, 0.2), NONE)
        worst.append(off)
        assert found.placement is not None
        factors = found.placement.factors
        assert factors.own_turn * 2.0 < 0.1 and factors.own_shift * 0.01 < 0.002  # degrees, metres: nearly none
        assert 0.25 < factors.step_turn < 8.0  # 2.3 degrees at the end for a factor of 1; it is 1.2
        low, high = found.unit.interval_95
        assert low <= UNIT / found.unit.metres_per_unit <= high
    assert np.median(worst) < 0.008 and max(worst) < 0.02  # the end of the odometry is 0.1 m off


def test_bounds_of_the_scene_s_cameras_that_are_too_wide_hide_no_drift():
    worst = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        Ts = make_walk(40, rng)
        views, given = make_views(Ts, (0.01, 0.7)), measure(Ts, rng, (0.002, 0.2), NONE)
        found = align_to_poses(views, dict(zip(views, given, strict=True)), TOLD)
        assert isinstance(found, PoseAlignment)
        worst.append(find_worst_m(found.rescale(UNIT), views, Ts))
    assert np.median(worst) < 0.008 and max(worst) < 0.02


def test_errors_of_each_pose_s_own_are_averaged():
    off = {count: [align(seed, count, NONE, (0.01, 1.0))[0] for seed in range(6)] for count in (10, 90)}
    assert np.median(off[10]) < 0.02
    assert np.median(off[90]) < 0.02  # on a way nine times as long
    _, found = align(0, 90, NONE, (0.01, 1.0))
    assert found.placement is not None and found.notes == ()
    factors = found.placement.factors
    assert (factors.own_turn, factors.own_shift) == (0.5, 1.0)
    assert factors.step_turn <= 0.25 and factors.step_shift <= 0.25


def test_both_kinds_of_errors_are_told_from_each_other():
    worst = []
    for seed in range(6):
        off, found = align(seed, 60, (0.004, 0.4), (0.02, 0.5))
        worst.append(off)
        assert found.placement is not None
        factors = found.placement.factors
        assert 0.125 <= factors.own_turn <= 0.5 and 1.0 <= factors.own_shift <= 4.0  # 0.25 and 2 are right
        assert factors.step_turn >= 0.5
    assert np.median(worst) < 0.1  # half a degree of 12 m; the end of the odometry is farther off


@pytest.mark.parametrize("wrong", [0, 7, 39])
def test_a_pose_that_is_far_off_is_named_and_moves_nothing(wrong):
    rng = np.random.default_rng(wrong)
    Ts = make_walk(40, rng)
    views, given = make_views(Ts), measure(Ts, rng, (0.002, 0.2), NONE)
    poses = dict(zip(views, given, strict=True))
    right = align_to_poses(views, poses, TOLD)
    given[wrong] = given[wrong].copy()
    given[wrong][:3, 3] += [0.6, -0.6, 0.53]
    found = align_to_poses(views, dict(zip(views, given, strict=True)), TOLD)
    assert isinstance(found, PoseAlignment) and isinstance(right, PoseAlignment)
    (told,) = found.notes
    assert told.startswith(f"the pose of {wrong:03d} was left out: it is ")
    # Without the first pose the second one is as near the start as is known
    assert find_worst_m(found.rescale(UNIT), views, Ts) < find_worst_m(right.rescale(UNIT), views, Ts) + 0.02


def test_drift_that_was_told_to_be_none_is_none():
    rng = np.random.default_rng(0)
    Ts = make_walk(20, rng)
    views, given = make_views(Ts), measure(Ts, rng, NONE, (0.01, 1.0))
    found = align_to_poses(views, dict(zip(views, given, strict=True)), replace(TOLD, drift=0.0))
    assert isinstance(found, PoseAlignment) and found.placement is not None
    count = len(found.placement.given)
    off_diagonal = found.placement.covariance - np.diag(np.diag(found.placement.covariance))
    assert count == 20 and not off_diagonal.any()


def make_motions(given: np.ndarray, slip_m: float = 0.0, slips: int = 0) -> dict[str, Motion]:
    """The chain of motions that adds up to the poses, but for one along which wheels slip."""
    motion = Motion("000")
    found = {"000": motion}
    for index in range(1, len(given)):
        step = np.linalg.inv(given[index - 1]) @ given[index]
        step[2, 3] += slip_m * (index == slips)
        found[f"{index:03d}"] = motion = motion.append_step(step, 0.002, 0.2)
    return found


def test_motions_place_the_scene_where_they_began_and_a_slip_costs_what_follows_it():
    for slip_m in (0.0, 1.5):
        worst = []
        for seed in range(6):
            rng = np.random.default_rng(seed)
            Ts = make_walk(40, rng)
            views, motions = make_views(Ts), make_motions(measure(Ts, rng, (0.002, 0.2), NONE), slip_m, slips=10)
            placement = align_to_motions(views, motions, {name: each.matrix for name, each in motions.items()})
            assert not isinstance(placement, str)
            worst.append(find_worst_m(placement.place(UNIT), views, Ts))
        assert np.median(worst) < 0.008 and max(worst) < 0.02


def test_of_many_poses_an_even_choice_is_looked_at_and_others_keep_what_was_thought_of_them():
    rng = np.random.default_rng(1)
    Ts = make_walk(400, rng)
    given = measure(Ts, rng, (0.002, 0.2), NONE)
    sigmas = np.tile([np.radians(0.2), 0.002], (400, 1))
    noise = PoseNoise(sigmas, sigmas, np.array([1e-4, 1e-4]))
    kept = np.ones(400, bool)
    kept[1] = False
    placement = fit_placement(Ts, given, Similarity(1.0, np.eye(3), np.zeros(3)), kept, noise)
    assert len(placement.given) == 150
    np.testing.assert_array_equal(placement.given[[0, -1]], given[[0, -1]])
    assert placement.fits.sum() == 399 and not placement.fits[1]
    place = placement.place(1.0)
    assert np.linalg.norm(place(Ts[:, :3, 3]) - Ts[:, :3, 3], axis=1).max() < 0.03


def test_a_chosen_few_have_the_errors_of_the_steps_between():
    steps = np.array([[9.0, 9.0], [3.0, 0.3], [4.0, 0.4], [1.0, 0.1]])
    noise = PoseNoise(np.ones((4, 2)), steps, np.ones(2))
    np.testing.assert_allclose(noise.choose(np.array([0, 2, 3])).steps, [[0.0, 0.0], [5.0, 0.5], [1.0, 0.1]])
    parted = part_steps(noise, np.array([False, False, True, False]), 2.0)
    np.testing.assert_allclose(parted.steps[[1, 3]], steps[[1, 3]])
    assert parted.steps[2, 1] == 2.0 * parted.steps[2, 0] > 10.0
