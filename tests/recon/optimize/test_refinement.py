"""Refinement on a tiny scene whose answer is known: what was disturbed comes back, within the time that is given."""

from __future__ import annotations

import gc
import itertools
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.recon.optimize import ensemble, fit, regularizers, training
from splatnode.recon.optimize.fit import Trainer
from splatnode.recon.optimize.losses import LossChoice, normal
from splatnode.recon.optimize.regularizers import PseudoView
from splatnode.recon.optimize.training import LearningRates, RefinementConfig, limit_iterations, refine
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.snapshot import SHELL
from splatnode.recon.scene import Scene, TrainingView, initialization, logit
from tests.support.known_scene import disturbed, photographed, render, turned

FROZEN = LearningRates(means=0.0, quats=0.0, log_scales=0.0, logit_opacities=0.0, sh=0.0)


def plain(**changes: object) -> RefinementConfig:
    """A refinement that keeps all Gaussians in every render and to the end."""
    nothing = RefinementConfig(checkpoints=(), ssim_lambda=0.2, dropout=ensemble.DropoutConfig(share=0.0), control=None)
    return structs.replace(nothing, **changes)


QUICK = plain(iterations=12)
WITH_NORMALS = regularizers.RegularizerConfig({"normal": LossChoice("normal", normal.Config(1.0))})


@pytest.fixture(scope="module")
def truth() -> Scene:
    return photographed()


def last(scene: Scene, config: RefinementConfig, seed: int = 0, deadline: float | None = None) -> Scene:
    *_, end = refine(scene, config, seed=seed, deadline=deadline)
    return end


def loss(scene: Scene) -> float:
    """Mean absolute difference between photographs and renders."""
    differences = [
        (render(scene.gaussians, view) - torch.from_numpy(view.image).float() / 255).abs().mean()
        for view in scene.views
    ]
    return float(torch.stack(differences).mean())


def pose_error(scene: Scene, truth: Scene) -> float:
    """Largest difference of any camera's matrix, over all but the first."""
    pairs = zip(scene.views[1:], truth.views[1:], strict=True)
    return max(float((view.T_world_camera - true.T_world_camera).abs().max()) for view, true in pairs)


@pytest.mark.parametrize("half_resolution_share", [0.0, 0.3])
def test_disturbed_gaussians_come_back(truth, half_resolution_share):
    start = disturbed(truth)
    config = plain(iterations=240, half_resolution_share=half_resolution_share, refine_poses=False)
    assert loss(start) > 0.03
    assert loss(last(start, config)) < 0.3 * loss(start)


def test_disturbed_poses_come_back(truth):
    start = turned(truth)
    # Many steps: a ball in the middle of the image hardly tells a turn from a step to the side.
    rates = structs.replace(FROZEN, translation=3e-3, rotation=1e-3)
    found = last(start, plain(iterations=900, lr=rates))
    assert pose_error(start, truth) > 0.01
    assert pose_error(found, truth) < 0.15 * pose_error(start, truth)
    assert torch.equal(found.views[0].T_world_camera, truth.views[0].T_world_camera)
    for view in found.views:
        rotation = view.T_world_camera[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), rtol=0, atol=1e-5)


def test_poses_stay_where_they_are_not_to_be_refined(truth):
    start = turned(truth)
    assert pose_error(last(start, structs.replace(QUICK, refine_poses=False)), start) == 0
    assert pose_error(last(start, QUICK), start) > 0


def test_the_start_is_left_alone(truth):
    start = disturbed(truth)
    before = start.gaussians.map(torch.clone)
    poses = [view.T_world_camera.clone() for view in start.views]
    end = last(start, QUICK)
    assert torch.equal(start.gaussians.means, before.means) and torch.equal(start.gaussians.sh, before.sh)
    assert all(torch.equal(view.T_world_camera, pose) for view, pose in zip(start.views, poses, strict=True))
    assert not torch.equal(end.gaussians.means, before.means)
    assert not end.gaussians.means.requires_grad and not end.views[1].T_world_camera.requires_grad


def test_the_same_seed_gives_the_same_scene_to_the_bit_and_another_one_does_not(truth):
    start = disturbed(truth)
    first, again, other = (last(start, QUICK, seed=seed) for seed in (5, 5, 6))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(getattr(first.gaussians, name), getattr(again.gaussians, name))
    assert pose_error(first, again) == 0
    assert not torch.equal(first.gaussians.means, other.gaussians.means)


def test_the_scene_is_shown_at_every_checkpoint_and_at_the_end(truth):
    shown = refine(truth, plain(iterations=9, checkpoints=(2, 6, 9, 50)), seed=0)
    assert [scene.iterations - truth.iterations for scene in shown] == [2, 6, 9]


def test_a_checkpoint_keeps_what_it_showed(truth):
    shown = refine(truth, plain(iterations=4, checkpoints=(2,)), seed=0)
    first = next(shown)
    means = first.gaussians.means.clone()
    list(shown)
    assert torch.equal(first.gaussians.means, means)


