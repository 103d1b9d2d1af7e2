"""The weakest joint: what holds the two parts together into which the cameras fall most easily."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.components import connected_components
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration.register import Registration
from splatnode.recon.verification import epipolar_consistency

FITTING = 0.6  # share of a pair's matches that the poses explain, from which on the pair holds its frames together
FEW = 20  # matches that hold nothing together
TRIED = 3  # pairs across the joint in which patches are looked for, those with most points in common


@dataclass(frozen=True)
class Joint:
    """Two places that a few chance matches join are each right by themselves: only the joint tells."""

    group: tuple[int, ...]  # frames of the smaller part
    points: int  # that pairs of frames across the joint share, summed
    matches: int  # of the verified pairs across it
    explained: float  # of these, how many the poses explain
    patches: epipolar_consistency.Score  # across it


def weakest(
    registration: Registration,
    pairs: Mapping[tuple[int, int], TwoView],
    pictures: Mapping[int, epipolar_consistency.Picture],
    config: epipolar_consistency.Config,
) -> Joint:
    """The joint that is left last when cameras are put together in the order of the points that they share.

    Patches across it are looked for in what there is of `pictures`.
    """
    indices = [camera.index for camera in registration.cameras]
    shared = shared_points(registration)
    one, other = _two_parts(indices, shared)
    across = sorted(((i, j) for i in one for j in other), key=lambda pair: (-shared[pair], pair))
    scores = [
        epipolar_consistency.score(pictures[a], pictures[b], config)
        for i, j in across[:TRIED]
        for a, b in ((i, j), (j, i))
        if i in pictures and j in pictures
    ]
    verified = [key for i, j in across if (key := (min(i, j), max(i, j))) in registration.agreement]
    return Joint(
        group=tuple(sorted(min(one, other, key=len))),
        points=int(sum(shared[pair] for pair in across)),
        matches=sum(len(pairs[key].matches) for key in verified),
        explained=sum(registration.agreement[key] * len(pairs[key].matches) for key in verified),
        patches=epipolar_consistency.pooled(scores, config),
    )


def loose(registration: Registration, pairs: Mapping[tuple[int, int], TwoView]) -> tuple[int, ...]:
    """Frames outside the largest group that fitting pairs hold together.

    Frames that pose as others, as mirror images of a symmetric place do, fit well with each other, and with the rest
    only where the place repeats.
    """
    fitting = [
        key
        for key, share in registration.agreement.items()
        if share >= FITTING and share * len(pairs[key].matches) >= FEW
    ]
    _, *rest = connected_components([camera.index for camera in registration.cameras], fitting)
    return tuple(sorted(index for part in rest for index in part))


def shared_points(registration: Registration) -> npt.NDArray[np.int64]:
    """(M, M) how many points each two frames both observe."""
    size = max(camera.index for camera in registration.cameras) + 1
    seen = np.zeros((size, len(registration.points)), np.int64)
    seen[registration.observed_by, registration.observed_point] = 1
    return seen @ seen.T


def _two_parts(indices: list[int], shared: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """The frames without the last of the links that join all, strongest first: the larger part and the rest."""
    links = sorted(
        ((i, j) for place, i in enumerate(indices) for j in indices[:place]),
        key=lambda pair: (-shared[pair], pair),
    )
    taken: list[tuple[int, int]] = []
    for link in links:
        parts = connected_components(indices, [*taken, link])
        if len(parts) == 1:
            break
        taken.append(link)
    first, *rest = connected_components(indices, taken)
    return first, [index for part in rest for index in part]
