"""What other views say of a depth, and which way normals face: values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.priors import compute_depth_normals
from splatnode.recon.priors.stereo import (
    Agreement,
    Confidence,
    ConsistencyConfig,
    Planes,
    compute_agreement,
    compute_confidence,
    make_level,
)

WIDTH, HEIGHT = 48, 32
K = np.array([[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]])


def planes(depth: float) -> Planes:
    values = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    values[..., 0] = 1 / depth
    return Planes(values, np.zeros((HEIGHT, WIDTH), np.float32))


@pytest.mark.parametrize(("seen", "consistent", "conflicting"), [(2.0, 1, 0), (4.0, 0, 1), (1.0, 0, 0)])
def test_a_view_that_sees_something_behind_a_point_looks_through_it(seen, consistent, conflicting):
    """Both cameras stand side by side; what the other one sees at the point is there, behind it or before it."""
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    aside = np.eye(4)
    aside[0, 3] = 0.1
    one, other = (make_level(grey, K, T, (0.5, 10.0), 0) for T in (np.eye(4), aside))
    found = compute_agreement(one, planes(2.0), [other], [planes(seen)], ConsistencyConfig())
    middle = np.s_[8:24, 16:32]
    assert (found.num_inside[middle] == 1).all()
    assert (found.num_consistent[middle] == consistent).all()
    assert (found.num_conflicting[middle] == conflicting).all()


def confidence(consistent: int = 0, conflicting: int = 0, inside: int = 2, **of_pixel: float) -> float:
    values = {"support": 0.5, "contrast": 9.5, "cosine": 0.8, **of_pixel}
    counts = (np.array([[count]], np.uint8) for count in (consistent, inside, conflicting))
    agreement = Agreement(np.ones((1, 1), np.float32), *counts)
    arrays = (np.array([[values[name]]], np.float32) for name in ("support", "contrast", "cosine"))
    return float(compute_confidence(*arrays, agreement, Confidence())[0, 0])


def test_the_confidence_of_a_depth_by_hand():
    log_odds = -4.3 + 4.95 * 0.5 + 0.17 * 2 - 0.67 * 0.5 + 0.7 * np.log(10.0) + 0.9 * 0.8
    assert confidence(consistent=2, conflicting=1) == pytest.approx(1 / (1 + np.exp(-log_odds)), rel=1e-4)


def test_confidence_grows_with_what_speaks_for_a_depth_and_falls_with_what_speaks_against_it():
    plain = confidence()
    assert confidence(consistent=1) > plain and confidence(consistent=3) == confidence(consistent=5)
    assert confidence(conflicting=2) < confidence(conflicting=1) < plain
    assert confidence(support=0.8) > plain and confidence(contrast=20.0) > plain and confidence(cosine=0.95) > plain


def test_normals_of_a_depth_map_face_the_camera():
    u, _ = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    depth = (3.0 / (1.0 - 0.75 * (u - K[0, 2]) / K[0, 0])).astype(np.float32)  # z = 3 + .75 x
    expected = np.array([0.6, 0.0, -0.8])
    assert np.allclose(compute_depth_normals(depth, K)[4:-4, 4:-4], expected, atol=1e-3)
    assert np.allclose(compute_depth_normals(np.full_like(depth, 2.0), K), [0.0, 0.0, -1.0], atol=1e-6)
    assert not compute_depth_normals(np.zeros_like(depth), K).any()
