"""Does a key frame belong to the place? Which of its views can be spared?"""

from __future__ import annotations

from collections.abc import Sequence

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
    registration, verdict = work.judge()
    if verdict.publishable and registration is not None:
        return names - {work.names[camera.index] for camera in registration.cameras}
    work.retract(names)
    if len(keyframes) == 1:
        return names
    return set().union(*(add(work, [keyframe]) for keyframe in keyframes))


def most_redundant(graph: ViewGraph) -> str:
    """The older keyframe of the pair that has most in common, the newest ones left out."""
    old = len(graph.keyframes) - NEWEST
    shared = {pair: len(view.matches) for pair, view in graph.pairs.items() if pair[0] < old}
    first = max(shared, key=lambda pair: (shared[pair], -pair[0]))[0] if shared else 0
    return graph.keyframes[first].name
