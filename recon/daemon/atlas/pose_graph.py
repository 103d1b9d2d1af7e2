"""The graph of scenes: where each lies in the map that it belongs to, by all links together.

Scenes are nodes, links are edges. What the links of a cycle do not agree on, the drift of scale among it, is shared out
by their uncertainties (Strasdat et al., "Scale drift-aware large scale monocular SLAM", RSS 2010). A loop that the
others contradict is left out, and said to be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from splatnode.recon.daemon.atlas.links import EdgeKind, PoseGraphEdge
from splatnode.recon.daemon.atlas.relaxation import compute_deviations, solve_pose_graph
from splatnode.recon.geometry import Similarity

CONTRADICTED = 5.0  # standard deviations by which a link differs from where the others put it


class SubmapPose(msgspec.Struct, frozen=True):
    """A point x of `scene` lies at scale * rotation @ x + translation in the world of `map`, the map's first scene."""

    scene: str
    map: str
    scale: float
    rotation: tuple[tuple[float, ...], ...]  # (3, 3), row by row
    translation: tuple[float, ...]  # (3,), in the unit of `map`

    @property
    def similarity(self) -> Similarity:
        """From the scene's world to the map's."""
        return Similarity(self.scale, np.array(self.rotation), np.array(self.translation))


@dataclass(frozen=True)
class PoseGraph:
    poses: tuple[SubmapPose, ...]  # of all scenes, each once
    links: tuple[PoseGraphEdge, ...]  # as they were given; those of them that do not count say why


def optimize_pose_graph(scenes: Sequence[str], links: Sequence[PoseGraphEdge]) -> PoseGraph:
    """Optimizes the scenes' poses. The first scene of each map, in the order of `scenes`, is its world.

    A loop that contradicts the others is retracted, the most contradicted first, until none does.
    """
    retracted: dict[int, str] = {}
    while True:
        counting = [index for index in range(len(links)) if index not in retracted]
        those = [links[index] for index in counting]
        placed = _place_scenes(scenes, those, math.inf)
        if compute_deviations(_select_similarities(placed), those).max(initial=0.0) <= CONTRADICTED:
            break
        # Where loops pull no harder than this, those that agree hold the scenes, and the wrong one stands out.
        apart = compute_deviations(_select_similarities(_place_scenes(scenes, those, 1.0)), those)
        loops = [place for place, each in enumerate(those) if each.kind is EdgeKind.LOOP]
        if not loops:
            break
        worst = max(loops, key=lambda place: apart[place])
        index, sigmas = counting[worst], apart[worst]
        retracted[index] = f"it differs from where the other links put the scenes by {sigmas:.0f} standard deviations"
    poses = (
        SubmapPose(
            scene, root, found.scale, tuple(map(tuple, found.rotation.tolist())), tuple(found.translation.tolist())
        )
        for scene, (root, found) in placed.items()
    )
    told = (msgspec.structs.replace(each, retracted=retracted.get(index)) for index, each in enumerate(links))
    return PoseGraph(tuple(poses), tuple(told))


_Placed = Mapping[str, tuple[str, Similarity]]  # by scene: the first scene of its map, and from its world to that


def _place_scenes(scenes: Sequence[str], links: Sequence[PoseGraphEdge], hardest: float) -> _Placed:
    """The scenes by the links, all of which count; `hardest` as for `relaxed`."""
    placed: dict[str, tuple[str, Similarity]] = {}
    for root in scenes:
        if root in placed:
            continue
        found = _span_tree(root, links)
        mine = [each for each in links if each.scene in found and each.other in found]
        if len(mine) >= len(found):  # there is a cycle
            found = solve_pose_graph(found, mine, hardest)
        placed |= {scene: (root, found[scene]) for scene in scenes if scene in found}
    return placed


def _span_tree(root: str, links: Sequence[PoseGraphEdge]) -> dict[str, Similarity]:
    """All scenes that links lead to, along the fewest links; chains before loops."""
    found = {root: Similarity(1.0, np.eye(3), np.zeros(3))}
    ordered = sorted(links, key=lambda each: each.kind is EdgeKind.LOOP)
    while True:
        reached: dict[str, Similarity] = {}
        for each in ordered:
            if each.scene in found and each.other not in found:
                reached.setdefault(each.other, found[each.scene].after(each.similarity))
            elif each.other in found and each.scene not in found:
                reached.setdefault(each.scene, found[each.other].after(each.similarity.inverse()))
        if not reached:
            return found
        found |= reached


def _select_similarities(placed: _Placed) -> dict[str, Similarity]:
    return {scene: found for scene, (_, found) in placed.items()}
