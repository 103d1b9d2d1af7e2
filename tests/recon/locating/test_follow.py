"""A photograph that follows one that was placed is placed as well, and looked for everywhere where it is not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.locating import Located, NotLocated
from splatnode.recon.locating import localize as following
from splatnode.recon.locating.localize import follow, localize_image
from tests.support.located import errors, known_place, photograph


def test_each_is_placed_by_the_one_before(monkeypatch):
    landmarks = known_place().landmarks
    found = localize_image(landmarks, photograph(0)[0])
    monkeypatch.setattr(following, "localize_image", lambda *_: None)  # the slow way is not needed
    for index in range(1, 5):
        image, camera = photograph(index)
        assert isinstance(found, Located)
        found = follow(landmarks, image, found)
        assert isinstance(found, Located)
        degrees, percent = errors(found, camera)
        assert degrees < 1.0 and percent < 1.0
        assert degrees <= found.claim.rotation_deg and percent <= found.claim.centre_percent


def test_one_that_was_taken_elsewhere_is_looked_for_everywhere():
    landmarks = known_place().landmarks
    image, camera = photograph(3)
    first = localize_image(landmarks, photograph(0)[0])
    assert isinstance(first, Located)
    behind = replace(first, T_world_camera=first.T_world_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    found = follow(landmarks, image, behind)
    assert isinstance(found, Located) and max(errors(found, camera)) < 1.0


def test_one_of_another_place_is_refused():
    landmarks = known_place().landmarks
    first = localize_image(landmarks, photograph(0)[0])
    assert isinstance(first, Located)
    assert isinstance(follow(landmarks, np.ascontiguousarray(photograph(1)[0][:, ::-1]), first), NotLocated)
