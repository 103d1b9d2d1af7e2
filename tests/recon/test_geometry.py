"""Rigid motions, quaternions and similarities: axioms as properties, and values from independent implementations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from splatnode.recon.geometry import (
    Similarity,
    align_cameras,
    exp_se3,
    matrices_from_quats,
    multiply_quats,
    project,
    quat_from_matrix,
    transform_to_camera,
    twist_gradient,
)

SIZES = (0.0, 1e-12, 1e-7, 1e-5, 9.9e-3, 1.01e-2, 0.3, 3.1, np.pi, 6.0)  # near identity, and where the formula changes


def numbers(count: int) -> st.SearchStrategy[Tensor]:
    return st.lists(st.floats(-1, 1), min_size=count, max_size=count).map(
        lambda v: torch.tensor(v, dtype=torch.float64)
    )


directions = numbers(3).filter(lambda v: float(v.norm()) > 1e-3).map(lambda v: v / v.norm())
rotations = st.builds(lambda direction, angle: angle * direction, directions, st.sampled_from(SIZES))
twists = st.builds(lambda rho, phi: torch.cat([rho, phi]), numbers(3), rotations)
quats = numbers(4).filter(lambda v: float(v.norm()) > 1e-3).map(lambda v: v / v.norm())


def twist_matrix(twist: Tensor) -> Tensor:
    """(4, 4) element of the Lie algebra, of which exp_se3 is the matrix exponential."""
    x, y, z = twist[3:]
    zero = torch.zeros((), dtype=twist.dtype)
    rows = [[zero, -z, y, twist[0]], [z, zero, -x, twist[1]], [-y, x, zero, twist[2]], [zero] * 4]
    return torch.stack([torch.stack(row) for row in rows])


def matrix(quat: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_quat(quat.numpy()[..., [1, 2, 3, 0]]).as_matrix())


@given(twists)
def test_exp_se3_is_the_matrix_exponential(twist):
    torch.testing.assert_close(exp_se3(twist), torch.linalg.matrix_exp(twist_matrix(twist)), rtol=0, atol=1e-13)


@given(twists)
def test_the_opposite_twist_is_the_inverse_motion(twist):
    torch.testing.assert_close(exp_se3(twist) @ exp_se3(-twist), torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-13)


def test_exp_se3_known_values():
    assert torch.equal(exp_se3(torch.zeros(6)), torch.eye(4))
    # A quarter turn about z along an arc of radius 1: from the origin, heading x, to (1, 1).
    quarter = exp_se3(torch.tensor([np.pi / 2, 0, 0, 0, 0, np.pi / 2], dtype=torch.float64))
    expected = torch.tensor([[0, -1, 0, 1], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(quarter, expected, rtol=0, atol=1e-15)


def test_exp_se3_keeps_the_dtype_and_takes_a_tensor_that_requires_its_gradient():
    twist = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], requires_grad=True)
    motion = exp_se3(twist)
    assert motion.dtype == torch.float32 and not motion.requires_grad
    torch.testing.assert_close(motion, exp_se3(twist.detach().double()).float(), rtol=0, atol=1e-6)


@given(twists, numbers(16))
def test_twist_gradient_is_the_derivative_along_each_twist(twist, weights):
    T, weights = exp_se3(twist), weights.reshape(4, 4)

    def value(T: Tensor) -> Tensor:
        return (weights * T.sin() + (weights.T @ T) ** 2).sum()

    leaf = T.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    step = 1e-6 * torch.eye(6, dtype=torch.float64)
    measured = torch.stack([value(T @ exp_se3(x)) - value(T @ exp_se3(-x)) for x in step]) / 2e-6
    torch.testing.assert_close(twist_gradient(T, gradient), measured, rtol=1e-6, atol=1e-7)


@given(twists, numbers(16))
def test_twist_gradient_is_that_of_autograd_through_the_matrix_exponential(twist, weights):
    T, weights = exp_se3(twist), weights.reshape(4, 4)
    x = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad((weights * (T @ torch.linalg.matrix_exp(twist_matrix(x)))).sum(), x)
    torch.testing.assert_close(twist_gradient(T, weights), expected, rtol=0, atol=1e-12)


@given(quats)
def test_a_quaternion_comes_back_from_its_matrix_with_w_not_negative(quat):
    found = quat_from_matrix(matrix(quat))
    assert found[0] >= 0
    torch.testing.assert_close(found.norm(), torch.tensor(1.0, dtype=torch.float64))
    assert float((found @ quat).abs()) > 1 - 1e-12


@pytest.mark.parametrize("axis", ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, -0.6, 0.8], [0.6, 0, -0.8]))
def test_half_turns_have_quaternions_without_w(axis):
    half_turn = 2 * np.outer(axis, axis) - np.eye(3)
    found = quat_from_matrix(torch.from_numpy(half_turn))
    assert float((found @ torch.tensor([0.0, *axis], dtype=torch.float64)).abs()) == pytest.approx(1, abs=1e-12)


def test_quaternions_of_many_matrices_at_once():
    many = torch.from_numpy(Rotation.random(6, random_state=0).as_matrix()).reshape(2, 3, 3, 3)
    each = torch.stack([quat_from_matrix(rotation) for rotation in many.reshape(6, 3, 3)])
    torch.testing.assert_close(quat_from_matrix(many).reshape(6, 4), each, rtol=0, atol=0)
    assert quat_from_matrix(torch.zeros(0, 3, 3)).shape == (0, 4)


@given(quats, quats)
def test_the_product_of_quaternions_is_the_product_of_rotations(a, b):
    torch.testing.assert_close(matrix(multiply_quats(a, b)), matrix(a) @ matrix(b), rtol=0, atol=1e-12)


def test_matrices_of_many_quaternions_of_any_length():
    many = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 4)) * np.geomspace(1e-3, 1e3, 50)[:, None])
    torch.testing.assert_close(matrices_from_quats(many), matrix(many), rtol=0, atol=1e-12)
    assert matrices_from_quats(torch.zeros(0, 4)).shape == (0, 3, 3)


def test_hamiltons_rule():
    i, j, k = torch.eye(4)[1:]
    assert torch.equal(multiply_quats(i, j), k)
    assert torch.equal(multiply_quats(j, i), -k)
    assert torch.equal(multiply_quats(i, torch.stack([i, j, k])), torch.stack([-torch.eye(4)[0], k, -j]))


def cameras(count: int, on_a_line: bool = False) -> np.ndarray:
    rng = np.random.default_rng(count)
    Ts_world_camera = np.tile(np.eye(4), (count, 1, 1))
    Ts_world_camera[:, :3, :3] = Rotation.random(count, random_state=count).as_matrix()
    centres = rng.normal(size=(count, 3))
    Ts_world_camera[:, :3, 3] = np.arange(count)[:, None] * centres[:1] if on_a_line else centres
    return Ts_world_camera


@pytest.mark.parametrize(("count", "on_a_line"), [(2, False), (3, True), (7, False)])
def test_cameras_that_a_similarity_moved_are_aligned_exactly(count, on_a_line):
    truth = Similarity(2.5, Rotation.random(random_state=9).as_matrix(), np.array([3.0, -1.0, 0.5]))
    source = cameras(count, on_a_line)
    target = np.stack([truth.camera(T) for T in source])
    found = align_cameras(source, target)
    assert found.scale == pytest.approx(truth.scale)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-12)
    np.testing.assert_allclose([found.camera(T) for T in source], target, atol=1e-12)


def test_a_moved_camera_is_rigid_and_sees_the_moved_world_alike():
    similarity = Similarity(0.4, Rotation.random(random_state=3).as_matrix(), np.array([1.0, 2.0, 3.0]))
    (T,) = cameras(1)
    moved = similarity.camera(T)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    point = np.array([0.3, -0.2, 2.0])
    moved_point = similarity.scale * similarity.rotation @ point + similarity.translation
    before = T[:3, :3].T @ (point - T[:3, 3])
    after = moved[:3, :3].T @ (moved_point - moved[:3, 3])
    np.testing.assert_allclose(after, similarity.scale * before, atol=1e-12)
    np.testing.assert_allclose(similarity(point), moved_point, atol=1e-12)


def test_the_covariance_of_moved_points_is_the_moved_covariance():
    similarity = Similarity(0.4, Rotation.random(random_state=3).as_matrix(), np.array([1.0, 2.0, 3.0]))
    points = np.random.default_rng(0).normal(size=(2, 50, 3)) * [3.0, 1.0, 0.5]
    before, after = (np.stack([np.cov(each.T) for each in of]) for of in (points, similarity(points)))
    np.testing.assert_allclose(similarity.covariance(before), after, atol=1e-12)


def test_similarities_are_composed_and_undone():
    first, second = (
        Similarity(scale, Rotation.random(random_state=seed).as_matrix(), np.array([1.0, seed, -2.0]))
        for seed, scale in ((1, 0.3), (2, 4.0))
    )
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(second.after(first)(points), second(first(points)), atol=1e-12)
    np.testing.assert_allclose(first.inverse()(first(points)), points, atol=1e-12)


def test_cameras_that_never_moved_say_nothing_about_scale():
    turned = cameras(4)
    turned[:, :3, 3] = 0
    similarity = align_cameras(turned, cameras(4))
    assert similarity.scale == 1.0
    np.testing.assert_allclose(similarity.rotation, np.eye(3), atol=1e-12)


def test_noise_moves_the_alignment_only_a_little():
    rng = np.random.default_rng(0)
    source = cameras(12)
    target = source.copy()
    target[:, :3, 3] += rng.normal(scale=1e-3, size=(12, 3))
    found = align_cameras(source, target)
    assert found.scale == pytest.approx(1, abs=2e-3)
    assert np.linalg.norm(found.translation) < 2e-3


def test_a_world_point_is_projected_where_its_camera_sees_it():
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # looks along the world's x
    T_world_camera[:3, 3] = 1.0, 2.0, 3.0
    K = np.array([[100.0, 0, 50], [0, 200.0, 40], [0, 0, 1]])
    in_camera = transform_to_camera(np.array([[3.0, 2.5, 2.0], [-1.0, 2.0, 3.0]]), T_world_camera)
    np.testing.assert_allclose(in_camera, [[1, 0.5, 2], [0, 0, -2]], atol=1e-12)
    pixels = project(in_camera, K)
    np.testing.assert_allclose(pixels[0], [100 * 1 / 2 + 50, 200 * 0.5 / 2 + 40])
    assert np.isfinite(pixels).all()  # behind the camera they mean nothing, and are numbers all the same
    in_float32 = transform_to_camera(torch.tensor([[3.0, 2.5, 2.0]]), torch.from_numpy(T_world_camera).float())
    torch.testing.assert_close(in_float32, torch.tensor([[1.0, 0.5, 2.0]]))
