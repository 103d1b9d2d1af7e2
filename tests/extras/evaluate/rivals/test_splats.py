"""The rivals that end in Gaussians, on the built-in place: each makes a scene that looks like its photographs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch

pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.protocol import psnr
from splatnode.extras.evaluate.rivals import cf_3dgs, colmap_3dgs, colmap_fsgs
from splatnode.extras.evaluate.rivals.colmap import reconstruct_sparse_model
from splatnode.recon.keyframes import resize_image
from splatnode.recon.optimize import training
from splatnode.recon.optimize.control import ControlChoice, adaptive, proximity
from splatnode.recon.result.report import render_rgb
from splatnode.recon.result.snapshot import Snapshot
from tests.support.synthetic import errors

PLACE = synthetic.Config(views=3, width=240, height=180)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(synthetic.stream(PLACE))


@pytest.fixture(scope="module")
def model(frames):
    found = reconstruct_sparse_model(frames, 0)
    assert found is not None
    return found


def short(config: training.RefinementConfig, iterations: int) -> training.RefinementConfig:
    """Without resets, from which opacities would have no time to come back."""
    adapting = adaptive.Config(every=20, start=0.0, reset_every=adaptive.NEVER)
    adapting = adapting if config.control.kind == "adaptive" else proximity.Config(adapting)
    control = ControlChoice(config.control.kind, adapting)
    return msgspec.structs.replace(config, iterations=iterations, checkpoints=(), control=control)


def training_psnr(snapshot: Snapshot, frames: Sequence[Frame]) -> float:
    of = {frame.name: frame.image for frame in frames}
    return float(
        np.mean(
            [
                psnr(
                    torch.from_numpy(render_rgb(snapshot.gaussians, c.T_world_camera, c.K, c.width, c.height)),
                    torch.from_numpy(resize_image(of[c.name], max(c.width, c.height))).float() / 255,
                )
                for c in snapshot.cameras
            ]
        )
    )


def last(snapshots: Iterator[Snapshot]) -> Snapshot:
    *_, final = snapshots
    assert final.final and final.verdict.publishable and len(final.cameras) == 3
    assert final.seconds["poses"] > 0 and final.seconds["optimise"] > 0
    return final


def test_a_model_s_world_is_its_first_camera_at_a_depth_of_1(model):
    assert np.allclose(model.registered[0].T_world_camera, np.eye(4))
    depths = [
        (model.points[seen] - each.T_world_camera[:3, 3]) @ each.T_world_camera[:3, 2]
        for each, seen in zip(model.registered, model.observed, strict=True)
    ]
    assert np.median(np.concatenate(depths)) == pytest.approx(1.0)


def test_3dgs_starts_from_colmap_s_points(model):
    scene = colmap_3dgs.initialize_scene(model, 0)
    assert len(scene.gaussians) == len(model.points)
    assert [view.name for view in scene.views] == [each.frame.name for each in model.registered]
    rates = colmap_3dgs.scale_rates_to_extent(colmap_3dgs.OPTIMIZE, scene).lr
    centres = np.stack([each.T_world_camera[:3, 3] for each in model.registered])
    spread = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    assert rates.means == pytest.approx(1.6e-4 * 1.1 * spread, rel=1e-5)


def test_colmap_s_rivals_tell_the_lens_whose_distortion_they_took_out(model):
    for each in model.registered:
        view = colmap_3dgs.make_training_view(each)
        assert any(each.intrinsics.distortion) and view.lens == each.intrinsics
        assert (
            colmap_3dgs.make_training_view(replace(each, intrinsics=replace(each.intrinsics, distortion=()))).lens
            is None
        )


def half_of(frame: Frame) -> np.ndarray:
    return np.tile(np.arange(frame.width) < frame.width // 2, (frame.height, 1))


def test_what_a_mask_hides_is_not_fitted_by_colmap_s_rivals(model):
    for each in model.registered:
        assert colmap_3dgs.make_training_view(each).mask is None
        view = colmap_3dgs.make_training_view(replace(each, frame=replace(each.frame, mask=half_of(each.frame))))
        assert view.mask is not None and view.mask.shape == view.image.shape[:2] and 0.4 < view.mask.mean() < 0.6


def test_what_a_mask_hides_is_neither_a_start_nor_fitted_by_cf_3dgs(frames):
    masked = [replace(frame, mask=half_of(frame)) if i == 1 else frame for i, frame in enumerate(frames)]
    known = methods.estimate_frame_depths(masked, 0)
    assert [each.mask is None for each in known] == [True, False, True]
    frame, T = known[1], np.eye(4)
    assert cf_3dgs._make_training_view(frame, T).mask is frame.mask
    config = cf_3dgs.Config()
    some, all_of_it = (cf_3dgs._initialize_from_depth(each, T, config) for each in (frame, replace(frame, mask=None)))
    assert 0.4 < len(some) / len(all_of_it) < 0.6


def test_fsgs_knows_the_depth_of_colmap_s_points(model):
    scene = colmap_fsgs.initialize_scene_with_depth(model, 0)
    for view, seen in zip(scene.views, model.observed, strict=True):
        T, K = view.T_world_camera.double().numpy(), view.K.double().numpy()
        points = (model.points[seen] - T[:3, 3]) @ T[:3, :3]
        columns, rows = (points @ K.T / points[:, 2:])[:, :2].astype(int).T
        depth = view.pointmap.depth[rows, columns]
        known = depth > 0
        assert known.mean() > 0.5
        assert np.median(np.abs(depth[known] / points[known, 2] - 1)) < 0.02


def test_colmap_3dgs_and_fsgs_look_like_the_photographs(frames):
    for method in (colmap_3dgs, colmap_fsgs):
        start, end = (last(method.reconstruct(frames, 0, short(method.OPTIMIZE, iterations))) for iterations in (1, 80))
        assert errors(end, PLACE).rotation_deg < 1.0
        assert end.served_by == ({"depth": "multi-view depth"} if method is colmap_fsgs else {})
        assert training_psnr(end, frames) > training_psnr(start, frames) + 1.0
        assert len(end.gaussians) != len(start.gaussians)


def test_cf_3dgs_finds_the_poses_of_a_film_frame_by_frame():
    film = synthetic.Config(views=8, width=200, height=150)
    frames = list(synthetic.stream(film))[:3]
    config = cf_3dgs.Config(alone=30, motion=160, growing=5, final=10, stride=2)
    end = last(cf_3dgs.reconstruct(frames, 0, config))
    found = errors(end, film)  # of turns of 14 and 20 degrees
    assert found.rotation_pair_deg < 2.0 and found.centre_pct < 8.0  # .3 to .6 degrees, 1.5 to 2.2 %
    assert training_psnr(end, frames) > 15.0


def test_frames_without_overlap_are_refused():
    rng = np.random.default_rng(0)
    noise = [Frame(i, f"{i}.png", i, rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), None) for i in range(3)]
    (only,) = colmap_3dgs.reconstruct(noise, 0)
    assert only.final and not only.verdict.publishable and only.cameras == ()
