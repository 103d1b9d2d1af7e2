"""From outside of the far shell a scene is seen without it; from inside with it, wherever that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.snapshot import SHELL, GaussianArrays
from splatnode.viewer.shapes import cull_far_shell, paint_gaussians
from splatnode.viewer.state import ViewerState, look_at
from tests.viewer.test_scene import K

CENTRE, RADIUS = np.array([3.0, -1.0, 2.0]), 5.0


def surrounded() -> GaussianArrays:
    """A red ball in a green shell, more of which lies in front than behind."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1500, 3))
    directions[:700, 2] = abs(directions[:700, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = np.concatenate([CENTRE + rng.normal(0, 0.1, (50, 3)), CENTRE + RADIUS * directions])
    count = len(means)
    sh = np.full((count, 1, 3), -1.7)
    sh[:50, 0, 0], sh[50:, 0, 1] = 1.7, 1.7
    return GaussianArrays(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.4, np.float32),
        np.full(count, 0.99, np.float32),
        sh.astype(np.float32),
        np.where(np.arange(count) < 50, 0, SHELL).astype(np.int32),
    )


@pytest.mark.parametrize("share, all_of_it", [(0.0, True), (0.9, True), (1.1, False), (40.0, False)])
@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0.6, 0.8, 0)])
def test_the_shell_is_seen_from_inside_alone(share, all_of_it, direction):
    gaussians = surrounded()
    seen = cull_far_shell(gaussians, CENTRE + share * RADIUS * np.array(direction))
    assert len(seen) == (len(gaussians) if all_of_it else 50)


def test_a_scene_without_a_shell_is_seen_whole():
    gaussians = surrounded()
    for source in (0, SHELL):  # which is what files have that do not tell
        bare = replace(gaussians, source_frame=np.full(len(gaussians), source, np.int32))
        assert cull_far_shell(bare, CENTRE + 100.0) is bare
    assert len(cull_far_shell(GaussianArrays.empty(), CENTRE)) == 0


def test_the_picture_from_outside_shows_what_the_shell_surrounds():
    for away, colour in ((12.0, 0), (3.0, 0)):
        view = look_at(CENTRE - np.array([0, 0, away]), CENTRE, np.array([0.0, -1.0, 0.0]))
        image = paint_gaussians(surrounded(), view, K, ViewerState(), 100, 80).image
        assert image[40, 50].argmax() == colour and image[40, 50, colour] > 150
    assert image[2, 2].argmax() == 1  # from inside the shell is behind the ball
