"""What is done alike for the place where the camera is, and for one that it has left.

Keyframes are screened; in the end all evidence is weighed, and the scene is made afresh and refined.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator

from splatnode.capture.process.logs import event
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import membership
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction, Pause
from splatnode.recon.modelling import SceneWithVerdict

log = logging.getLogger(__name__)

STEP = 10  # iterations between pauses

Forget = Callable[[str, str], None]  # a keyframe's name, and why


def screen_keyframes(work: IncrementalReconstruction, keyframes: Iterable[Keyframe], forget: Forget) -> list[Keyframe]:
    """Those of the keyframes that show something new, and sharply; what does not is forgotten."""
    kept: list[Keyframe] = []
    for keyframe in keyframes:
        gone = {each.name: each.reason for each in work.screen(keyframe.frame)}
        kept = [each for each in (*kept, keyframe) if each.name not in gone]
        for name, reason in gone.items():
            event(log, logging.INFO, "left_out", frame=name, reason=reason)
            forget(name, reason)
    return kept


def verify_keyframes(work: IncrementalReconstruction, forget: Forget, pause: Pause) -> None:
    """Estimates thoroughly which keyframes belong to the place; those that contradict it are forgotten."""
    membership.verify_provisional(work, pause)
    for keyframe in membership.find_contradicting(work, pause):
        forget(keyframe.name, "it contradicts the scene")


def refine(work: IncrementalReconstruction, config: ReconstructionConfig, pause: Pause) -> Iterator[SceneWithVerdict]:
    """The scene of all keyframes at every checkpoint, and at the end; it is not shown yet.

    Yields nothing where the verdict forbids a scene. `pause` is called in between, and may raise to abandon the work.
    """
    steps = itertools.count(1)

    def pause_periodically() -> None:
        if next(steps) % STEP == 0:
            pause()

    work.rebuild(pause)
    yield from work.refine(work.initial_scene, config.optimize, pause_periodically)
