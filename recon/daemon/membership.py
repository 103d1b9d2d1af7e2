"""Does a keyframe belong to the place? A quick answer at once, a thorough one in the end. Which views can be spared?

A keyframe that does not fit at once is set aside, out of the scene: it may spoil it. It belongs all the same where all
keyframes, estimated together as an offline run estimates them, make a scene: a later one may have joined it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction, Pause, without_pause
from splatnode.recon.matching.view_graph import ViewGraph

NEWEST = 3  # keyframes that are never given up: what comes next connects to them
PLACE = 3  # keyframes that may be a place of their own
MIN_KEPT_CAMERAS = 0.6  # share of a scene's cameras that a merged scene must keep to count as the same scene


def add(work: IncrementalReconstruction, keyframes: Sequence[Keyframe], pause: Pause = without_pause) -> set[str]:
    """Adds keyframes to the reconstruction; sets those aside that do not fit the scene at once, and names them.

    Where there is no scene that may be published there is nothing that they could fit, and all of them are kept.
    """
    standing = _standing(work, pause)
    for keyframe in keyframes:
        work.add(keyframe, pause)
    if not standing:
        return set()
    names = [keyframe.name for keyframe in keyframes]
    if _fits(work, names):
        return set()
    work.set_aside(names)
    return {name for name in names if len(names) == 1 or not _fits_alone(work, name)}


def join(work: IncrementalReconstruction, names: Iterable[str], pause: Pause = without_pause) -> bool:
    """Brings keyframes back that were set aside, if all are a scene together: this one, estimated thoroughly.

    Some of them may still be without a camera then. `pause` may raise to abandon the work, and they stay aside.
    """
    names = set(names)
    if not names or work.was_refused(names.union(work.names)):
        return False
    standing = _standing(work, pause)
    work.bring_back(names)
    try:
        placed = work.estimate_thoroughly(pause).placed
    except BaseException:
        work.set_aside(names)
        raise
    if placed and len(placed & standing) >= MIN_KEPT_CAMERAS * len(standing):
        return True
    work.set_aside(names)
    return False


def connected(work: IncrementalReconstruction, pause: Pause = without_pause) -> bool:
    """Whether any verified pairs lead from the scene to what was set aside; without them nothing can join the two."""
    placed, aside = _standing(work, pause), {keyframe.name for keyframe in work.aside}
    work.bring_back(aside)
    try:
        work.complete(pause)
        groups = [{work.names[index] for index in group} for group in work.graph.components()]
    finally:
        work.set_aside(aside)
    return any(not group.isdisjoint(placed) and not group.isdisjoint(aside) for group in groups)


def apart(work: IncrementalReconstruction, pause: Pause = without_pause) -> list[list[Keyframe]]:
    """What shows places of its own: keyframes that verified pairs join to each other, and to none of the scene.

    Where there is no scene, what most keyframes show counts as it. Those that were set aside are asked, too.
    """
    placed, aside = work.estimate_soon(pause).placed, {keyframe.name for keyframe in work.aside}
    work.bring_back(aside)
    try:
        work.complete(pause)
        groups = [[work.graph.keyframes[index] for index in group] for group in work.graph.components()]
    finally:
        work.set_aside(aside)
    here = placed or {keyframe.name for group in groups[:1] for keyframe in group}
    others = [group for group in groups if here.isdisjoint(keyframe.name for keyframe in group)]
    return [group for group in others if len(group) >= PLACE]


def is_split(work: IncrementalReconstruction, pause: Pause = without_pause) -> bool:
    """Whether the keyframes show several places: groups that verified pairs join to each other, and to no other."""
    work.complete(pause)
    return sum(len(group) > 1 for group in work.graph.components()) > 1


def prove(work: IncrementalReconstruction, pause: Pause = without_pause) -> None:
    """Estimates thoroughly what was added provisionally and what was set aside: together, else one after the other.

    Keyframes by which the scene fails are set aside. `pause` may raise to abandon the work; what was not estimated by
    then is aside, or as it was.
    """
    if join(work, _names(work.aside), pause):
        return
    estimate = work.estimate_thoroughly(pause)
    if not work.proven:
        return
    if not estimate.verdict.publishable:
        work.set_aside(set(work.names) - work.proven)
        work.estimate_thoroughly(pause)
    for name in _names(work.aside):
        join(work, [name], pause)


def strangers(work: IncrementalReconstruction, pause: Pause = without_pause) -> list[Keyframe]:
    """The last keyframes in a row, as their frames came, that have no camera in the scene that there is."""
    placed = _standing(work, pause)
    if not placed:
        return []
    everyone = sorted([*work.graph.keyframes, *work.aside], key=lambda keyframe: keyframe.frame.frame_id)
    last = max(index for index, keyframe in enumerate(everyone) if keyframe.name in placed)
    return everyone[last + 1 :]


def contradicting(work: IncrementalReconstruction, pause: Pause = without_pause) -> list[Keyframe]:
    """Keyframes that were set aside, after which others fitted."""
    last = _names(strangers(work, pause))
    return [keyframe for keyframe in work.aside if keyframe.name not in last] if _standing(work, pause) else []


def newest(work: IncrementalReconstruction, count: int) -> list[Keyframe]:
    """So many keyframes of the scene, of those whose frames came last."""
    return sorted(work.graph.keyframes, key=lambda keyframe: keyframe.frame.frame_id)[-max(count, NEWEST) :]


def most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name


def _fits_alone(work: IncrementalReconstruction, name: str) -> bool:
    """Whether a keyframe that was set aside fits at once; it is brought back then."""
    work.bring_back([name])
    if _fits(work, [name]):
        return True
    work.set_aside([name])
    return False


def _fits(work: IncrementalReconstruction, names: Collection[str]) -> bool:
    estimate = work.estimate_quickly()
    return estimate is not None and estimate.placed.issuperset(names)


def _standing(work: IncrementalReconstruction, pause: Pause) -> set[str]:
    """The keyframes that have a camera in the scene that there is, if it may be published."""
    return work.estimate_soon(pause).placed if work.scene is not None else set()


def _names(keyframes: Iterable[Keyframe]) -> list[str]:
    return [keyframe.name for keyframe in keyframes]
