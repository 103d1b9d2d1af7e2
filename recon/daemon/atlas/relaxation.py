"""Where scenes lie by links that do not quite agree: nonlinear least squares over similarities.

Each link says how one scene lies to another, and how well it knows; a cycle of links has something to share out. The
method is that of Levenberg and Marquardt, with sparse normal equations: scenes have few links.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from splatnode.recon.daemon.atlas.links import EdgeKind, PoseGraphEdge
from splatnode.recon.geometry import Similarity

_SIZE = 7  # parameters of a scene: rotation vector, translation, logarithm of the scale
_MOVE = 1e-6  # for numerical derivatives
_STEPS, _DAMPING, _ENOUGH = 100, 1e-4, 1e-6  # of the optimisation; it ends where a step gains so little of the cost

Array = npt.NDArray[np.float64]


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
