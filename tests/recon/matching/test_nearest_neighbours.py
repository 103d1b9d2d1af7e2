"""Native matching against brute force, on every instruction set that runs here."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from splatnode.recon.core import instruction_sets, library
from splatnode.recon.matching import features


def descriptors(count: int, seed: int) -> np.ndarray:
    raw = np.random.default_rng(seed).exponential(size=(count, 128)).astype(np.float32) ** 2
    return features.quantise(raw / np.linalg.norm(raw, axis=1, keepdims=True))


def pairs(num_common: int, num_other: int, noise: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Two sets of which the first `num_common` correspond in reverse order."""
    raw = np.random.default_rng(0).exponential(size=(num_common, 128)).astype(np.float32) ** 2
    raw /= np.linalg.norm(raw, axis=1, keepdims=True)
    seen_again = raw[::-1] + noise * np.random.default_rng(1).random(raw.shape).astype(np.float32)
    seen_again /= np.linalg.norm(seen_again, axis=1, keepdims=True)
    others = [descriptors(num_other, seed) for seed in (2, 3)]
    first, second = features.quantise(raw), features.quantise(seen_again)
    return np.concatenate([first, others[0]]), np.concatenate([second, others[1]])


def test_what_corresponds_is_found_and_nothing_else():
    first, second = pairs(101, 57)
    found = features.match(first, second, features.NearestNeighbourConfig())
    common = found[(found[:, 0] < 101) & (found[:, 1] < 101)]
    assert len(common) == 101
    np.testing.assert_array_equal(common.sum(1), np.full(101, 100))
    assert len(found) < 101 + 15


