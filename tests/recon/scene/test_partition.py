"""Pieces of an image: counted where the answer is plain, and held to their promise on noise."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.core import default_threads, set_threads
from splatnode.recon.scene.initialization import partition


def cut(
    features: np.ndarray, wanted: np.ndarray | None = None, weights: np.ndarray | None = None, **changed
) -> tuple[np.ndarray, int]:
    settings = {"tile_px": 64, "min_area_px": 1, "max_error": 0.1, "noise_variance": 0.0} | changed
    everywhere = np.ones(features.shape[:2], np.float32)
    return partition(
        features,
        everywhere if weights is None else weights,
        everywhere > 0 if wanted is None else wanted,
        **settings,
    )


def grey(values: np.ndarray) -> np.ndarray:
    """(h, w, 4) features of which only the first differs."""
    features = np.zeros((*values.shape, 4), np.float32)
    features[..., 0] = values
    return features


def error(features: np.ndarray, inside: np.ndarray) -> float:
    chosen = features[inside].astype(np.float64)
    return float(((chosen - chosen.mean(0)) ** 2).sum())


def test_a_plain_image_is_cut_along_the_grid_only():
    labels, count = cut(grey(np.full((40, 100), 0.3)), tile_px=32)
    assert count == 2 * 4
    assert len(np.unique(labels[:32, :32])) == 1 and labels[0, 31] != labels[0, 32]


@pytest.mark.parametrize("channel", range(4))
def test_one_cut_at_a_straight_edge_whatever_channel_shows_it(channel):
    features = np.zeros((32, 48, 4), np.float32)
    features[:, 19:, channel] = 1.0
    labels, count = cut(features)
    assert count == 2
    assert (labels[:, :19] == labels[0, 0]).all() and (labels[:, 19:] == labels[0, -1]).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_one_cut_at_a_diagonal_edge(sign):
    rows, columns = np.indices((32, 32))
    _, count = cut(grey((columns - 16 > sign * (rows - 16)).astype(float)))
    assert count == 2


def test_detail_takes_small_pieces_and_plain_ground_large_ones():
    values = np.full((64, 64), 0.5)
    values[:16, :16] = np.random.default_rng(0).random((16, 16))
    labels, count = cut(grey(values), max_error=1e-5)
    detail = np.unique(labels[:16, :16])
    assert len(detail) > 200 and np.median(np.bincount(labels.ravel())[detail]) == 1
    assert count - len(detail) < 30


def test_no_piece_keeps_more_than_the_error_unless_it_is_of_the_smallest():
    random = np.random.default_rng(0)
    features = random.normal(0, 0.1, (50, 70, 4)).astype(np.float32)
    labels, count = cut(features, max_error=0.3, min_area_px=6)
    sizes = np.bincount(labels.ravel(), minlength=count)
    assert sizes.sum() == labels.size and sizes.min() >= 1
    for piece in range(count):
        assert sizes[piece] <= 6 or error(features, labels == piece) <= 0.3 * 1.001
    # And none could have been left whole: halves of a piece of 0.3 have at least some of it.
    assert 4 * features.shape[0] * features.shape[1] * 0.01 / 0.3 < count < features.shape[0] * features.shape[1]


def test_noise_that_is_allowed_for_is_not_cut():
    features = np.random.default_rng(0).normal(0, 0.02, (64, 64, 4)).astype(np.float32)
    assert cut(features, max_error=0.1)[1] > 20
    assert cut(features, max_error=0.1, noise_variance=4 * 0.02**2 * 1.1)[1] == 1


def test_what_weighs_little_is_cut_as_if_it_differed_less():
    values = np.random.default_rng(0).random((32, 32))
    _, fine = cut(grey(values))
    _, coarse = cut(grey(values), weights=np.full((32, 32), 0.04, np.float32))
    assert coarse == cut(grey(0.2 * values))[1] < 0.5 * fine
    left = np.where(np.arange(32) < 16, 1.0, 1e-6).astype(np.float32)
    labels, _ = cut(grey(values), weights=np.tile(left, (32, 1)))
    assert len(np.unique(labels[:, :16])) > 10 * len(np.unique(labels[:, 18:]))


def test_unwanted_pixels_belong_to_no_piece_and_have_no_say():
    values = np.zeros((32, 32))
    values[8:12] = 1.0
    wanted = np.ones((32, 32), bool)
    wanted[8:12] = False
    labels, count = cut(grey(values), wanted)
    assert count == 1 and ((labels == -1) == ~wanted).all()
    labels, count = cut(grey(values), np.zeros((32, 32), bool))
    assert count == 0 and (labels == -1).all()


def test_the_pieces_do_not_depend_on_the_threads():
    features = np.random.default_rng(1).random((90, 130, 4)).astype(np.float32)
    try:
        set_threads(1)
        alone = cut(features, tile_px=16)
        set_threads(4)
        together = cut(features, tile_px=16)
    finally:
        set_threads(default_threads())
    assert alone[1] == together[1] and np.array_equal(alone[0], together[0])


def test_wrong_shapes_and_sizes_are_refused():
    with pytest.raises(ValueError, match="features must be"):
        cut(np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ValueError, match="tile_px"):
        cut(grey(np.zeros((4, 4))), tile_px=0)
