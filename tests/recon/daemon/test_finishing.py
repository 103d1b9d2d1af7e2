"""The final scene of a live place is refined as offline, and can be abandoned every few steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.recon.config import PRESETS, ReconstructionConfig
from splatnode.recon.daemon import submap
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.modelling import SceneWithVerdict
from splatnode.recon.optimize import training
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.threads import BACKGROUND, RunContext
from tests.support.synthetic import photographs


@dataclass
class Work:
    """What finishing needs of an IncrementalReconstruction."""

    initial_scene: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(views=()))
    asked: list[training.RefinementConfig] = field(default_factory=list)

    def rebuild(self, run: RunContext) -> None:
        run.pause()

    def refine(
        self, scene: SimpleNamespace, steps: training.RefinementConfig, run: RunContext
    ) -> Iterator[SceneWithVerdict]:
        assert scene is self.initial_scene
        self.asked.append(steps)
        for _ in range(steps.steps):
            run.pause()
        yield SceneWithVerdict()


def test_the_scene_is_that_of_an_offline_run_to_the_bit():
    frames = photographs()[1:4]
    config = ReconstructionConfig(
        size=160, optimize=training.RefinementConfig(iterations=training.MIN_SOFT, checkpoints=())
    )
    work = IncrementalReconstruction(config)
    for frame in frames:
        work.add_frame(frame)
    *_, live = submap.refine(work, config, BACKGROUND)
    *_, offline = reconstruct(frames, config)
    assert live.scene is not None and len(offline.gaussians) > 1000
    found = live.scene.arrays()
    for name in ("means", "opacities", "sh"):
        assert np.array_equal(getattr(found, name), getattr(offline.gaussians, name))


@pytest.mark.parametrize("name", PRESETS)
def test_its_refinement_is_that_of_photographs_that_are_all_at_hand(name):
    work = Work()
    assert len(list(submap.refine(work, PRESETS[name], BACKGROUND))) == 1
    # No checkpoint more: before one that comes early a scene would not start with soft Gaussians.
    assert work.asked == [PRESETS[name].optimize]


def test_a_scene_of_which_views_confirm_little_is_refined_in_fewer_steps_live_too():
    work = Work(SimpleNamespace(views=(SimpleNamespace(consistent_depth=0.1),)))
    list(submap.refine(work, PRESETS["balanced"], BACKGROUND))
    assert [steps.iterations for steps in work.asked] == [200]


def test_it_can_be_abandoned_every_few_steps():
    class Abandoned(Exception):
        pass

    paused: list[int] = []

    def pause() -> None:
        paused.append(len(paused))
        if len(paused) == 4:
            raise Abandoned

    config = PRESETS["fast"]
    with pytest.raises(Abandoned):
        list(submap.refine(Work(), config, RunContext(pause)))
    paused.clear()
    list(submap.refine(Work(), config, RunContext(lambda: paused.append(0))))
    assert len(paused) == 1 + config.optimize.steps // submap.STEP
