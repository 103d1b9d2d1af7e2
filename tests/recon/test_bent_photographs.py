"""Photographs by a lens that bends lines and is not told: it is estimated, and the scene is that of a pinhole."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import undistort_image
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.pipeline import run
from splatnode.recon.result.report import render_rgb
from splatnode.recon.result.snapshot import Snapshot
from tests.support.synthetic import photographs

LENS = Intrinsics(240, 180, 225.0, 225.0, 120.0, 90.0, "calibration", (-0.12, 0.0, 0.0, 0.0))
BENT = synthetic.Config(views=5, width=240, height=180, lens=LENS)
CONFIG = apply_changes(preset("preview"), {"size": 240, "optimize": {"iterations": 40, "checkpoints": []}})


@lru_cache(maxsize=1)
def frames() -> tuple[Frame, ...]:
    return tuple(replace(frame, intrinsics=None) for frame in photographs(BENT))


def check(snapshot: Snapshot, most: float) -> None:
    """Its cameras know the lens, and renders differ from straight photographs at most by a share of what they differ
    from them as they were taken."""
    for camera in snapshot.cameras:
        lens = camera.lens
        assert lens is not None and abs(lens.distortion[0] + 0.12) < 0.04
        assert abs(camera.K_photographed[0, 0] / 225.0 - 1.0) < 0.03
        photograph = next(frame.image for frame in frames() if frame.name == camera.name)
        shown = snapshot.images[camera.name]
        assert np.abs(shown.astype(float) - undistort_image(photograph, lens)).mean() < 2.0  # resampled likewise
        render = 255.0 * render_rgb(snapshot.gaussians, camera.T_world_camera, camera.K, camera.width, camera.height)
        near, bent = (np.square(render - image).mean() for image in (shown, photograph))
        assert near < most * bent


def test_a_scene_of_all_photographs_is_that_of_a_pinhole():
    check(run(frames(), CONFIG), 0.5)


def test_a_scene_that_grows_keeps_its_photographs_straight():
    work = IncrementalReconstruction(CONFIG)
    for frame in frames()[:-1]:
        work.add_frame(frame)
    work.update()
    before = {view.name: view.lens for view in work.scene.views}
    assert all(lens is not None for lens in before.values())
    work.add_frame(frames()[-1])
    work.update()
    assert len(work.scene.views) == BENT.views
    check(work.snapshot(), 0.9)  # it is hardly refined
