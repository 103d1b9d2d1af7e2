"""Of a lens that bends lines more than its two coefficients can tell, nothing is published."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification import DecisionConfig
from splatnode.recon.verification.decision import STRONG, decide
from tests.support.verdicts import all_pairs, evidence, graph, registration

ALL = (0, 1, 2)


def verdict(radial: tuple[float, float], focal: float) -> Verdict:
    """Of three cameras of 64 x 48 pixels whose lens is such."""
    found = registration(ALL)
    lens = {"radial": np.array(radial), "focal": focal, "principal": np.array([32.0, 24.0])}
    cameras = tuple(replace(camera, **lens) for camera in found.cameras)
    return decide(graph(3, all_pairs(3)), replace(found, cameras=cameras), evidence(ALL), DecisionConfig())


def test_the_photographs_here_are_64_pixels_wide():
    frame = graph(3, all_pairs(3)).keyframes[0].frame
    assert (frame.width, frame.height) == (64, 48)


@pytest.mark.parametrize("radial", [(0.0, 0.0), (-0.2, 0.05), (-0.1, 0.0), (0.1, 0.0), (0.3, 0.05)])
def test_what_real_lenses_do_is_accepted(radial):
    assert verdict(radial, focal=50.0).publishable  # a corner is at a slope of .8


@pytest.mark.parametrize(
    "radial",
    [
        (-0.28, 0.076),  # a fisheye of 90 degrees, as it is estimated
        (-0.22, 0.04),  # one of 120 degrees
        (-0.5, 0.0),  # folds the picture over
        (0.8, 0.3),  # the corner is seen at three quarters of its distance
    ],
)
def test_what_a_fisheye_does_is_refused(radial):
    found = verdict(radial, focal=40.0)
    assert found.code is Code.FOCAL_SUSPECT
    assert f"more than {100 * STRONG:.0f} %" in found.message and "splatnode calibrate" in found.advice
