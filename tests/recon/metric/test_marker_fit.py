"""Corners of markers as a real camera shows them: blurred, by gamma, in uneven light, of ink that spreads."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.metric.measurement import refine_corners

BITS = np.zeros((6, 6), bool)
BITS[1:5, 1:5] = [[1, 0, 1, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 1, 0]]  # number 0 of 4X4_50
FINE, TEXELS = 8, 64


def photograph(side: float, seed: int, gamma: float, blur: float, ink: float) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels (H, W), and the corners (4, 2) of the marker's true square; `ink` is by how many bits black grows."""
    rng = np.random.default_rng(seed)
    printed = np.kron(np.pad(BITS, 1, constant_values=True), np.ones((TEXELS, TEXELS))) * 0.75 + 0.08
    grown = 2 * round(ink * TEXELS) + 1
    printed = cv2.erode(printed, np.ones((grown, grown)))
    middle, angle = side * 1.2 + 10.0, rng.uniform(0.0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    square = side * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * (1.0, rng.uniform(0.6, 1.0))
    corners = (square @ turn.T) * (1.0 + 0.1 * rng.uniform(-1, 1, (4, 1))) + middle + rng.uniform(0, 1, 2)
    of_print = TEXELS * np.array([[1, 1], [7, 1], [7, 7], [1, 7]]) - 0.5
    to_fine = cv2.getPerspectiveTransform(of_print.astype(np.float32), (FINE * corners - 0.5).astype(np.float32))
    size = int(2 * middle)
    seen = cv2.warpPerspective(printed, to_fine, (FINE * size, FINE * size), borderValue=0.83)
    seen = cv2.GaussianBlur(seen, (0, 0), FINE * blur)
    seen = cv2.resize(seen, (size, size), interpolation=cv2.INTER_AREA) * np.linspace(0.7, 1.0, size)
    return (255 * seen ** (1 / gamma) + rng.normal(0.0, 2.0, seen.shape)).astype(np.float32), corners


def around(corners: np.ndarray) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).sum())


@pytest.mark.parametrize("side", [24.0, 60.0])
@pytest.mark.parametrize(("gamma", "blur", "ink"), [(1.0, 0.4, 0.0), (2.2, 1.0, 0.0), (2.2, 0.6, 0.06)])
def test_the_side_is_right_within_a_third_of_a_percent(side, gamma, blur, ink):
    errors = []
    for seed in range(3):
        picture, true = photograph(side, seed, gamma, blur, ink)
        rough = true + np.random.default_rng(seed).normal(0.0, 0.5, (4, 2))
        found = refine_corners(picture, BITS, rough)
        assert found is not None and found.correlation > 0.98
        np.testing.assert_allclose(found.pixels, true, atol=0.3)
        errors.append(around(found.pixels) / around(true) - 1.0)
    assert abs(np.mean(errors)) < 0.0033


def test_a_marker_at_the_border_is_not_fitted():
    picture, true = photograph(40.0, 1, 1.0, 0.5, 0.0)
    left = int(true[:, 0].min())
    assert refine_corners(np.ascontiguousarray(picture[:, left:]), BITS, true - [left, 0.0]) is None


def test_what_is_no_marker_has_little_correlation():
    noise = np.random.default_rng(0).normal(128.0, 40.0, (100, 100)).astype(np.float32)
    found = refine_corners(noise, BITS, np.array([[30.0, 30.0], [70.0, 30.0], [70.0, 70.0], [30.0, 70.0]]))
    assert found is not None and found.correlation < 0.7
    negative, true = photograph(40.0, 1, 1.0, 0.5, 0.0)
    turned = refine_corners(255.0 - negative, BITS, true)
    assert turned is not None and turned.correlation < 0.7
