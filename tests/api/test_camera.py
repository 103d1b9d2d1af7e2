"""A camera as a program sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.api.result import camera_of
from splatnode.capture.frame import Intrinsics
from splatnode.recon.result.snapshot import CameraEstimate


def test_a_lens_that_was_given_counts_before_one_that_was_estimated():
    estimated = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0, "estimated", (-0.1, 0.0, 0.0, 0.0))
    given = Intrinsics(640, 480, 590.0, 590.0, 320.0, 240.0, "given")
    K = estimated.resized(320, 240).K
    camera = CameraEstimate("a.png", 0, np.eye(4), 0.95 * K, 320, 240, lens=estimated)
    assert camera_of(camera).lens == estimated and camera_of(camera, given).lens == given
    assert camera_of(replace(camera, lens=None)).lens is None
    np.testing.assert_allclose(camera.K_photographed, K)
