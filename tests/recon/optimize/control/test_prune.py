"""Pruning: what a Gaussian is worth, against leaving it out, and what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.recon.optimize.control import ControlChoice, OptimizerStep
from splatnode.recon.optimize.control.prune import Config, estimate_removal_changes, load, select_most_worthwhile
from splatnode.recon.optimize.photometric_losses import TrainingImage, make_training_image
from splatnode.recon.optimize.regularizers import sample_pseudo_views
from splatnode.recon.optimize.training import refine
from splatnode.recon.rasterize import Camera
from splatnode.recon.scene import Gaussians, Scene, TrainingView, concatenate
from splatnode.recon.scene.background import SHELL
from splatnode.recon.scene.initialization import visibility
from tests.recon.optimize.test_refinement import plain, render, truth  # noqa: F401  a fixture


def images_of(scene: Scene, scale: float = 1.0) -> list[TrainingImage]:
    return [make_training_image(view, np.ones(view.image.shape[:2], bool), scale, 0.2) for view in scene.views]


def cameras_of(scene: Scene, scale: float = 1.0) -> list[Camera]:
    images = zip(scene.views, images_of(scene, scale), strict=True)
    return [Camera(view.T_world_camera, each.K, each.width, each.height) for view, each in images]


def worth(scene: Scene, probes: int, scale: float = 1.0) -> torch.Tensor:
    return estimate_removal_changes(scene.gaussians, cameras_of(scene, scale), probes, torch.Generator().manual_seed(0))


def left_out(gaussians: Gaussians, view: TrainingView, index: int) -> float:
    """The squared visible difference to the picture without Gaussian `index`, as worth is counted."""
    others = gaussians.subset(torch.arange(len(gaussians)) != index)
    whole = render(gaussians, view)
    scale = max(view.width, view.height) / 512
    visible = torch.from_numpy(visibility(whole.numpy(), scale))[..., None]
    return float(((visible * (whole - render(others, view))) ** 2).sum()) / scale**2


def test_the_worth_of_a_gaussian_is_what_leaving_it_out_changes(truth):  # noqa: F811
    faint = replace(truth.gaussians, logit_opacities=truth.gaussians.logit_opacities - 1.0)  # no alpha is clamped
    scene = replace(truth, gaussians=faint)
    estimated = worth(scene, probes=64)
    exact = torch.tensor([sum(left_out(faint, view, i) for view in scene.views) for i in range(len(faint))])
    seen = exact > 1e-2 * exact.max()
    assert seen.sum() > 5
    torch.testing.assert_close(estimated[seen].log(), exact[seen].log(), rtol=0, atol=0.5)
    assert torch.equal(estimated[exact == 0], exact[exact == 0])


def test_photographs_of_another_size_are_worth_about_the_same(truth):  # noqa: F811
    ratio = worth(truth, 64, scale=0.5) / worth(truth, 64)
    assert 0.65 < float(ratio.nanmedian()) < 1.55  # 1.36


def test_of_too_many_the_best_are_kept_in_their_order():
    values = torch.tensor([0.5, 3.0, 0.1, 2.0, 9.0])
    assert select_most_worthwhile(values, 0.4, None).tolist() == [0, 1, 3, 4]
    assert select_most_worthwhile(values, 0.4, 2).tolist() == [1, 4]
    assert select_most_worthwhile(values, 0.4, 9).tolist() == [0, 1, 3, 4]


def pruned(scene: Scene, config: Config, limit: int | None = None) -> Scene:
    optimising = plain(iterations=4, control=ControlChoice("prune", config))
    return list(refine(scene, optimising, seed=0, max_gaussians=limit))[-1]


def test_what_no_photograph_shows_goes_and_the_far_shell_stays(truth):  # noqa: F811
    behind = replace(truth.gaussians, means=truth.gaussians.means - torch.tensor([0.0, 0.0, 1e3]))
    ids = torch.full((len(behind),), 77, dtype=torch.int32)
    unseen, shell = replace(behind, source_frame=ids), replace(behind, source_frame=0 * ids + SHELL)
    scene = replace(truth, gaussians=concatenate([unseen, truth.gaussians, shell]))
    found = pruned(scene, Config(least_change=1e-6)).gaussians.source_frame
    assert not (found == 77).any()
    assert (found == SHELL).sum() == len(shell)
    assert ((found != 77) & (found != SHELL)).sum() > len(truth.gaussians) / 2


def test_views_between_lie_near_the_path_and_are_no_photographs(truth):  # noqa: F811
    cameras = cameras_of(truth)
    centres = torch.stack([camera.T_world_camera[:3, 3] for camera in cameras])
    found = sample_pseudo_views(cameras, 6, off_path=0.0, rng=np.random.default_rng(0))
    assert len(found) == 6
    for view in found:
        away = (centres - view.camera.T_world_camera[:3, 3]).norm(dim=1)
        assert 0 < away.min() < 0.6 * torch.pdist(centres).max()
    assert sample_pseudo_views(cameras[:1], 3, off_path=0.0, rng=np.random.default_rng(0)) == []


@pytest.mark.parametrize("limit", [1, 7])
def test_a_limit_is_kept_to_the_one(truth, limit):  # noqa: F811
    assert len(pruned(truth, Config(), limit).gaussians) == limit


def test_it_is_done_once_when_it_is_due_however_fast_time_goes(truth):  # noqa: F811
    control = load(Config(at=(0.3, 0.6), least_change=0.0), seed=0)
    step = OptimizerStep(9, 9, 0.0, 0, truth.gaussians, [v.T_world_camera for v in truth.views], images_of(truth), None)
    changed = [
        control.after_step(replace(step, progress=progress)) is not None for progress in (0.2, 0.4, 0.5, 0.7, 0.95)
    ]
    assert changed == [False, True, False, True, False]
    late = load(Config(at=(0.3, 0.6)), seed=0)
    assert [late.after_step(replace(step, progress=progress)) is not None for progress in (0.65, 0.95)] == [True, False]


def test_in_a_hurry_it_waits_until_the_gaussians_are_fitted_unless_there_are_too_many(truth):  # noqa: F811
    def happens(iteration: int, limit: int | None, progress: float = 0.5) -> bool:
        scene = truth.gaussians, [v.T_world_camera for v in truth.views], images_of(truth), limit
        return load(Config(), seed=0).after_step(OptimizerStep(iteration, 500, progress, 0, *scene)) is not None

    assert not happens(30, None, 0.3) and happens(31, None, 0.3)
    assert not happens(3, len(truth.gaussians)) and happens(3, len(truth.gaussians) - 1)
    # There must be time for it and for what follows, unless there are too many.
    assert happens(60, None) and not happens(59, None) and not happens(200, None, 0.9)
    assert happens(200, len(truth.gaussians) - 1, 0.9)


def test_the_same_seed_prunes_the_same(truth):  # noqa: F811
    few = structs.replace(Config(), probes=1)
    first, second = (pruned(truth, few, 9).gaussians.means for _ in range(2))
    assert torch.equal(first, second)