@pytest.mark.parametrize(("share", "iterations"), [(0.1, 200), (0.45, 350), (0.8, 500), (None, 500)])
def test_a_scene_of_which_views_confirm_little_gets_fewer_iterations(truth, share, iterations):
    scene = replace(truth, views=tuple(replace(view, consistent_depth=share) for view in truth.views))
    assert limit_iterations(plain(iterations=500, doubtful_iterations=200), scene).iterations == iterations
    assert limit_iterations(plain(iterations=500), scene).iterations == 500
    assert limit_iterations(plain(iterations=150, doubtful_iterations=200), scene).iterations == 150


def test_no_iterations_give_the_start(truth):
    (only,) = refine(truth, plain(iterations=0), seed=0)
    assert only.iterations == truth.iterations and torch.equal(only.gaussians.means, truth.gaussians.means)


def test_every_view_takes_its_turn(truth, monkeypatch):
    taken = []
    monkeypatch.setattr(Trainer, "step", lambda fit, index, progress: taken.append(index))
    last(truth, plain(iterations=9))
    assert [sorted(taken[i : i + 3]) for i in (0, 3, 6)] == [[0, 1, 2]] * 3


def steps_until(deadline: float, truth: Scene, monkeypatch) -> list[float]:
    """The progress of each iteration when the clock is read at 0, 1, 2, ... seconds."""
    progress: list[float] = []
    clock = itertools.count()
    monkeypatch.setattr(training.time, "monotonic", lambda: float(next(clock)))
    monkeypatch.setattr(Trainer, "step", lambda fit, index, share: progress.append(share))
    assert len(list(refine(truth, plain(iterations=100), seed=0, deadline=deadline))) == 1
    return progress


def test_the_deadline_ends_the_refinement_within_an_iteration(truth, monkeypatch):
    progress = steps_until(8.0, truth, monkeypatch)
    assert progress == [i / 8 for i in range(1, 8)]  # and the step sizes have fallen by then as they should


def test_a_deadline_that_has_passed_gives_the_start(truth, monkeypatch):
    assert steps_until(0.5, truth, monkeypatch) == []


def test_iterations_end_the_refinement_long_before_a_late_deadline(truth, monkeypatch):
    progress = steps_until(1e6, truth, monkeypatch)
    assert progress == pytest.approx([i / 100 for i in range(100)], abs=1e-5)


def test_the_deadline_holds_on_a_real_clock(truth):
    list(refine(truth, QUICK, seed=0))  # whatever is slow only once
    for seconds in (0.4, 4.0, 40.0):  # a machine that is busy may need more than the first to begin
        started = time.monotonic()
        end = last(truth, plain(iterations=1_000_000), deadline=started + seconds)
        assert seconds <= time.monotonic() - started < seconds + 60.0
        if end.iterations > truth.iterations:
            return
    raise AssertionError("no iteration")


