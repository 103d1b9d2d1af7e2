"""The landmarks are points of the scene, each with what it looks like, and few enough to be kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.recon.geometry import project
from splatnode.recon.locating import localize as locating_landmarks
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.located import PLACE, known_place


def test_landmarks_lie_on_the_surfaces_that_their_photographs_show_as_nearly_as_they_say():
    place = known_place()
    landmarks, back = place.landmarks, place.to_scene.inverse()
    off, over_sigma = [], []
    for photograph, (T_world_camera, K) in enumerate(synthetic.scene_cameras(PLACE)):
        own = landmarks.point_of[landmarks.photograph_of == photograph]
        in_camera = (back(landmarks.points[own]) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        column, row = np.clip(project(in_camera, K).astype(int), 0, [PLACE.width - 1, PLACE.height - 1]).T
        error = np.abs(in_camera[:, 2] - synthetic.depth(PLACE, photograph)[row, column])
        ray = place.to_scene.rotation @ T_world_camera[:3, 2]
        off.append(error / in_camera[:, 2])
        over_sigma.append(error * place.to_scene.scale / np.sqrt(ray @ landmarks.covariances[own] @ ray))
    assert np.median(np.concatenate(off)) < 0.01
    assert 0.2 < np.median(np.concatenate(over_sigma)) < 3.0  # .67 of a normal distribution; cameras are not exact
    assert landmarks.names == tuple(synthetic.frame_name(index) for index in range(PLACE.views))


def test_no_more_descriptors_are_kept_than_may_be_and_every_photograph_has_some(monkeypatch):
    estimate = known_place().estimate
    assert estimate.registration is not None
    monkeypatch.setattr(locating_landmarks, "DESCRIPTORS_A_PHOTOGRAPH", 100)
    few = locating_landmarks.collect_landmarks(estimate.graph, estimate.registration, estimate.bounds)
    assert 400 < len(few.descriptors) <= 600 and len(few.points) <= len(few.descriptors) // 2
    assert (np.bincount(few.photograph_of, minlength=PLACE.views) > 40).all()
    assert set(few.point_of.tolist()) == set(range(len(few.points)))


def shown(cameras: tuple[CameraEstimate, ...]) -> Snapshot:
    verdict = Verdict(Code.OK, "", "", publishable=True)
    return Snapshot(1, verdict, cameras, GaussianArrays.empty(), {}, (), 1)


def test_a_scene_that_grew_in_another_world_has_its_landmarks_there():
    place = known_place()
    cameras = []
    for name, T_world_camera in zip(place.landmarks.names, place.landmarks.Ts_world_camera, strict=True):
        moved = T_world_camera.copy()
        moved[:3, 3] = 3.0 * moved[:3, 3] + [1.0, 0.0, -2.0]
        cameras.append(CameraEstimate(name, 0, moved, np.eye(3), 9, 9))
    made = add_landmarks(shown(tuple(cameras)), place.estimate)
    assert made.landmarks is not None
    assert np.allclose(made.landmarks.points, 3.0 * place.landmarks.points + [1.0, 0.0, -2.0])
    assert add_landmarks(shown(tuple(cameras[:1])), place.estimate).landmarks is None
    assert add_landmarks(shown(tuple(cameras)), None).landmarks is None


def test_a_refused_estimate_has_none():
    estimate = known_place().estimate
    refused = replace(estimate, verdict=replace(estimate.verdict, publishable=False))
    assert refused.landmarks is None and refused.summary_to_save.landmarks is None


def test_the_bounds_of_the_focal_lengths_are_those_of_the_cameras():
    place = known_place()
    bounds = [place.estimate.bounds[name].focal_percent for name in place.landmarks.names]
    assert place.landmarks.focal_bounds is not None and np.allclose(place.landmarks.focal_bounds, bounds)
