"""Does a key frame belong to the place? Which of its views can be spared?"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from recon.judging import Judgement
from recon.keyframe import Keyframe
from recon.pipeline import Reconstruction
from recon.view_graph import ViewGraph

NEWEST = 3  # keyframes that are never given up: what comes next connects to them


def add(work: Reconstruction, keyframes: Sequence[Keyframe]) -> set[str]:
    """Adds keyframes to the reconstruction; returns the names of those that do not belong to the scene that there is.

    Of these, keyframes that make what could be published unpublishable are taken back: the scene stays as it was.
    """
    had_scene = work.scene is not None
    for keyframe in keyframes:
        work.add(keyframe)
    if not had_scene:
        return set()
    names = {keyframe.name for keyframe in keyframes}
    judged = work.judge()
    if judged.verdict.publishable:
        return names - _placed(work, judged)
    work.retract(names)
    if len(keyframes) == 1:
        return names
    return set().union(*(add(work, [keyframe]) for keyframe in keyframes))


def prove(work: Reconstruction, pause: Callable[[], None] = lambda: None) -> list[Keyframe]:
    """Judges thoroughly what was added for now; returns keyframes that do not belong to the scene after all.

    Of these, keyframes by which the scene fails are taken back. `pause` may raise to abandon the work, and nothing has
    happened then.
    """
    doubted = [keyframe for keyframe in work.graph.keyframes if keyframe.name not in work.proven]
    judged = work.judge_thoroughly(pause)
    if not work.proven or not doubted:
        return []
    if judged.verdict.publishable:
        return [keyframe for keyframe in doubted if keyframe.name not in _placed(work, judged)]
    work.retract({keyframe.name for keyframe in doubted})
    strangers = []
    for keyframe in doubted:
        work.add(keyframe)
        judged = work.judge_thoroughly()
        if not judged.verdict.publishable:
            work.retract({keyframe.name})
        if keyframe.name not in _placed(work, judged):
            strangers.append(keyframe)
    return strangers


def _placed(work: Reconstruction, judged: Judgement) -> set[str]:
    """The keyframes that have a camera in a scene that may be published."""
    if not judged.verdict.publishable or judged.registration is None:
        return set()
    return {work.names[camera.index] for camera in judged.registration.cameras}


def most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name
