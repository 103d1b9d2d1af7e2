"""Does a keyframe belong to the place? A quick answer at once, a thorough one in the end. Which views can be spared?

A keyframe that does not fit at once is set aside, out of the scene: it may spoil it. It belongs all the same where all
keyframes, estimated together as an offline run estimates them, make a scene: a later one may have joined it.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from splatnode.capture.process.logs import event
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction, Pause, ignore_cancel
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.modelling import SceneWithVerdict

NEWEST = 3  # keyframes that are never given up: what comes next connects to them
PLACE = 3  # keyframes that may be a place of their own
MIN_KEPT_CAMERAS = 0.6  # share of a scene's cameras that a merged scene must keep to count as the same scene


def add(work: IncrementalReconstruction, keyframes: Sequence[Keyframe], pause: Pause = ignore_cancel) -> set[str]:
    """Adds keyframes to the reconstruction; sets those aside that do not fit the scene at once, and names them.

    Where there is no scene that may be published there is nothing that they could fit, and all of them are kept.
    """
    standing = _find_placed(work, pause)
    for keyframe in keyframes:
        work.add_keyframe(keyframe, pause)
    if not standing:
        return set()
    names = [keyframe.name for keyframe in keyframes]
    if _fits(work, names):
        return set()
    work.defer_keyframes(names)
    return {name for name in names if len(names) == 1 or not _fits_alone(work, name)}


def join(work: IncrementalReconstruction, names: Iterable[str], pause: Pause = ignore_cancel) -> bool:
    """Brings keyframes back that were set aside, if all are a scene together: this one, estimated thoroughly.

    Some of them may still be without a camera then. `pause` may raise to abandon the work, and they stay aside.
    """
    names = set(names)
    if not names or work.is_rejected(names.union(work.names)):
        return False
    standing = _find_placed(work, pause)
    work.restore_keyframes(names)
    try:
        placed = work.estimate_thoroughly(pause).publishable_camera_names
    except BaseException:
        work.defer_keyframes(names)
        raise
    if placed and len(placed & standing) >= MIN_KEPT_CAMERAS * len(standing):
        return True
    work.defer_keyframes(names)
    return False


def has_links_to_deferred(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> bool:
    """Whether any verified pairs lead from the scene to what was set aside; without them nothing can join the two."""
    placed, aside = _find_placed(work, pause), {keyframe.name for keyframe in work.keyframes_deferred}
    work.restore_keyframes(aside)
    try:
        work.match_pending_pairs(pause)
        groups = [{work.names[index] for index in group} for group in work.graph.components()]
    finally:
        work.defer_keyframes(aside)
    return any(not group.isdisjoint(placed) and not group.isdisjoint(aside) for group in groups)


def find_separate_groups(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> list[list[Keyframe]]:
    """Returns groups of keyframes that verified pairs join to each other, and to none of the scene.

    Where there is no scene, what most keyframes show counts as it. Those that were set aside are asked, too.
    """
    placed, aside = (
        work.estimate_soon(pause).publishable_camera_names,
        {keyframe.name for keyframe in work.keyframes_deferred},
    )
    work.restore_keyframes(aside)
    try:
        work.match_pending_pairs(pause)
        groups = [[work.graph.keyframes[index] for index in group] for group in work.graph.components()]
    finally:
        work.defer_keyframes(aside)
    here = placed or {keyframe.name for group in groups[:1] for keyframe in group}
    others = [group for group in groups if here.isdisjoint(keyframe.name for keyframe in group)]
    return [group for group in others if len(group) >= PLACE]


def is_split(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> bool:
    """Whether the keyframes show several places: groups that verified pairs join to each other, and to no other."""
    work.match_pending_pairs(pause)
    return sum(len(group) > 1 for group in work.graph.components()) > 1


def verify_provisional(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> None:
    """Estimates thoroughly what was added provisionally and what was set aside: together, else one after the other.

    Keyframes by which the scene fails are set aside. `pause` may raise to abandon the work; what was not estimated by
    then is aside, or as it was.
    """
    if join(work, _list_names(work.keyframes_deferred), pause):
        return
    estimate = work.estimate_thoroughly(pause)
    if not work.publishable_names:
        return
    if not estimate.verdict.publishable:
        work.defer_keyframes(set(work.names) - work.publishable_names)
        work.estimate_thoroughly(pause)
    for name in _list_names(work.keyframes_deferred):
        join(work, [name], pause)


def find_untracked(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> list[Keyframe]:
    """The last keyframes in a row, as their frames came, that have no camera in the scene that there is."""
    placed = _find_placed(work, pause)
    if not placed:
        return []
    everyone = sorted([*work.graph.keyframes, *work.keyframes_deferred], key=lambda keyframe: keyframe.frame.frame_id)
    last = max(index for index, keyframe in enumerate(everyone) if keyframe.name in placed)
    return everyone[last + 1 :]


def find_contradicting(work: IncrementalReconstruction, pause: Pause = ignore_cancel) -> list[Keyframe]:
    """Keyframes that were set aside, after which others fitted."""
    last = _list_names(find_untracked(work, pause))
    return (
        [keyframe for keyframe in work.keyframes_deferred if keyframe.name not in last]
        if _find_placed(work, pause)
        else []
    )


def select_newest(work: IncrementalReconstruction, count: int) -> list[Keyframe]:
    """So many keyframes of the scene, of those whose frames came last."""
    return sorted(work.graph.keyframes, key=lambda keyframe: keyframe.frame.frame_id)[-max(count, NEWEST) :]


def find_most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name


def _fits_alone(work: IncrementalReconstruction, name: str) -> bool:
    """Whether a keyframe that was set aside fits at once; it is brought back then."""
    work.restore_keyframes([name])
    if _fits(work, [name]):
        return True
    work.defer_keyframes([name])
    return False


def _fits(work: IncrementalReconstruction, names: Collection[str]) -> bool:
    estimate = work.estimate_quickly()
    return estimate is not None and estimate.publishable_camera_names.issuperset(names)


def _find_placed(work: IncrementalReconstruction, pause: Pause) -> set[str]:
    """The keyframes that have a camera in the scene that there is, if it may be published."""
    return work.estimate_soon(pause).publishable_camera_names if work.scene is not None else set()


def _list_names(keyframes: Iterable[Keyframe]) -> list[str]:
    return [keyframe.name for keyframe in keyframes]


# What is done alike for the place where the camera is, and for one that it has left.
#
# Keyframes are screened; in the end all evidence is weighed, and the scene is made afresh and refined.

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
    verify_provisional(work, pause)
    for keyframe in find_contradicting(work, pause):
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
