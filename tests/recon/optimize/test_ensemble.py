"""Ensembles on a tiny scene: what several scenes show between the photographs in the mean, one learns in the end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec import structs

from splatnode.recon.optimize import ensemble
from splatnode.recon.optimize.fit import Trainer
from splatnode.recon.optimize.training import RefinementConfig, refine
from splatnode.recon.scene import Scene, TrainingView
from tests.support.known_scene import disturbed, photographed, render

ALONE = RefinementConfig(
    iterations=40, checkpoints=(15,), ssim_lambda=0.2, dropout=ensemble.DropoutConfig(share=0.0), control=None
)
TOGETHER = structs.replace(ALONE, ensemble=ensemble.EnsembleConfig(members=3, iterations=60, pseudo_views=2))


@pytest.fixture(scope="module")
def start() -> Scene:
    return disturbed(photographed())


def ends(start: Scene, config: RefinementConfig, seed: int = 0, **limits: float) -> list[Scene]:
    return list(refine(start, config, seed=seed, **limits))


def distance(scene: Scene, views: Sequence[TrainingView]) -> float:
    """Mean squared difference of what the scene shows from what these views show."""
    return float(
        np.mean([np.square(render(scene.gaussians, each).numpy() - each.image / 255).mean() for each in views])
    )


def test_the_last_scene_shows_between_the_photographs_what_all_members_show_in_the_mean(start):
    seeds = [ensemble.seed_of(member, 0) for member in range(3)]
    members = [ends(start, ALONE, seed)[-1] for seed in seeds]
    *_, found = ends(start, TOGETHER)
    elsewhere = ensemble.render_between_views(
        members, ensemble.EnsembleConfig(pseudo_views=5, off_path=0.1), seed=9
    )  # not those of the fit
    assert distance(found, elsewhere) < 0.8 * min(distance(member, elsewhere) for member in members)


def test_the_first_member_is_the_scene_by_itself_and_is_shown_first(start):
    by_itself, shown = ends(start, ALONE), ends(start, TOGETHER)
    assert [scene.iterations - start.iterations for scene in shown] == [15, 40, 180]
    for alone, first in zip(by_itself, shown[:2], strict=True):
        assert torch.equal(alone.gaussians.means, first.gaussians.means) and alone.losses == first.losses
    assert len(shown[-1].losses) == 30  # photometric, of steps on photographs


def test_pseudo_views_do_not_stay_in_the_scene_and_their_cameras_stay_where_they_are(start, monkeypatch):
    taken: list[tuple[int, torch.Tensor | None]] = []
    step = Trainer.step

    def noting(self: Trainer, index: int, progress: float) -> None:
        beside = self._Ts_beside
        before = beside[index - 3].clone() if index >= 3 else None
        step(self, index, progress)
        assert before is None or torch.equal(before, beside[index - 3])
        taken.append((index, before))

    monkeypatch.setattr(Trainer, "step", noting)
    *_, found = ends(
        start, structs.replace(TOGETHER, ensemble=ensemble.EnsembleConfig(members=2, iterations=24, pseudo_views=2))
    )
    assert [view.name for view in found.views] == [view.name for view in start.views]
    indices = [index for index, _ in taken]
    assert max(indices[:80]) == 2  # members see photographs alone
    assert sorted(indices[80:92]) == [0, 0, 1, 1, 2, 2, 3, 4, 5, 6, 7, 8]  # then as many photographs as pseudo views


def test_it_tells_of_all_steps_and_nothing_is_pruned_in_the_last_ones(start):
    told: list[int] = []
    list(refine(start, TOGETHER, seed=0, gone_on=told.append))
    assert told == list(range(1, TOGETHER.steps + 1)) and TOGETHER.steps == 180 and ALONE.steps == 40


def test_members_draw_other_random_numbers_and_the_same_seed_gives_the_same_scene(start):
    seeds = [ensemble.seed_of(member, seed) for seed in (0, 1) for member in range(3)]
    assert len(set(seeds)) == 6 and seeds[0] == 0 and seeds[3] == 1
    few = structs.replace(TOGETHER, iterations=6, ensemble=ensemble.EnsembleConfig(members=2, iterations=6))
    *_, one = ends(start, few)
    *_, other = ends(start, few)
    assert torch.equal(one.gaussians.means, other.gaussians.means)


def test_where_a_deadline_leaves_no_time_for_others_the_first_member_is_the_end(start):
    slow = structs.replace(TOGETHER, iterations=100_000)
    shown = ends(start, slow, deadline=time.monotonic() + 0.5)
    assert [scene.iterations - start.iterations in (15, shown[-1].iterations - start.iterations) for scene in shown]
    assert len(shown[-1].losses) == shown[-1].iterations - start.iterations < 100_000
    *_, unhurried = ends(start, TOGETHER, deadline=time.monotonic() + 600)
    assert unhurried.iterations - start.iterations == TOGETHER.steps


def test_a_deadline_that_falls_into_a_further_member_leaves_the_first_one_as_it_was(start, monkeypatch):
    """As on a machine that becomes slower than the first member was."""
    clock, step, steps = [0.0], Trainer.step, [0]

    def slower(self: Trainer, index: int, progress: float) -> None:
        step(self, index, progress)
        steps[0] += 1
        clock[0] += 1000.0 if steps[0] > ALONE.iterations + 5 else 0.001

    monkeypatch.setattr(Trainer, "step", slower)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    shown = ends(start, TOGETHER, deadline=100.0)
    assert [scene.iterations - start.iterations for scene in shown] == [15, 40] and len(shown[-1].losses) == 40


def test_one_camera_has_nothing_between(start):
    alone = replace(start, views=start.views[:1])
    assert ensemble.render_between_views([alone, alone], ensemble.EnsembleConfig(members=2), seed=0) == []
    *_, found = ends(
        alone, structs.replace(TOGETHER, iterations=5, ensemble=ensemble.EnsembleConfig(members=2, iterations=5))
    )
    assert len(found.views) == 1 and len(found.losses) == 5
