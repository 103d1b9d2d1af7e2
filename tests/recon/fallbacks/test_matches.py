"""Each fallback by itself: what it adds, and to which pairs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.fallbacks import AFFINE_SIMULATION, FALLBACKS, LEARNED_MATCHES, FallbackState, find_weak_pairs
from splatnode.recon.matching.view_graph import ViewGraph
from tests.support.synthetic import photographs, renumbered, view_graph

_NARROWER = 4.0  # as a wall seen from 75 degrees aside is


@pytest.fixture(scope="module")
def far_aside() -> ViewGraph:
    """A photograph, one from beside it, and the first one as narrow as a wall that is seen from far aside."""
    first, second = (frame.image for frame in photographs()[:2])
    height, width = first.shape[:2]
    size = (round(width / _NARROWER), height)
    blurred = cv2.GaussianBlur(first, (0, 0), sigmaX=0.8 * np.sqrt(_NARROWER**2 - 1), sigmaY=0.01)
    narrow = np.full_like(first, 127)
    narrow[:, : size[0]] = cv2.resize(blurred, size, interpolation=cv2.INTER_AREA)
    return view_graph(renumbered([first, second, narrow]))


def test_stronger_tilts_connect_what_nothing_else_does(far_aside):
    assert set(far_aside.pairs) == {(0, 1)}
    *_, after = AFFINE_SIMULATION.extend(FallbackState(far_aside, ReconstructionConfig()), {far_aside.names[2]})
    assert (0, 2) in after.graph.pairs
    np.testing.assert_array_equal(after.graph.pairs[0, 1].matches, far_aside.pairs[0, 1].matches)
    assert set(far_aside.keyframes[2].features.tilt) <= {1.0, 1.6}  # a graph is a value


def test_only_weak_pairs_of_doubtful_keyframes_are_matched_further(far_aside):
    assert {frozenset(pair) for pair in find_weak_pairs(far_aside, {far_aside.names[2]})} == {
        frozenset((0, 2)),
        frozenset((1, 2)),
    }
    assert find_weak_pairs(far_aside, set()) == []


def test_tilting_costs_what_there_is_to_do(far_aside):
    both = {far_aside.names[2]}
    *_, once = AFFINE_SIMULATION.extend(FallbackState(far_aside, ReconstructionConfig()), both)
    *_, twice = AFFINE_SIMULATION.extend(once, both)
    assert once.cost > 0.2  # three photographs of 1000 x 750 pixels are tilted, and compared
    assert 0.0 < twice.cost - once.cost < 0.5 * once.cost  # and then compared alone
    first = next(iter(AFFINE_SIMULATION.extend(FallbackState(far_aside, ReconstructionConfig()), both)))
    assert 0.0 < first.cost < once.cost


def test_a_network_without_weights_says_how_to_get_them(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    assert LEARNED_MATCHES.unavailable_reason() in (
        "no weights: splatnode weights fetch xfeat_640x640",
        "pip install onnxruntime",
    )


def test_the_table_names_each_fallback_once():
    names = [fallback.name for fallback in FALLBACKS]
    assert len(set(names)) == len(names) and {AFFINE_SIMULATION.name, LEARNED_MATCHES.name} <= set(names)
