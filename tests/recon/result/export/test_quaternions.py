"""Rotation matrices and quaternions: rotations survive both ways."""

from __future__ import annotations

import warnings

import numpy as np

from splatnode.recon.result.placement import matrices_from_quats, quats_from_matrices


def test_quaternions_and_matrices_agree_for_every_largest_component():
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(200, 4))
    quats[:4] = np.eye(4)  # the identity and the three half turns
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    matrices = matrices_from_quats(quats)
    assert np.allclose(matrices @ matrices.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    back = quats_from_matrices(matrices)
    assert np.allclose(np.abs((quats * back).sum(1)), 1.0, atol=1e-12)
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(quats_from_matrices(quarter_turn_about_z), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_a_quaternion_of_any_length_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(matrices_from_quats([1e200, 0.0, 0.0, 0.0])).all()
        assert np.isnan(matrices_from_quats([0.0, 0.0, 0.0, 0.0])).all()
