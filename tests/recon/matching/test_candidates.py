"""Which pairs are matched: all of a few keyframes, the likeliest of many, and more where these do not hold together."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from splatnode.recon.matching import pair_matching
from splatnode.recon.matching.pair_matching import Pair, select_pairs_worth_matching, select_short_list_pairs

CONFIG = pair_matching.PairSelectionConfig()
RING = 40  # keyframes around a place, each of which overlaps its neighbours


def distance(pair: Pair, size: int = RING) -> int:
    apart = abs(pair[0] - pair[1])
    return min(apart, size - apart)


def every(size: int) -> list[Pair]:
    return list(itertools.combinations(range(size), 2))


def completed(size: int, glanced: dict[Pair, int], firm: set[Pair], first: set[Pair] = frozenset()) -> tuple[set, set]:
    """The pairs that are worth it in the end, and those that were matched on the way, beginning with `first`."""
    matched = set(first)
    for _ in range(100):
        worth = select_pairs_worth_matching(size, glanced, matched.__contains__, firm.__contains__, CONFIG)
        if worth <= matched:
            return worth, matched
        matched |= worth
    raise AssertionError("it never ends")


def ring(reach: int = 6) -> tuple[dict[Pair, int], set[Pair]]:
    glanced = {pair: max(0, 100 - 10 * distance(pair)) for pair in every(RING)}
    return glanced, {pair for pair in every(RING) if distance(pair) <= reach}


def test_a_few_keyframes_are_all_matched():
    for size in (2, CONFIG.exhaustive):
        assert completed(size, {}, set())[0] == set(every(size))
        assert not select_short_list_pairs([np.ones(4, np.float32)] * size, CONFIG)


def test_many_are_matched_with_their_likeliest_partners():
    glanced, firm = ring()
    worth, matched = completed(RING, glanced, firm)
    assert worth == matched == {pair for pair in every(RING) if distance(pair) <= CONFIG.partners // 2}


def test_two_halves_that_look_unlike_are_matched_until_they_hold_together():
    """Two rings of which only keyframe 3 of the one and 17 of the other overlap, which no glance shows."""
    half = RING // 2
    same = {pair for pair in every(RING) if pair[0] // half == pair[1] // half}
    glanced = {pair: 50 - abs(pair[0] - pair[1]) if pair in same else 0 for pair in every(RING)}
    firm = {pair for pair in same if abs(pair[0] - pair[1]) <= 3} | {(3, half + 17)}
    worth, _ = completed(RING, glanced, firm)
    assert (3, half + 17) in worth


def test_a_keyframe_that_matches_nothing_is_matched_with_all():
    glanced, firm = ring()
    firm = {pair for pair in firm if 7 not in pair}
    worth, _ = completed(RING, glanced, firm)
    assert {pair for pair in every(RING) if 7 in pair} <= worth


def test_what_was_matched_before_changes_nothing_in_the_end():
    glanced, firm = ring()
    firm -= {pair for pair in firm if 7 in pair and distance(pair) > 1}
    generator = np.random.default_rng(0)
    expected, _ = completed(RING, glanced, firm)
    for _ in range(10):
        first = {pair for pair in every(RING) if generator.random() < 0.3}
        assert completed(RING, glanced, firm, first)[0] == expected


@pytest.mark.parametrize("size", [60, 120])
def test_the_work_grows_with_the_keyframes(size):
    """Codes on a circle: each keyframe's short list is those beside it."""
    angles = 2 * np.pi * np.arange(size) / size
    codes = [np.array([np.cos(angle), np.sin(angle)], np.float32) for angle in angles]
    pairs = select_short_list_pairs(codes, CONFIG)
    assert pairs == {pair for pair in every(size) if distance(pair, size) <= CONFIG.short_list // 2}
    glanced = {pair: 100 - distance(pair, size) for pair in pairs}
    firm = {pair for pair in every(size) if distance(pair, size) <= 5}
    assert len(completed(size, glanced, firm)[1]) == size * CONFIG.partners // 2
