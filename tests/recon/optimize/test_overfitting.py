"""Overfitting is seen between the photographs, where a scene is compared with what stereo shows there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec.structs import replace as replace_fields

from splatnode.recon import modelling
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.modelling import refine_scene
from splatnode.recon.optimize import training
from splatnode.recon.optimize.training import SHORT, RefinementWatch, examine, start_watch
from splatnode.recon.priors import Pointmap
from splatnode.recon.rasterize import Camera, render_gaussians
from splatnode.recon.result.verdict import Code
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from tests.recon.optimize.test_refinement import photographed, plain

SIZE = 64
K = torch.tensor([[64.0, 0.0, 32.0], [0.0, 64.0, 32.0], [0.0, 0.0, 1.0]])


def wall() -> Gaussians:
    """A wall at z = 2 of many colours, a Gaussian every 2 cm."""
    x, y = torch.meshgrid(torch.arange(-1.6, 2.0, 0.02), torch.arange(-1.2, 1.2, 0.02), indexing="xy")
    count = x.numel()
    means = torch.stack([x.flatten(), y.flatten(), torch.full((count,), 2.0)], 1)
    shade = torch.sin(9 * means[:, :1]) * torch.cos(7 * means[:, 1:2])
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.tensor([[0.012, 0.012, 0.001]]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 4.0),
        sh=(shade * torch.tensor([[1.0, 0.6, 0.3]]))[:, None],
        source_frame=torch.zeros(count, dtype=torch.int32),
    )


def view(x: float, frame_id: int, gaussians: Gaussians) -> TrainingView:
    T_world_camera = torch.eye(4)
    T_world_camera[0, 3] = x
    rgb = render_gaussians(gaussians, Camera(T_world_camera, K, SIZE, SIZE)).rgb
    assert rgb is not None
    image = (255 * rgb.clamp(0, 1)).round().byte().numpy()
    depth = np.full((SIZE, SIZE), 2.0, np.float32)
    normal = np.zeros((SIZE, SIZE, 3), np.float32)
    normal[..., 2] = -1.0
    matrices = T_world_camera.double().numpy(), K.double().numpy()
    pointmap = Pointmap(f"{frame_id}", frame_id, depth, np.ones_like(depth), normal, *matrices)
    return TrainingView(f"{frame_id}", frame_id, image, T_world_camera, K, pointmap)


@pytest.fixture(scope="module")
def truth() -> Scene:
    gaussians = wall()
    return Scene(tuple(view(x, i, gaussians) for i, x in enumerate((0.0, 0.2, 0.4))), gaussians)


def faded(scene: Scene, iterations: int) -> Scene:
    """Its colours are there, its places are not: each Gaussian is somewhere else along x."""
    moved = scene.gaussians.means + 0.15 * torch.randn(
        scene.gaussians.means.shape, generator=torch.Generator().manual_seed(0)
    )
    return replace(scene, gaussians=replace(scene.gaussians, means=moved), iterations=iterations)


def test_the_true_scene_meets_what_is_expected_between_its_photographs(truth):
    expected = training.make_expectations(truth)
    assert len(expected) == 2
    right = training.compute_dssim_misfit(expected, truth.gaussians)
    wrong = training.compute_dssim_misfit(expected, faded(truth, 0).gaussians)
    assert right < 0.2 and wrong > training.OVERFITTED * right


def test_without_point_maps_nothing_is_expected():
    scene = photographed()
    assert training.make_expectations(scene) == () and training.compute_dssim_misfit((), scene.gaussians) == 0.0


def test_an_overfitted_scene_gives_way_to_the_best_before_it(truth, monkeypatch):
    monkeypatch.setattr(
        "splatnode.recon.optimize.training.compute_photometric_misfit", lambda scene: 0.1
    )  # the photographs fit
    watching = start_watch(truth, SHORT + 1)
    better = replace(truth, iterations=150)
    watching, verdict = examine(replace(watching, best_misfit=2 * watching.best_misfit), better)
    assert verdict is None and watching.best is better
    watching, verdict = examine(watching, faded(truth, 500))
    assert verdict is not None and verdict.code is Code.OVERFIT and verdict.publishable
    assert watching.best is better and "500 iterations" in verdict.message and "after 150" in verdict.message


def test_a_scene_that_diverged_is_not_published_and_a_short_refinement_is_not_tested(truth):
    watching = start_watch(truth, SHORT)
    assert watching.expectations == ()
    _, verdict = examine(watching, faded(truth, 100))
    assert verdict is not None and verdict.code is Code.DIVERGED and not verdict.publishable
    _, verdict = examine(watching, truth)
    assert verdict is None


def test_the_refinement_ends_with_the_best_scene_and_the_verdict(truth, monkeypatch):
    monkeypatch.setattr(training, "OVERFITTED", 0.0)  # whatever comes is too much
    steps = plain(iterations=SHORT + 1, checkpoints=(training.MIN_SOFT,), first_opacity=None)
    (only,) = refine_scene(truth, replace_fields(ReconstructionConfig(), optimize=steps), steps)
    assert only.verdict is not None and only.verdict.code is Code.OVERFIT
    assert only.scene is not None and torch.equal(only.scene.gaussians.means, truth.gaussians.means)


def test_a_scene_that_started_soft_is_not_judged_before_it_shows_its_photographs(truth):
    steps = plain(iterations=training.MIN_SOFT, checkpoints=(2,))
    first, *_ = refine_scene(truth, replace_fields(ReconstructionConfig(), optimize=steps), steps)
    assert first.verdict is None and first.scene is not None and first.scene.iterations == 2
    assert first.scene.gaussians.opacities.max() < 0.15  # it is soft


def test_who_watches_changes_no_verdict(truth, monkeypatch):
    """A scene is judged after the same iterations, however often it is looked at."""
    judged: list[int] = []

    def noting(watching: RefinementWatch, later: Scene) -> tuple[RefinementWatch, None]:
        judged.append(later.iterations)
        return watching, None

    monkeypatch.setattr(modelling, "examine", noting)
    first = training.MIN_SOFT
    steps = plain(iterations=first + 20, checkpoints=(first,), looks=(first + 5, first + 10), first_opacity=None)
    shown = list(refine_scene(truth, replace_fields(ReconstructionConfig(), optimize=steps), steps))
    assert [show.scene.iterations for show in shown if show.scene] == [first, first + 5, first + 10, first + 20]
    assert judged == [first, first + 20]
