"""Does a keyframe belong to the place? A quick answer at once, a thorough one in the end. Which views can be spared?

A keyframe that does not fit at once is set aside, out of the scene: it may spoil it. It belongs all the same where all
keyframes, judged together as an offline run judges them, make a scene: a later one may have joined it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

from splatnode.recon.daemon.reconstruction import LiveReconstruction
from splatnode.recon.estimation import Judgement
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph

NEWEST = 3  # keyframes that are never given up: what comes next connects to them
MOST = 0.6  # of a scene's cameras, that a scene has to have to be that scene with more cameras

Pause = Callable[[], None]


def add(work: LiveReconstruction, keyframes: Sequence[Keyframe]) -> set[str]:
    """Adds keyframes to the reconstruction; sets those aside that do not fit the scene at once, and names them.

    Where there is no scene that may be published there is nothing that they could fit, and all of them are kept.
    """
    standing = _standing(work)
    for keyframe in keyframes:
        work.add(keyframe)
    if not standing:
        return set()
    names = [keyframe.name for keyframe in keyframes]
    if _fits(work, names):
        return set()
    work.set_aside(names)
    return {name for name in names if len(names) == 1 or not _fits_alone(work, name)}


def join(work: LiveReconstruction, names: Iterable[str], pause: Pause = lambda: None) -> bool:
    """Brings keyframes back that were set aside, if all are a scene together: this one, judged thoroughly.

    Some of them may still be without a camera then. `pause` may raise to abandon the work, and they stay aside.
    """
    names = set(names)
    if not names or work.refused(names.union(work.names)):
        return False
    standing = _standing(work)
    work.bring_back(names)
    try:
        placed = _placed(work, work.judge_thoroughly(pause))
    except BaseException:
        work.set_aside(names)
        raise
    if placed and len(placed & standing) >= MOST * len(standing):
        return True
    work.set_aside(names)
    return False


def connected(work: LiveReconstruction, pause: Pause = lambda: None) -> bool:
    """Whether any verified pairs lead from the scene to what was set aside; without them nothing can join the two."""
    placed, aside = _standing(work), {keyframe.name for keyframe in work.aside}
    work.bring_back(aside)
    try:
        work.graph.complete(pause)
        groups = [{work.names[index] for index in group} for group in work.graph.components()]
    finally:
        work.set_aside(aside)
    return any(not group.isdisjoint(placed) and not group.isdisjoint(aside) for group in groups)


def prove(work: LiveReconstruction, pause: Pause = lambda: None) -> None:
    """Judges thoroughly what was added for now and what was set aside: together, else one after the other.

    Keyframes by which the scene fails are set aside. `pause` may raise to abandon the work; what was not judged by then
    is aside, or as it was.
    """
    if join(work, _names(work.aside), pause):
        return
    judged = work.judge_thoroughly(pause)
    if not work.proven:
        return
    if not judged.verdict.publishable:
        work.set_aside(set(work.names) - work.proven)
        work.judge_thoroughly(pause)
    for name in _names(work.aside):
        join(work, [name], pause)


def strangers(work: LiveReconstruction) -> list[Keyframe]:
    """The last keyframes in a row, as their frames came, that have no camera in the scene that there is."""
    placed = _standing(work)
    if not placed:
        return []
    everyone = sorted([*work.graph.keyframes, *work.aside], key=lambda keyframe: keyframe.frame.frame_id)
    last = max(index for index, keyframe in enumerate(everyone) if keyframe.name in placed)
    return everyone[last + 1 :]


def contradicting(work: LiveReconstruction) -> list[Keyframe]:
    """Keyframes that were set aside, after which others fitted."""
    last = _names(strangers(work))
    return [keyframe for keyframe in work.aside if keyframe.name not in last] if _standing(work) else []


def most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name


def _fits_alone(work: LiveReconstruction, name: str) -> bool:
    """Whether a keyframe that was set aside fits at once; it is brought back then."""
    work.bring_back([name])
    if _fits(work, [name]):
        return True
    work.set_aside([name])
    return False


def _fits(work: LiveReconstruction, names: Collection[str]) -> bool:
    judged = work.judge_quickly()
    return judged is not None and _placed(work, judged).issuperset(names)


def _standing(work: LiveReconstruction) -> set[str]:
    """The keyframes that have a camera in the scene that there is, if it may be published."""
    return _placed(work, work.judge()) if work.scene is not None else set()


def _placed(work: LiveReconstruction, judged: Judgement) -> set[str]:
    """The keyframes that have a camera in a scene that may be published."""
    if not judged.verdict.publishable or judged.registration is None:
        return set()
    return {work.names[camera.index] for camera in judged.registration.cameras}


def _names(keyframes: Iterable[Keyframe]) -> list[str]:
    return [keyframe.name for keyframe in keyframes]
