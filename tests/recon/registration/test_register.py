"""Registration of photographs of the built-in place, together with one that shows something else."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.view_graph import match
from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.registration import registration as registration_registration
from tests.support.synthetic import photographs, renumbered, view_graph


def test_the_lens_of_a_frame_that_is_left_out_makes_no_focal_length_uncertain():
    place = synthetic.Config(views=3, width=320, height=240)
    blank = np.full((200, 300, 3), 128, np.uint8)
    config, settings = registration_registration.RegistrationConfig(), matching.MatchingConfig()
    frames = [*synthetic.stream(place), Frame(3, "another size", 3, blank, None)]
    keyframes = [Keyframe(frame, frame.image, features.extract(frame.image, settings.features)) for frame in frames]
    graph = match(keyframes, settings)
    registration = registration_registration.register(graph.keyframes, graph.pairs, config)
    assert registration is not None and [camera.index for camera in registration.cameras] == [0, 1, 2]
    assert registration.focal_sigma < 0.5 * config.lenses.voted_sigma


@pytest.mark.parametrize("variance", [-1e-6, np.nan, np.inf])
def test_a_focal_length_without_a_variance_is_infinitely_uncertain(monkeypatch, variance):
    """The verdict refuses what is not finite."""
    graph = view_graph(photographs()[:3])
    covariance = bundle_adjustment.covariance

    def broken(*problem) -> bundle_adjustment.Covariance:
        found = covariance(*problem)
        return replace(found, log_focals=np.full_like(found.log_focals, variance))

    monkeypatch.setattr(bundle_adjustment, "covariance", broken)
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None and registration.focal_sigma == np.inf


def test_the_robots_own_body_in_the_picture_is_not_what_moves():
    """A bumper with much texture that stands still in every picture explains most matches, and says nothing."""
    bumper = np.random.default_rng(0).integers(0, 256, (60, 160, 3), np.uint8)
    bumper = cv2.resize(bumper, (320, 120), interpolation=cv2.INTER_CUBIC)
    images = [frame.image.copy() for frame in photographs()[:2]]
    for image in images:
        image[120:] = bumper
    graph = view_graph(renumbered(images))
    pair = graph.pairs[0, 1]
    motion = np.linalg.norm(pair.points2 - pair.points1, axis=1)
    assert len(motion) > 60 and np.median(motion) > 3.0
    assert (pair.points1[:, 1] < 0).mean() > 0.9  # above the middle of the image, where the bumper begins
