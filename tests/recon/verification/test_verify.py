"""Evidence for and against the registration of a known place: as it is, and with one camera or lens made wrong."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import registration
from splatnode.recon.registration.registration import Registration
from splatnode.recon.result.verdict import find_widest
from splatnode.recon.verification import error_model
from splatnode.recon.verification import evidence as verification_evidence
from splatnode.recon.verification.error_model import predict_bounds
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.fitted import FITTED
from tests.support.synthetic import photographs, renumbered, view_graph

CONFIG = verification_evidence.VerificationConfig()
VIEWS = 4


@lru_cache(maxsize=1)
def placed() -> tuple[ViewGraph, Registration]:
    """Four photographs, registered."""
    graph = view_graph(photographs()[:VIEWS])
    found = registration.register(graph.keyframes, graph.pairs, registration.RegistrationConfig())
    assert found is not None and len(found.cameras) == VIEWS
    return graph, found


@lru_cache(maxsize=1)
def good() -> Evidence:
    found = verification_evidence.verify(*placed(), CONFIG)
    assert found is not None
    return found


def turned(degrees: float, index: int = 1) -> Registration:
    """The registration with one camera turned about the middle of what it sees, and its points moved along."""
    _, found = placed()
    camera = found.cameras[index]
    turn = cv2.Rodrigues(np.radians(degrees) * np.array([0.3, 0.9, 0.3]))[0]
    middle = camera.T_world_camera @ np.array([0.0, 0.0, 1.0, 1.0])
    T_world_camera = camera.T_world_camera.copy()
    T_world_camera[:3, :3] = T_world_camera[:3, :3] @ turn
    T_world_camera[:3, 3] = middle[:3] - T_world_camera[:3, 2]
    wrong = replace(camera, T_world_camera=T_world_camera)
    return replace(found, cameras=(*found.cameras[:index], wrong, *found.cameras[index + 1 :]))


def test_a_right_answer_has_evidence_from_every_source():
    evidence = good()
    odds = error_model.compute_log_odds(evidence, FITTED.many.claims, FITTED.many.odds)
    assert odds.total > 1.5
    assert evidence.inlier_ratio > 0.9 and evidence.weakest_link.shared_points > 100
    assert all(camera.confirmed > 50 and not camera.own_lens for camera in evidence.cameras)
    bounds = find_widest(predict_bounds(evidence, FITTED.many.claims).values())
    assert (
        bounds is not None and bounds.rotation_deg < 2.0 and bounds.centre_percent < 2.0 and bounds.focal_percent < 20.0
    )
    assert evidence.mirrored_cost > 3.0
    assert evidence.cycles.triangles >= 3 and evidence.cycles.rotation_deg < 2.0
    assert all(abs(camera.gain - 1.0) < 0.1 for camera in evidence.cameras)
    assert evidence.disconnected == () and evidence.flatness < 0.95
    assert evidence.freed == () and evidence.distortion.corner_shift < 0.02


@pytest.mark.filterwarnings("error")
def test_where_no_camera_is_further_those_that_are_known_keep_their_evidence():
    again = verification_evidence.verify_further(*placed(), good(), CONFIG)
    assert again is not None
    assert [camera.gain for camera in again.cameras] == [camera.gain for camera in good().cameras]


def test_the_larger_uncertainty_of_a_focal_length_counts():
    graph, found = placed()
    for known, continued in ((0.01, 0.05), (0.05, 0.01), (np.nan, 0.01), (0.01, np.nan)):
        before = [replace(camera, focal=replace(camera.focal, sigma=known)) for camera in good().cameras]
        after = [replace(camera, focal_sigma=continued) for camera in found.cameras]
        seen = verification_evidence.verify_further(
            graph, replace(found, cameras=tuple(after)), replace(good(), cameras=tuple(before)), CONFIG
        )
        assert seen is not None
        for camera in seen.cameras:
            assert np.array_equal(camera.focal.sigma, np.maximum(known, continued), equal_nan=True)
        assert np.array_equal(seen.focal.sigma, np.maximum(known, continued), equal_nan=True)


def test_one_camera_confirms_nothing():
    graph, found = placed()
    assert verification_evidence.verify(graph, replace(found, cameras=found.cameras[:1]), CONFIG) is None
    assert verification_evidence.verify(graph, None, CONFIG) is None


def test_two_places_that_share_no_points_are_found_as_two_parts():
    graph, found = placed()
    first = found.observed_by < 2
    seen_by_first = np.isin(found.observed_point, np.unique(found.observed_point[first]))
    kept = first | ~seen_by_first
    apart = replace(
        found,
        observed_by=found.observed_by[kept],
        observed_point=found.observed_point[kept],
        observed_pixels=found.observed_pixels[kept],
    )
    link = verification_evidence.measure_weakest_link(apart, graph.names, graph.pairs)
    assert link.shared_points == 0 and link.smaller_part in (tuple(graph.names[:2]), tuple(graph.names[2:]))


def test_points_shared_by_two_frames_are_counted():
    _, found = placed()
    few = replace(
        found,
        points=np.zeros((3, 3)),
        observed_by=np.array([0, 1, 2, 0, 1, 3]),
        observed_point=np.array([0, 0, 0, 1, 1, 2]),
    )
    shared = verification_evidence.count_shared_points(few)
    assert shared[0, 1] == 2 and shared[0, 2] == 1 and shared[0, 3] == 0


def test_frames_that_pairs_contradict_are_disconnected():
    graph, found = placed()
    assert verification_evidence.find_disconnected_frames(found, graph.pairs) == ()
    doubted = {key: 0.4 if 3 in key else share for key, share in found.inlier_ratios.items()}
    assert verification_evidence.find_disconnected_frames(replace(found, inlier_ratios=doubted), graph.pairs) == (3,)


def test_the_share_of_points_on_a_plane():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.ones(300)])
    assert verification_evidence.compute_share_on_plane(wall) == 1.0
    relief = wall + (0.0, 0.0, 1.0) * rng.choice([0.0, 0.2], (300, 1), p=[0.7, 0.3])
    assert verification_evidence.compute_share_on_plane(relief) == pytest.approx(0.7, abs=0.06)
    assert verification_evidence.compute_share_on_plane(wall[:2]) == 0.0


def test_pieces_that_were_shifted_as_wholes_are_told_from_a_camera_that_moved():
    """Two pieces of one photograph, each elsewhere in the other one, look like two walls before a camera beside it."""
    first, second = (frame.image for frame in photographs()[:2])
    montage = second[::-1, ::-1].copy()  # all else is of nothing that the first shows
    montage[:120, :290], montage[120:, :312] = first[:120, 30:], first[120:, 8:]
    assert measure_share([first, montage]) > 0.95
    third = second[:, ::-1].copy()
    third[:120, 40:], third[120:, 14:] = first[:120, :280], first[120:, :306]
    assert measure_share([first, montage, third]) > 0.95
    assert measure_share([first, second]) < 0.2
    aside = np.roll(first, (3, 7), axis=(0, 1))
    assert measure_share([first, aside]) == 0.0  # one shift: nothing moved but the crop
    graph, found = placed()
    assert verification_evidence.measure_shifted_share(graph.keyframes, found) < 0.2


def measure_share(images: list[np.ndarray]) -> float:
    graph = view_graph(renumbered(images))
    found = registration.register(graph.keyframes, graph.pairs, registration.RegistrationConfig())
    assert found is not None
    return verification_evidence.measure_shifted_share(graph.keyframes, found)
