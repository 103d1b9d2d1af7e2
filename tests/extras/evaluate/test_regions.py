"""Scores by region: only a region's own pixels count, and what shows a pixel follows from the true cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera
from splatnode.extras.evaluate.regions import (
    REGIONS,
    UNKNOWN,
    Surface,
    compute_error_maps,
    compute_region_scores,
    compute_surfaces,
    count_visibility,
)
from tests.support.synthetic import SMALL, photographs

K = np.array([[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]])


def wall(x: float = 0.0, z: float = 0.0, depth: float = 4.0) -> Surface:
    """A camera of 40 x 30 pixels that looks along z at a wall `depth` before it."""
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, z
    return Surface(pose, K, np.full((30, 40), depth, np.float32))


def test_a_pixel_counts_who_shows_it():
    counts = count_visibility(wall(), [wall(), wall(1.0), wall(2.0)])  # the wall is 4 wide: 1 is 10 pixels
    assert (counts[:, :10] == 1).all() and (counts[:, 10:] == 2).all()
    assert (count_visibility(wall(), []) == 0).all()


def test_what_stands_before_a_surface_hides_it():
    hiding = wall(depth=2.0)
    assert (count_visibility(wall(), [hiding]) == 0).all()
    assert (count_visibility(wall(depth=2.0), [wall()]) == 1).all()


def test_what_a_mask_hides_is_not_shown():
    used = np.ones((30, 40), bool)
    used[:, 20:] = False
    counts = count_visibility(wall(), [replace(wall(), used=used), wall(1.0)])
    assert (counts[:, :10] == 1).all() and (counts[:, 10:20] == 2).all() and (counts[:, 20:] == 1).all()


def test_a_pixel_without_depth_is_unknown_and_in_no_region():
    counts = count_visibility(wall(depth=0.0), [wall()])
    assert (counts == UNKNOWN).all()
    image = torch.rand(30, 40, 3)
    scores = compute_region_scores([compute_error_maps(image, image, counts, None)])
    assert all(scores[region].share_pct == 0 and scores[region].psnr is None for region in REGIONS)


def test_an_error_counts_only_in_its_own_region():
    counts = np.repeat(np.array([2, 1, 0, UNKNOWN], np.uint8), 16)[None].repeat(40, 0)
    truth = torch.full((40, 64, 3), 0.5)
    image = truth.clone()
    image[:, 34:46] += 0.1  # well within what nobody shows
    scores = compute_region_scores([compute_error_maps(image, truth, counts, None)])
    assert scores["two"].psnr == scores["one"].psnr == scores["shown"].psnr == 100
    assert scores["none"].psnr == pytest.approx(-10 * np.log10(0.01 * 12 / 16), abs=1e-4)
    assert (scores["shown"].share_pct, scores["two"].share_pct) == (50.0, 25.0)
    assert (scores["none"].ssim or 1) < 0.999 and scores["two"].lpips_alex is None


def test_counts_of_another_size_are_refused():
    image = torch.zeros(30, 40, 3)
    with pytest.raises(ValueError, match=r"counts must be \(30, 40\)"):
        compute_error_maps(image, image, np.zeros((30, 41), np.uint8), None)


def test_the_built_in_place_is_known_by_its_photographs(tmp_path):
    frames, true = photographs(), synthetic.scene_cameras(SMALL)
    paths, cameras = {}, {}
    for frame, (T_world_camera, K) in zip(frames, true, strict=True):
        paths[frame.name] = tmp_path / f"{frame.name}.png"
        paths[frame.name].write_bytes(encode_png(frame.image))
        cameras[frame.name] = TrueCamera(T_world_camera, K, SMALL.width, SMALL.height)
    found = compute_surfaces(EvaluationScene("built-in", paths, cameras), 320)
    assert set(found) == set(paths) and all(each.used is None for each in found.values())
    for index, surface in enumerate(found.values()):
        depth, known = synthetic.depth_map(SMALL, true[index]), surface.depth > 0
        off = np.abs(surface.depth[known] / depth[known] - 1)
        assert known.mean() > 0.6 and np.median(off) < 0.02
    views = list(found.values())
    counts = count_visibility(views[2], [views[1], views[3]])
    assert (counts == 2).mean() > 0.5  # neighbours show most of it


def test_what_a_mask_hides_shows_nothing(tmp_path):
    frames, true = photographs()[:4], synthetic.scene_cameras(SMALL)
    paths = {frame.name: tmp_path / f"{frame.name}.png" for frame in frames}
    masks = tmp_path / "masks"
    masks.mkdir()
    for frame in frames:
        paths[frame.name].write_bytes(encode_png(frame.image))
    hidden = np.full(frames[1].image.shape, 255, np.uint8)
    hidden[:, : SMALL.width // 2] = 0
    (masks / f"{frames[1].name}.png").write_bytes(encode_png(hidden))
    cameras = {
        f.name: TrueCamera(*camera, SMALL.width, SMALL.height) for f, camera in zip(frames, true[:4], strict=True)
    }
    found = compute_surfaces(EvaluationScene("built-in", paths, cameras, masks), 320)
    surface = found[frames[1].name]
    middle = surface.depth.shape[1] // 2
    assert surface.used is not None and not surface.used[:, :middle].any() and surface.used[:, middle:].all()
    assert (surface.depth[:, : middle - 20] == 0).all() and (surface.depth[:, middle:] > 0).mean() > 0.5
    assert all(found[frame.name].used is None for frame in (frames[0], *frames[2:]))
