"""Gaussians with their axes named anew are the same Gaussians."""

from __future__ import annotations

import numpy as np

from splatnode.recon.result.export.limits import minimize_rotations
from splatnode.recon.result.placement import matrices_from_quats
from splatnode.recon.result.snapshot import GaussianArrays
from tests.support.exported import make_gaussians


def covariances(gaussians: GaussianArrays) -> np.ndarray:
    axes = matrices_from_quats(gaussians.quats) * gaussians.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_the_same_gaussians_are_turned_little():
    gaussians = make_gaussians(2000)
    turned = minimize_rotations(gaussians)
    size = gaussians.scales.max(1)[:, None, None] ** 2
    assert np.allclose(covariances(turned) / size, covariances(gaussians) / size, atol=1e-5)
    assert (np.sort(turned.scales, 1) == np.sort(gaussians.scales, 1)).all()
    assert turned.quats.dtype == np.float32 and turned.scales.dtype == np.float32
    assert turned.quats[:, 0].min() > 0.853 > np.abs(gaussians.quats).max(1).min()
    assert np.abs(turned.quats[:, 1:]).max() < 0.39


def test_a_quarter_turn_is_none():
    quarter = make_gaussians(1)
    quarter.quats[:] = np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)  # about z
    turned = minimize_rotations(quarter)
    assert np.allclose(turned.quats, [1.0, 0.0, 0.0, 0.0], atol=1e-6)
    assert (turned.scales == quarter.scales[:, [1, 0, 2]]).all()