@pytest.mark.parametrize("sizes", [(2, 2), (3, 130), (97, 33), (260, 259)])
@pytest.mark.parametrize("instruction_set", instruction_sets())
def test_it_equals_brute_force(sizes, instruction_set):
    first, second = descriptors(sizes[0], 0), descriptors(sizes[1], 1)
    nearest, score, second_score = (np.empty(sizes[0], np.int32) for _ in range(3))
    back = np.empty(sizes[1], np.int32)
    arrays = (nearest, score, second_score, back)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (first, second, *arrays)]
    library(instruction_set).core_match(pointers[0], sizes[0], pointers[1], sizes[1], *pointers[2:])
    products = first.astype(np.int64) @ second.astype(np.int64).T
    half_norms1, half_norms2 = ((d.astype(np.int64) ** 2).sum(1) // 2 for d in (first, second))
    scores = 16320 - half_norms2 + products
    np.testing.assert_array_equal(nearest, scores.argmax(1))
    np.testing.assert_array_equal(score, scores.max(1))
    np.testing.assert_array_equal(second_score, np.sort(scores, axis=1)[:, -2])
    np.testing.assert_array_equal(back, (products - half_norms1[:, None]).argmax(0))


@pytest.mark.parametrize("sizes", [(0, 5), (5, 0), (1, 1), (3, 130), (97, 33), (260, 259)])
@pytest.mark.parametrize("reach", [7.0, 40.0, 1000.0])
@pytest.mark.parametrize("instruction_set", instruction_sets())
def test_nearby_it_equals_brute_force(sizes, reach, instruction_set):
    first, second = descriptors(sizes[0], 0), descriptors(sizes[1], 1)
    draw = np.random.default_rng(2)
    at1, at2 = (draw.uniform(-50, [250, 150], (count, 2)).astype(np.float32) for count in sizes)
    nearest, score, second_score = (np.empty(sizes[0], np.int32) for _ in range(3))
    back = np.empty(sizes[1], np.int32)
    given = first, at1, sizes[0], second, at2, sizes[1], ctypes.c_float(reach), nearest, score, second_score, back
    library(instruction_set).core_match_near(
        *(ctypes.c_void_p(each.ctypes.data) if isinstance(each, np.ndarray) else each for each in given)
    )
    products = first.astype(np.int64) @ second.astype(np.int64).T
    half_norms1, half_norms2 = ((d.astype(np.int64) ** 2).sum(1) // 2 for d in (first, second))
    near = ((at1[:, None] - at2[None]) ** 2).sum(2) < reach**2
    scores = np.pad(np.where(near, 16320 - half_norms2 + products, 0), ((0, 0), (0, 2)))
    backward = np.pad(np.where(near, products - half_norms1[:, None] + 16320, 0), ((0, 1), (0, 0)))
    np.testing.assert_array_equal(nearest, np.where(near.any(1), scores.argmax(1), -1))
    np.testing.assert_array_equal(score, scores.max(1))
    np.testing.assert_array_equal(second_score, np.sort(scores, axis=1)[:, -2])
    np.testing.assert_array_equal(back, np.where(near.any(0), backward.argmax(0), -1))


def test_matches_nearby_are_those_of_all_where_all_are_near():
    first, second = pairs(101, 57)
    config = features.NearestNeighbourConfig()
    places = [np.random.default_rng(0).uniform(0, 100, (len(each), 2)) for each in (first, second)]
    found = features.match_near(first, places[0], second, places[1], 200.0, config)
    np.testing.assert_array_equal(found, features.match(first, second, config))
    far = features.match_near(first, places[0], second, places[1] + 1000.0, 200.0, config)
    assert far.shape == (0, 2)


@pytest.mark.parametrize("points", [np.zeros((3, 2)), np.full((4, 2), np.nan), np.zeros((4, 3))])
def test_what_is_no_place_is_refused(points):
    four = descriptors(4, 0)
    with pytest.raises(ValueError, match="finite"):
        features.match_near(four, points, four, np.zeros((4, 2)), 1.0, features.NearestNeighbourConfig())
    with pytest.raises(ValueError, match="reach"):
        features.match_near(four, np.zeros((4, 2)), four, np.zeros((4, 2)), 0.0, features.NearestNeighbourConfig())


def test_the_most_distinct_matches_come_first():
    first, second = pairs(60, 40, noise=0.08)
    found = features.match(first, second, features.NearestNeighbourConfig(ratio=1.0))
    squared = ((first[:, None].astype(int) - second[None].astype(int)) ** 2).sum(2)
    two_nearest = np.sort(squared[found[:, 0]], axis=1)[:, :2]
    ratios = two_nearest[:, 0] / two_nearest[:, 1]
    assert (np.diff(ratios) > -1e-3).all()


def test_products_of_the_largest_descriptors_do_not_overflow():
    even = np.full((2, 128), 1.0 / np.sqrt(128.0), np.float32)
    peak = np.zeros((2, 128), np.float32)
    peak[:, :2] = np.sqrt(0.5)
    for kind in (even, peak):
        bytes_ = features.quantise(kind)
        assert np.linalg.norm(bytes_.astype(float), axis=1).max() <= 181.0
        assert len(features.match(bytes_, bytes_, features.NearestNeighbourConfig())) == 0  # no nearest is distinct


def test_too_few_descriptors_give_no_match():
    assert features.match(descriptors(1, 0), descriptors(9, 1), features.NearestNeighbourConfig()).shape == (0, 2)


@pytest.mark.parametrize("wrong", [np.zeros((4, 64), np.uint8), np.zeros((4, 128), np.float32)])
def test_what_is_no_descriptor_is_refused(wrong):
    with pytest.raises(ValueError, match="uint8"):
        features.match(wrong, descriptors(4, 0), features.NearestNeighbourConfig())


@pytest.mark.parametrize(
    "wrong",
    [
        np.full(128, 255),
        np.full(128, 127),
        np.full(128, 17),
        np.array([0] * 127 + [128]),
        np.array([127] * 3 + [0] * 125),
    ],
)
@pytest.mark.parametrize("first", [False, True])
def test_descriptors_whose_products_overflow_are_refused(wrong, first):
    """Longer than 181, or with a byte that the core would take for a negative one."""
    good, bad = descriptors(40, 0), descriptors(40, 1)
    bad[23] = wrong
    config, places = features.NearestNeighbourConfig(), np.zeros((40, 2))
    pair = (bad, good) if first else (good, bad)
    with pytest.raises(ValueError, match="bytes below 128 and norms of at most 181"):
        features.match(*pair, config)
    with pytest.raises(ValueError, match="bytes below 128 and norms of at most 181"):
        features.match_near(pair[0], places, pair[1], places, 1.0, config)


def test_the_longest_descriptors_are_matched():
    longest = np.zeros((3, 128), np.uint8)
    longest[0, :2], longest[1, :121], longest[2, 5] = (127, 127), 16, 127
    found = features.match(longest, longest, features.NearestNeighbourConfig())
    assert sorted(map(tuple, found.tolist())) == [(0, 0), (1, 1), (2, 2)]


@pytest.mark.parametrize("far", [3e38, 1e30, 1e-38])
def test_places_at_the_ends_of_their_type_are_places(far):
    four = descriptors(4, 0)
    places = np.array([[-far, 0.0], [far, -far], [0.0, far], [far / 3, 0.0]])
    found = features.match_near(four, places, four, places, 1.0, features.NearestNeighbourConfig())
    assert len(found) == 4 or far < 1
