"""The end of a place's reconstruction: all evidence is weighed, and the scene is made afresh and refined."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec

from splatnode.recon.config import Config
from splatnode.recon.daemon import membership
from splatnode.recon.incremental import IncrementalReconstruction, Pause
from splatnode.recon.modelling import Shown

STEP = 10  # iterations between pauses

Forget = Callable[[str, str], None]  # a keyframe's name, and why


def judge(work: IncrementalReconstruction, forget: Forget, pause: Pause) -> None:
    """Estimates thoroughly which keyframes belong to the place; those that contradict it are forgotten."""
    membership.prove(work, pause)
    for keyframe in membership.contradicting(work, pause):
        forget(keyframe.name, "it contradicts the scene")


def refine(work: IncrementalReconstruction, config: Config, pause: Pause) -> Iterator[Shown]:
    """The scene of all keyframes every STEP iterations, and at the end; it is not shown yet. None where it is refused.

    `pause` is called in between, and may raise to abandon the work.
    """
    steps = msgspec.structs.replace(config.optimize, checkpoints=tuple(range(STEP, config.optimize.iterations, STEP)))
    work.rebuild(pause)
    for show in work.refine(work.begun, steps):
        pause()
        yield show
