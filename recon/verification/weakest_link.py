"""The weakest link: the last edge of the maximum spanning tree of the cameras, over the points that pairs share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.components import find_components
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration.register import Registration

MIN_CONSISTENT_SHARE = 0.6  # of a pair's matches that the poses explain, for it to connect its frames
MIN_CONSISTENT_MATCHES = 20  # that the poses explain, for a pair to connect its frames


@dataclass(frozen=True)
class WeakestLink:
    """Two places that a few chance matches connect are each right by themselves: only what connects them tells."""

    smaller_part: tuple[str, ...]  # its keyframes, by name
    shared_points: int  # of the pairs of frames across the link, summed
    matches: int  # of the verified pairs across it
    inliers: float  # of these, how many the poses explain

    @property
    def inlier_ratio(self) -> float:
        """Returns the share of the matches across the link that the poses explain; 0 without any."""
        return float(self.inliers / np.maximum(1, self.matches))  # NaN where one of them is


def measure_weakest_link(
    registration: Registration,
    names: Sequence[str],
    pairs: Mapping[tuple[int, int], TwoView],
) -> WeakestLink:
    """Measures the link between the two parts that the last edge of the maximum spanning tree joins.

    `names` are those of all keyframes.
    """
    indices = [camera.index for camera in registration.cameras]
    shared = count_shared_points(registration)
    one, other = _split_at_weakest_link(indices, shared)
    across = [(i, j) for i in one for j in other]
    verified = [key for i, j in across if (key := (min(i, j), max(i, j))) in registration.inlier_ratios]
    return WeakestLink(
        smaller_part=tuple(names[index] for index in sorted(min(one, other, key=len))),
        shared_points=int(sum(shared[pair] for pair in across)),
        matches=sum(len(pairs[key].matches) for key in verified),
        inliers=sum(registration.inlier_ratios[key] * len(pairs[key].matches) for key in verified),
    )


def find_disconnected_frames(registration: Registration, pairs: Mapping[tuple[int, int], TwoView]) -> tuple[int, ...]:
    """Keyframes, by position, outside the largest component of geometrically consistent pairs.

    Frames that pose as others, as mirror images of a symmetric place do, fit well with each other, and with the rest
    only where the place repeats.
    """
    consistent = [
        key
        for key, share in registration.inlier_ratios.items()
        if share >= MIN_CONSISTENT_SHARE and share * len(pairs[key].matches) >= MIN_CONSISTENT_MATCHES
    ]
    _, *rest = find_components([camera.index for camera in registration.cameras], consistent)
    return tuple(sorted(index for part in rest for index in part))


def count_shared_points(registration: Registration) -> npt.NDArray[np.int64]:
    """(M, M) how many points each two frames both observe."""
    size = max(camera.index for camera in registration.cameras) + 1
    seen = np.zeros((size, len(registration.points)), np.int64)
    seen[registration.observed_by, registration.observed_point] = 1
    return seen @ seen.T


def _split_at_weakest_link(indices: list[int], shared: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """The parts without the edge that Kruskal's algorithm adds last, most shared points first: the larger, the rest."""
    links = sorted(
        ((i, j) for place, i in enumerate(indices) for j in indices[:place]),
        key=lambda pair: (-shared[pair], pair),
    )
    taken: list[tuple[int, int]] = []
    for link in links:
        parts = find_components(indices, [*taken, link])
        if len(parts) == 1:
            break
        taken.append(link)
    first, *rest = find_components(indices, taken)
    return first, [index for part in rest for index in part]