@pytest.mark.parametrize("wholly", [True, False])
def test_torch_gets_its_threads_back(truth, wholly):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        shown = refine(truth, plain(iterations=4, checkpoints=(2,)), seed=0)
        next(shown)
        assert torch.get_num_threads() == 2  # while the refinement is suspended
        if wholly:
            list(shown)
        del shown  # as a reader does who has seen enough
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_torch_has_one_thread_while_a_step_computes(truth, monkeypatch):
    threads = []
    step = Trainer.step
    monkeypatch.setattr(Trainer, "step", lambda *rest: threads.append(torch.get_num_threads()) or step(*rest))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        last(truth, plain(iterations=2))
        assert threads == [1, 1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def with_pointmap(view: TrainingView) -> TrainingView:
    shape = (view.height, view.width)
    nothing = [np.zeros(size, np.float32) for size in (shape, shape, (*shape, 3))]
    camera = view.T_world_camera.double().numpy(), view.K.double().numpy()
    return replace(view, pointmap=Pointmap(view.name, view.frame_id, *nothing, *camera))


class Brighter:
    """Stands for the losses beside the photometric one: wants everything to be bright, also from a pseudo view."""

    def __init__(self, pointmaps, images, config, *, seed, shown):
        self.names = [pointmap.name for pointmap in pointmaps]
        camera = pointmaps[1]
        self.view = PseudoView(camera.T_world_camera, camera.K, 64, 48, nearest=1)
        self.shapes = []
        self.served_by = {"depth": "a wish"}
        Brighter.made = self

    def channels(self, progress):
        return ("rgb", "depth") if progress < 0.75 else ("rgb",)

    def training_loss(self, index, render, progress):
        self.shapes.append((render.depth is not None, tuple(render.rgb.shape[:2])))
        return -10 * render.rgb.mean()

    def pseudo_loss(self, draw, progress):
        render = draw(self.view, ("rgb",))
        assert render.rgb.shape[:2] == (48, 64)  # its own size, whatever the training view's
        return -10 * render.rgb.mean()


def test_further_losses_count_on_training_views_and_pseudo_views(truth, monkeypatch):
    monkeypatch.setattr(fit, "Regularizer", Brighter)
    start = replace(truth, views=tuple(map(with_pointmap, truth.views)))
    config = plain(iterations=8, half_resolution_share=0.5)
    unpulled = last(start, config)
    brighter = last(start, structs.replace(config, regularizers=WITH_NORMALS))
    assert brighter.served_by == {"depth": "a wish"} and unpulled.served_by == {}
    assert Brighter.made.names == ["0.png", "1.png", "2.png"]
    assert Brighter.made.shapes == [(True, (24, 32))] * 4 + [(True, (48, 64))] * 2 + [(False, (48, 64))] * 2
    for shown in truth.views:
        assert render(brighter.gaussians, shown).mean() > 1.1 * render(unpulled.gaussians, shown).mean()


def test_a_loss_without_a_point_map_names_the_view(truth):
    with pytest.raises(ValueError, match=r"0\.png has no point map"):
        last(truth, plain(iterations=1, regularizers=WITH_NORMALS))


def test_the_steps_of_cameras_fall_by_a_part_of_their_own(truth):
    def moved(**final: float) -> tuple[float, float]:
        fit = Trainer(disturbed(truth), plain(lr=LearningRates(**final)), seed=0)
        fit.step(1, progress=1.0)
        scene = fit.scene()
        camera = (scene.views[1].T_world_camera - truth.views[1].T_world_camera).abs().max()
        return float((scene.gaussians.sh - disturbed(truth).gaussians.sh).abs().max()), float(camera)

    gaussians, camera = moved()
    slower_gaussians, same_camera = moved(final=0.03)
    same_gaussians, slower_camera = moved(final_pose=0.01)
    assert slower_gaussians == pytest.approx(0.1 * gaussians, rel=1e-3) and same_camera == camera
    assert slower_camera == pytest.approx(0.1 * camera, rel=1e-2) and same_gaussians == gaussians


def test_a_begun_scene_starts_soft_and_one_that_goes_on_does_not(truth):
    gaussians = replace(truth.gaussians, logit_opacities=torch.full_like(truth.gaussians.logit_opacities, logit(0.5)))
    sources = torch.zeros_like(gaussians.source_frame)
    sources[0] = SHELL
    scene = replace(truth, gaussians=replace(gaussians, source_frame=sources), iterations=0)
    still = plain(iterations=training.MIN_SOFT, lr=FROZEN)
    soft = last(scene, still).gaussians.opacities
    assert soft[0] == pytest.approx(0.5) and soft[1:].tolist() == pytest.approx([0.1] * (len(soft) - 1))
    gone_on, as_seeded = replace(scene, iterations=1), structs.replace(still, first_opacity=None)
    few, limited = plain(iterations=2, lr=FROZEN), time.monotonic() + 60
    for end in (last(gone_on, still), last(scene, as_seeded), last(scene, few), last(scene, still, deadline=limited)):
        assert end.gaussians.opacities.tolist() == pytest.approx([0.5] * len(soft))


def test_looks_change_nothing(truth):
    begun = replace(truth, iterations=0)
    config = plain(iterations=training.MIN_SOFT)
    unseen, watched = last(begun, config), last(begun, structs.replace(config, checkpoints=tuple(range(10, 100, 10))))
    assert torch.equal(unseen.gaussians.logit_opacities, watched.gaussians.logit_opacities)


def test_what_is_as_soft_already_is_left_to_the_bit(truth):
    from_photographs = replace(truth.gaussians, source_frame=torch.zeros_like(truth.gaussians.source_frame))
    soft = training.soften_opacities(from_photographs, 0.1)
    assert soft.opacities.max() < 0.11
    again = training.soften_opacities(soft, initialization.PixelwiseConfig().opacity)
    assert torch.equal(soft.logit_opacities, again.logit_opacities)


def test_no_tensor_is_kept_of_each_step(truth):
    kept: dict[int, int] = {}

    def count(done: int) -> None:
        gc.collect()
        kept[done] = sum(issubclass(type(each), torch.Tensor) for each in gc.get_objects())

    list(refine(truth, plain(iterations=12, checkpoints=()), seed=0, gone_on=count))
    assert kept[12] == kept[6]  # after each view was used, twice and four times


def test_a_longer_refinement_takes_no_more_memory():
    """Where a tensor was kept of each step, the allocator could often not join what lay around it: 90 MB more."""
    script = (
        "import resource\n"
        "from splatnode.recon.optimize.training import RefinementConfig, refine\n"
        "from tests.support.known_scene import many_gaussians\n"
        "peaks = {}\n"
        "def note(done): peaks[done] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "list(refine(many_gaussians(), RefinementConfig(iterations=200, checkpoints=(), control=None), seed=0, "
        "gone_on=note))\n"
        "print(peaks[200] - peaks[50])\n"
    )
    grown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(grown.stdout) < 20_000  # kB
