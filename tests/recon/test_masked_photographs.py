"""Masked garbage changes neither the cameras nor the rest of the scene, and none of it gets into the Gaussians."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.masks import apply_mask
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.estimation import prepare
from splatnode.recon.geometry import align_cameras
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.pipeline import run
from splatnode.recon.result.report import build_report, render_rgb
from tests.support.synthetic import SMALL, errors, photographs

CONFIG = apply_changes(preset("preview"), {"size": 320})
ROWS, MARGIN = 200, 30  # below this row lies what is hidden; so near to it held-out views show what it hides
HIDDEN = np.ones((SMALL.height, SMALL.width), bool)
HIDDEN[ROWS:] = False


def with_garbage(frame: Frame) -> Frame:
    """Magenta noise of another texture in each photograph, where the robot sees itself."""
    noise = np.random.default_rng(frame.frame_id).integers(0, 60, (SMALL.height - ROWS, SMALL.width, 3))
    image = frame.image.copy()
    image[ROWS:] = np.array([255, 60, 255]) - noise
    return replace(frame, image=image, encoded=None)


@lru_cache(maxsize=2)
def snapshot_of(hidden: bool):
    """Of the photographs, as they are or with masked garbage."""
    return run([apply_mask(with_garbage(each), HIDDEN) if hidden else each for each in photographs()], CONFIG)


def held_out_psnr(snapshot) -> float:
    """dB over the rows that no garbage is near to."""
    true = synthetic.scene_cameras(SMALL)
    known = np.stack([true[camera.frame_id][0] for camera in snapshot.cameras])
    similarity = align_cameras(known, np.stack([camera.T_world_camera for camera in snapshot.cameras]))
    K, found = snapshot.cameras[0].K, []
    for camera in synthetic.evaluation_cameras(SMALL):
        photograph = synthetic.render_image(SMALL, camera, 99) / 255.0
        shown = render_rgb(snapshot.gaussians, similarity.camera(camera[0]), K, SMALL.width, SMALL.height)
        found.append(((np.asarray(shown) - photograph) ** 2)[20 : ROWS - MARGIN].mean())
    return float(-10 * np.log10(np.mean(found)))


def test_masked_garbage_changes_neither_cameras_nor_the_rest_of_the_scene():
    clean, hidden = snapshot_of(False), snapshot_of(True)
    assert hidden.verdict.publishable and len(hidden.cameras) == SMALL.views
    before, after = errors(clean, SMALL), errors(hidden, SMALL)
    assert after.rotation_deg < before.rotation_deg + 0.03 and after.centre_pct < before.centre_pct + 0.1
    assert held_out_psnr(hidden) > held_out_psnr(clean) - 0.2


def test_no_garbage_is_in_the_scene():
    colours = 0.5 + 0.28209479 * snapshot_of(True).gaussians.sh[:, 0]
    magenta = (colours[:, 0] > 0.75) & (colours[:, 2] > 0.75) & (colours[:, 1] < 0.4)
    assert not magenta.any()


def test_the_report_has_the_share_that_is_hidden_of_each_photograph():
    report = build_report(snapshot_of(True), seed=0, preset="preview", peak_rss_mb=None)
    assert report["masked"] == {frame.name: pytest.approx(1 - ROWS / 240, abs=1e-3) for frame in photographs()}
    assert build_report(snapshot_of(False), seed=0, preset="preview", peak_rss_mb=None)["masked"] == {}


def test_no_feature_lies_on_or_near_what_is_hidden():
    keyframe = prepare(apply_mask(with_garbage(photographs()[0]), HIDDEN), CONFIG)
    margin = features.MASK_MARGIN * SMALL.width
    assert len(keyframe.features.points) > 500
    assert keyframe.features.points[:, 1].max() < ROWS - margin + 1
    assert keyframe.features.point_of.max() == len(keyframe.features.points) - 1


def test_a_pixel_of_the_modelled_image_is_used_if_all_that_it_covers_is():
    mask = np.ones((40, 60), bool)
    mask[7, 9] = False
    known = features.Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))
    keyframe = Keyframe(
        Frame(0, "a", 0, np.zeros((40, 60, 3), np.uint8), None, mask=mask), np.zeros((20, 30, 3)), known
    )
    assert keyframe.mask is not None and np.argwhere(~keyframe.mask).tolist() == [[3, 4]]


def test_a_program_gives_masks_as_arrays_and_none(tmp_path):
    frames = [with_garbage(each).image for each in photographs()]
    made = splatnode.reconstruct(
        frames, masks=[HIDDEN, *[HIDDEN.astype(np.uint8)] * 4, None], preset="preview", config={"size": 320}
    )
    made.save(tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert list(report["masked"]) == [f"{index:04d}.png" for index in range(5)]
    with pytest.raises(ValueError, match="one for each of the 6 photographs"):
        splatnode.reconstruct(frames, masks=[HIDDEN])
