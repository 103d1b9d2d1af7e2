"""Priors that invent: whatever a learned matcher says, the photographs have the last word.

Each lie is told about photographs of three unrelated places, of nothing (noise), and of one pattern that repeats; it is
as good as lies can be, with matches that agree with one set of cameras to a fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import msgspec
import numpy as np
import pytest
from scipy.spatial import KDTree

from splatnode.capture.frame import Frame
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.matching import features
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.pair_matching import matches_look_alike
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.verification.decision import DecisionConfig, decide, refuse_before_registration
from splatnode.recon.verification.evidence import VerificationConfig, verify
from tests.support.synthetic import SMALL, photographs, places, renumbered, view_graph

WIDTH, HEIGHT = 192, 144
SETTINGS = matching.MatchingConfig(features=features.FeatureConfig(max_num_features=500, min_longer_side=WIDTH))
FOCAL = 180.0
GRID = np.stack(np.meshgrid(np.arange(6.0, WIDTH, 7.0), np.arange(6.0, HEIGHT, 7.0)), -1).reshape(-1, 2)


@cache
def invented(index: int) -> np.ndarray:
    """(M, 2) where camera `index` of an arc sees the points of a surface with depth, which camera 1 sees on a grid."""
    rays = (GRID - [WIDTH / 2, HEIGHT / 2]) / FOCAL
    depth = 4.0 + np.sin(2.0 + 5.0 * rays[:, 0]) + np.cos(4.0 * rays[:, 1])
    points = np.column_stack([rays * depth[:, None], depth])
    angle = 0.15 * (index - 1)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    seen = (points - [0, 0, 4.0]) @ turn.T + [0, 0.1 * index, 4.0]
    return FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]


@dataclass(frozen=True)
class SurfaceLiar:
    """Points of a surface that is not there, exactly where cameras on an arc would see them; "flat": all the same."""

    flat: bool = False

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        known = keyframe.features
        if len(known.points) >= len(GRID) and (known.points[-len(GRID) :] == self._seen(keyframe)).all():
            return keyframe
        points = np.concatenate([known.points, self._seen(keyframe)])
        return replace(keyframe, features=Features(points, known.descriptors, known.point_of, known.tilt))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> np.ndarray:
        first, second = (len(keyframe.features.points) - len(GRID) for keyframe in (keyframe1, keyframe2))
        return np.stack([first + np.arange(len(GRID)), second + np.arange(len(GRID))], 1)

    def _seen(self, keyframe: Keyframe) -> np.ndarray:
        return GRID if self.flat else invented(keyframe.frame.frame_id)


class SnappingLiar:
    """Detected features that happen to lie where the invented surface would be seen: nothing is made up but pairs."""

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> np.ndarray:
        found = []
        for keyframe in (keyframe1, keyframe2):
            distance, nearest = KDTree(keyframe.features.points).query(invented(keyframe.frame.frame_id))
            found.append(np.where(distance < 2.5, nearest, -1))
        both = (found[0] >= 0) & (found[1] >= 0)
        return np.unique(np.stack([found[0][both], found[1][both]], 1), axis=0)


def unrelated() -> list[Frame]:
    return places(msgspec.structs.replace(SMALL, views=3, width=WIDTH, height=HEIGHT), seeds=(0, 1, 2))


def noise() -> list[Frame]:
    rng = np.random.default_rng(0)
    return renumbered(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for _ in range(3))


def repeating() -> list[Frame]:
    """One tile over and over, at another offset in each frame, with its own grain."""
    rng = np.random.default_rng(1)
    tile = photographs(msgspec.structs.replace(SMALL, views=3, width=WIDTH, height=HEIGHT))[0].image[40:64, 60:92]
    wall = np.tile(tile, (10, 10, 1)).astype(np.float64)
    offsets = ((0, 0), (9, 17), (15, 3))
    cuts = (wall[y : y + HEIGHT, x : x + WIDTH] for y, x in offsets)
    return renumbered(np.clip(cut + rng.normal(0, 2, cut.shape), 0, 255).astype(np.uint8) for cut in cuts)


LIARS = {"surface": SurfaceLiar(), "flat": SurfaceLiar(flat=True), "snapping": SnappingLiar()}


@pytest.mark.parametrize("photographed", [unrelated, noise, repeating])
@pytest.mark.parametrize("lie", LIARS)
def test_what_a_prior_invents_is_refused(lie, photographed):
    graph = view_graph(photographed(), LIARS[lie], SETTINGS)
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    evidence = verify(graph, registration, VerificationConfig())
    verdict = refuse_before_registration(graph, (), DecisionConfig()) or decide(
        graph, registration, evidence, DecisionConfig()
    )
    assert not verdict.publishable, verdict


def test_the_best_lie_looks_right_to_all_but_the_photographs(monkeypatch):
    """The invented matches fit one set of cameras: the test above would be void if their geometry refused them."""
    monkeypatch.setattr("splatnode.recon.matching.pair_matching.matches_look_alike", lambda *asked: True)
    graph = view_graph(noise(), SurfaceLiar(), SETTINGS)
    assert sorted(graph.pairs) == [(0, 1), (0, 2), (1, 2)]
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None and len(registration.cameras) == 3 and registration.rms_px < 1.0


def test_true_matches_look_alike_and_points_that_drifted_or_changed_places_do_not():
    graph = view_graph(photographs()[:2])
    first, second = graph.keyframes
    matches = graph.pairs[0, 1].matches
    assert matches_look_alike(first, second, matches) and matches_look_alike(first, second, matches[:40])
    assert not matches_look_alike(first, second, np.stack([matches[:, 0], np.roll(matches[:, 1], 17)], 1))
    assert not matches_look_alike(first, second, matches[:5])
