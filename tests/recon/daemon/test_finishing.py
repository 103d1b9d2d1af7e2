"""The final scene of a live place is refined as offline, and can be abandoned every few steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from splatnode.recon.config import PRESETS
from splatnode.recon.daemon import finishing
from splatnode.recon.modelling import Shown
from splatnode.recon.optimize import refinement


@dataclass
class Work:
    """What finishing needs of an IncrementalReconstruction."""

    begun: str = "begun"
    asked: list[refinement.Config] = field(default_factory=list)

    def rebuild(self, pause: Callable[[], None]) -> None:
        pause()

    def refine(self, scene: str, steps: refinement.Config, gone_on: Callable[[int], None]) -> Iterator[Shown]:
        assert scene == self.begun
        self.asked.append(steps)
        for done in range(1, steps.steps + 1):
            gone_on(done)
        yield Shown()


@pytest.mark.parametrize("name", PRESETS)
def test_its_refinement_is_that_of_photographs_that_are_all_at_hand(name):
    work = Work()
    assert len(list(finishing.refine(work, PRESETS[name], lambda: None))) == 1
    # No checkpoint more: before one that comes early a scene would not start with soft Gaussians.
    assert work.asked == [PRESETS[name].optimize]


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
        list(finishing.refine(Work(), config, pause))
    paused.clear()
    list(finishing.refine(Work(), config, lambda: paused.append(0)))
    assert len(paused) == 1 + config.optimize.steps // finishing.STEP
