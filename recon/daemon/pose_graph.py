"""The graph of scenes: where each lies in the map that it belongs to, by all links together.

Scenes are nodes, links are edges. What the links of a cycle do not agree on, the drift of scale among it, is shared out
by their uncertainties (Strasdat et al., "Scale drift-aware large scale monocular SLAM", RSS 2010). A loop that the
others contradict is left out, and said to be.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius

# How two scenes lie to each other: by cameras that both have, or by a bridge of photographs that show the same.

MIN_SHARED = 3  # cameras that two scenes must share, so that one that is wrong shows
# What no link is surer of, however well its few cameras agree: what the scenes themselves are wrong by.
LEAST_DEG, LEAST_RELATIVE = 0.1, 0.003  # of the rotation; of the scale, and of the position over the cameras' spread
MOST_DEG, MOST_RELATIVE = 3.0, 0.1  # that cameras may differ by and still lie alike, likewise

Array = npt.NDArray[np.float64]
Cameras = Mapping[str, Array]  # T_world_camera (4, 4) by the names of the photographs


class EdgeKind(enum.Enum):
    CHAIN = "chain"  # the one scene goes on where the other was full: they have photographs in common
    LOOP = "loop"  # the camera came back: photographs of the one show what those of the other show


class PoseGraphEdge(msgspec.Struct, frozen=True, kw_only=True):
    """A point x of scene `other` lies at scale * rotation @ x + translation in `scene`."""

    kind: EdgeKind = EdgeKind.CHAIN
    scene: str  # scene_id
    other: str
    scale: float
    rotation: tuple[tuple[float, ...], ...]  # (3, 3), row by row
    translation: tuple[float, ...]  # (3,), in the unit of `scene`
    shared: tuple[str, ...]  # photographs that both scenes have a camera of, or that bridge them
    rotation_deg: float  # by how much those cameras' directions differ afterwards, at most
    centre_percent: float | None  # RMS of what their positions differ by, of their spread; None: they do not move
    centre: tuple[float, ...] = (0.0, 0.0, 0.0)  # (3,) the mean of their positions, in `scene`
    sigma_deg: float = LEAST_DEG  # standard deviations: of the rotation,
    sigma_scale: float = LEAST_RELATIVE  # of the logarithm of the scale,
    sigma_position: float = LEAST_RELATIVE  # and of the position of `centre`, in the unit of `scene`
    why: str = ""  # it was taken
    retracted: str | None = None  # why it does not count after all

    @property
    def similarity(self) -> Similarity:
        """From the world of `other` to that of `scene`."""
        return Similarity(self.scale, np.array(self.rotation), np.array(self.translation))


@dataclass(frozen=True, eq=False)
class _Alignment:
    """One set of cameras laid on another."""

    similarity: Similarity
    rotation_deg: float  # most that a direction differs by afterwards
    centre_rms: float  # of what the positions differ by, in the target's unit
    extent: float  # of the positions in the target, likewise
    sigma_deg: float
    sigma_relative: float  # of the logarithm of the scale; of the mean position over `extent`

    @property
    def is_consistent(self) -> bool:
        """Whether both sets lie alike."""
        return self.rotation_deg <= MOST_DEG and self.centre_rms <= MOST_RELATIVE * self.extent


def make_chain_edge(scene: str, other: str, mine: Cameras, theirs: Cameras) -> PoseGraphEdge | None:
    """Makes the edge between two scenes by shared cameras. None if they share fewer than MIN_SHARED."""
    shared = [name for name in mine if name in theirs]
    if len(shared) < MIN_SHARED:
        return None
    target = np.stack([mine[name] for name in shared])
    fit = _align(np.stack([theirs[name] for name in shared]), target)
    why = f"{len(shared)} photographs are in both"
    return _make_edge(EdgeKind.CHAIN, scene, other, fit.similarity, [fit], target, shared, why)


def make_loop_edge(
    scene: str, other: str, mine: Cameras, theirs: Cameras, bridge: tuple[Cameras, Cameras], why: str
) -> PoseGraphEdge | None:
    """Makes the edge of a loop: `bridge` has cameras of both scenes in one world, first those of `scene`.

    None where fewer than MIN_SHARED of either have a camera in their scene, too, or have it elsewhere there.
    """
    names = [[name for name in ends if name in cameras] for ends, cameras in zip(bridge, (mine, theirs), strict=True)]
    if min(map(len, names)) < MIN_SHARED:
        return None
    target = np.stack([mine[name] for name in names[0]])
    to_mine = _align(np.stack([bridge[0][name] for name in names[0]]), target)
    to_theirs = _align(np.stack([bridge[1][name] for name in names[1]]), np.stack([theirs[name] for name in names[1]]))
    if not (to_mine.is_consistent and to_theirs.is_consistent):
        return None
    similarity = to_mine.similarity.after(to_theirs.similarity.inverse())
    return _make_edge(
        EdgeKind.LOOP, scene, other, similarity, [to_mine, to_theirs], target, [*names[0], *names[1]], why
    )


def transfer_edge(link: PoseGraphEdge, scene: str, before: Cameras, now: Cameras) -> PoseGraphEdge | None:
    """The link, after one of its scenes was made again: from the world in which its cameras lay `before` to that of
    `now`. None where they lie to each other otherwise now, or have too few in common.
    """
    names = [name for name in before if name in now]
    if len(names) < MIN_SHARED:
        return None
    fit = _align(np.stack([before[name] for name in names]), np.stack([now[name] for name in names]))
    if not fit.is_consistent:
        return None
    to_now, there, centre, position = fit.similarity, link.similarity, link.centre, link.sigma_position
    if link.scene == scene:
        there = to_now.after(there)
        centre = tuple(to_now(np.array(centre)).tolist())
        position *= to_now.scale
    else:
        there = there.after(to_now.inverse())
    return msgspec.structs.replace(
        link,
        scale=there.scale,
        rotation=tuple(tuple(row) for row in there.rotation.tolist()),
        translation=tuple(there.translation.tolist()),
        centre=centre,
        sigma_deg=max(link.sigma_deg, fit.sigma_deg),
        sigma_scale=max(link.sigma_scale, fit.sigma_relative),
        sigma_position=position,
    )


def _align(source: Array, target: Array) -> _Alignment:
    """Cameras `source` (C, 4, 4) laid on `target`."""
    found = align_cameras(source, target)
    turned = angles_deg(found.rotation @ source[:, :3, :3], target[:, :3, :3])
    rms = float(np.sqrt(((found(source[:, :3, 3]) - target[:, :3, 3]) ** 2).sum(1).mean()))
    extent = max(compute_rms_radius(target[:, :3, 3]), 1e-12)
    root = np.sqrt(len(source))
    relative = rms / extent / root
    sigma_deg = max(float(np.sqrt((turned**2).mean())) / root, LEAST_DEG)
    return _Alignment(found, float(turned.max()), rms, extent, sigma_deg, max(relative, LEAST_RELATIVE))


def _make_edge(
    kind: EdgeKind,
    scene: str,
    other: str,
    similarity: Similarity,
    fits: list[_Alignment],
    target: Array,
    names: list[str],
    why: str,
) -> PoseGraphEdge:
    relative = float(np.sqrt(sum(fit.sigma_relative**2 for fit in fits)))
    moving = all(fit.extent > 1e-9 for fit in fits)
    differ = max(fit.centre_rms / fit.extent for fit in fits)
    return PoseGraphEdge(
        kind=kind,
        scene=scene,
        other=other,
        scale=similarity.scale,
        rotation=tuple(tuple(row) for row in similarity.rotation.tolist()),
        translation=tuple(similarity.translation.tolist()),
        shared=tuple(names),
        rotation_deg=max(fit.rotation_deg for fit in fits),
        centre_percent=100 * differ if moving else None,
        centre=tuple(target[:, :3, 3].mean(0).tolist()),
        sigma_deg=float(np.sqrt(sum(fit.sigma_deg**2 for fit in fits))),
        sigma_scale=relative,
        sigma_position=relative * fits[0].extent,
        why=why,
    )


# Where scenes lie by links that do not quite agree: nonlinear least squares over similarities.
#
# Each link says how one scene lies to another, and how well it knows; a cycle of links has something to share out. The
# method is that of Levenberg and Marquardt, with sparse normal equations: scenes have few links.

_SIZE = 7  # parameters of a scene: rotation vector, translation, logarithm of the scale
_MOVE = 1e-6  # for numerical derivatives
_STEPS, _DAMPING, _ENOUGH = 100, 1e-4, 1e-6  # of the optimisation; it ends where a step gains so little of the cost


def solve_pose_graph(
    start: Mapping[str, Similarity], links: Sequence[PoseGraphEdge], hardest: float
) -> dict[str, Similarity]:
    """The scenes where the links are contradicted least; the first one stays where it is.

    A loop pulls no harder than one that is contradicted by `hardest` standard
    deviations (Huber's loss).
    """
    at, edges = _SimilarityArray.build(list(start.values())), _Edges.build(links, list(start), hardest)
    damping, cost = _DAMPING, edges.cost(edges.compute_deviations(at))
    for _ in range(_STEPS):
        ahead = at.apply_steps(_prepend_fixed(edges.step(at, damping)))
        further = edges.cost(edges.compute_deviations(ahead))
        if further < cost:
            gained, at, cost, damping = cost - further, ahead, further, damping / 10
            if gained < _ENOUGH * cost:
                break
        elif damping > 1.0:
            break
        else:
            damping *= 10
    return dict(zip(start, at.similarities(), strict=True))


def compute_deviations(at: Mapping[str, Similarity], links: Sequence[PoseGraphEdge]) -> Array:
    """(L,) the most standard deviations that each link differs by from where its scenes are."""
    if not links:
        return np.zeros(0)
    return np.abs(_Edges.build(links, list(at)).compute_deviations(_SimilarityArray.build(list(at.values())))).max(1)


def _prepend_fixed(parameters: Array) -> Array:
    """(N, 7) of all scenes, the first of which does not move."""
    return np.concatenate([np.zeros((1, _SIZE)), parameters.reshape(-1, _SIZE)])


@dataclass(frozen=True, eq=False)
class _SimilarityArray:
    """N similarities."""

    rotations: Array  # (N, 3, 3)
    translations: Array  # (N, 3)
    scales: Array  # (N,)

    @classmethod
    def build(cls, similarities: Sequence[Similarity]) -> _SimilarityArray:
        parts = zip(*((each.rotation, each.translation, each.scale) for each in similarities), strict=True)
        return cls(*(np.array(part, np.float64) for part in parts))

    def similarities(self) -> list[Similarity]:
        parts = zip(self.scales, self.rotations, self.translations, strict=True)
        return [Similarity(float(scale), rotation, translation) for scale, rotation, translation in parts]

    def apply_steps(self, moves: Array) -> _SimilarityArray:
        """Applies steps (N, 7): a rotation vector, a translation and a log scale each."""
        turned = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ self.rotations
        return _SimilarityArray(turned, self.translations + moves[:, 3:6], self.scales * np.exp(moves[:, 6]))

    def __getitem__(self, chosen: npt.NDArray[np.int64]) -> _SimilarityArray:
        return _SimilarityArray(self.rotations[chosen], self.translations[chosen], self.scales[chosen])

    def __call__(self, points: Array) -> Array:
        """The points (N, 3), each after its similarity."""
        return self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, points) + self.translations

    def apply_inverse(self, points: Array) -> Array:
        """The points (N, 3), each before its similarity."""
        return np.einsum("nji,nj->ni", self.rotations, points - self.translations) / self.scales[:, None]


@dataclass(frozen=True, eq=False)
class _Edges:
    """L links between scenes by their numbers."""

    scene: npt.NDArray[np.int64]  # (L,)
    other: npt.NDArray[np.int64]
    links: _SimilarityArray  # from the world of `other` to that of `scene`
    centres: Array  # (L, 3) in the world of `scene`
    sigmas: Array  # (L, 7) of the rotation vector, the position of the centre, the logarithm of the scale

    hardest: Array  # (L,) the standard deviations that each pulls with at most

    @classmethod
    def build(cls, links: Sequence[PoseGraphEdge], scenes: Sequence[str], hardest: float = math.inf) -> _Edges:
        sigmas = [[np.radians(each.sigma_deg)] * 3 + [each.sigma_position] * 3 + [each.sigma_scale] for each in links]
        return cls(
            np.array([scenes.index(each.scene) for each in links]),
            np.array([scenes.index(each.other) for each in links]),
            _SimilarityArray.build([each.similarity for each in links]),
            np.array([each.centre for each in links], np.float64),
            np.array(sigmas),
            np.array([hardest if each.kind is EdgeKind.LOOP else math.inf for each in links]),
        )

    def cost(self, contradictions: Array) -> float:
        """Returns the robust cost (Huber): quadratic up to `hardest` standard deviations, linear beyond."""
        distance = np.linalg.norm(contradictions, axis=1)
        near = np.minimum(distance, self.hardest)
        return float((near * (2 * distance - near)).sum())

    def step(self, at: _SimilarityArray, damping: float) -> Array:
        """The moves of all scenes but the first, in a row, that lessen the cost most as far as it is linear."""
        rows, columns = np.arange(len(self.scene)), len(at.scales)
        residuals = self.compute_deviations(at)
        distance = np.maximum(np.linalg.norm(residuals, axis=1), 1e-12)
        weights = np.sqrt(np.minimum(1.0, self.hardest / distance))[:, None]
        blocks = np.zeros((2, len(rows), _SIZE, _SIZE))  # derivatives by the moves of `scene`, and of `other`
        for each, move in itertools.product(range(_SIZE), (_MOVE, -_MOVE)):
            there = at.apply_steps(np.tile(move * np.eye(_SIZE)[each], (columns, 1)))
            blocks[0, :, :, each] += weights * self.compute_deviations(there, at) / (2 * move)
            blocks[1, :, :, each] += weights * self.compute_deviations(at, there) / (2 * move)
        ends = np.stack([self.scene, self.other])
        row, column = np.broadcast_arrays(
            _SIZE * rows[None, :, None, None] + np.arange(_SIZE)[:, None],
            _SIZE * ends[:, :, None, None] + np.arange(_SIZE),
        )
        shape = (_SIZE * len(rows), _SIZE * columns)
        jacobian = csr_array((blocks.ravel(), (row.ravel(), column.ravel())), shape)[:, _SIZE:]
        normal = (jacobian.T @ jacobian).tocsc()
        damped = normal + damping * diags_array(normal.diagonal(), format="csc")
        return -spsolve(damped, jacobian.T @ (weights * residuals).ravel())

    def compute_deviations(self, at: _SimilarityArray, others_at: _SimilarityArray | None = None) -> Array:
        """(L, 7) by how many standard deviations each link differs from where its scenes are.

        `others_at`: where the links' second scenes are, if that is not `at`.
        """
        scene, other = at[self.scene], (others_at or at)[self.other]
        rotations = np.einsum("nji,njk,nlk->nil", scene.rotations, other.rotations, self.links.rotations)
        turned = Rotation.from_matrix(rotations).as_rotvec()
        moved = scene.apply_inverse(other(self.links.apply_inverse(self.centres))) - self.centres
        grown = np.log(other.scales / scene.scales / self.links.scales)
        return np.concatenate([turned, moved, grown[:, None]], 1) / self.sigmas


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
    """The scenes by the links, all of which count; `hardest` as for `solve_pose_graph`."""
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
