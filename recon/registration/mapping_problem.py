"""The mapping problem (views, lenses, verified pairs, tracks), and a partial map: a solution under way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment, triangulation

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pair = tuple[int, int]
Pairs = Mapping[Pair, TwoView]


@dataclass(frozen=True, eq=False)
class MapperView:
    """A frame as the mapper sees it."""

    points: Array  # (M, 2) feature pixels relative to the principal point
    lens: int  # views with the same number share focal length, distortion and principal point
    longer_side: int  # pixels


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens as it is known before its views are mapped."""

    focals: tuple[float, ...]  # candidates in pixels, the most likely first
    sigma: float  # of log focal around the candidate; 0: it is calibrated
    radial: tuple[float, float] = (0.0, 0.0)  # radial coefficients


@dataclass(frozen=True, eq=False)
class MapperInput:
    """The input that all attempts at a map share: C views, G lenses, verified pairs and tracks."""

    views: tuple[MapperView, ...]
    lenses: tuple[Lens, ...]
    pairs: Pairs  # by the positions of their views (i < j)
    scale: Array  # (C,) longer side of each view over REFERENCE_SIDE, at which thresholds in pixels hold
    growing_tracks: triangulation.Tracks  # some, for the time while views are added
    final_tracks: triangulation.Tracks  # more, for the last adjustment


@dataclass(frozen=True, eq=False)
class PartialMap:
    """A map under way. Its estimate has all C views of the problem as cameras; only the registered ones are valid."""

    registered: tuple[int, ...]  # views; the first one is the camera that adjustments fix
    estimate: bundle_adjustment.Problem
    prior: bundle_adjustment.LensPrior
    track_of_point: Index  # (P,) ascending


def prepare(
    views: Sequence[MapperView], lenses: Sequence[Lens], pairs: Pairs, max_growing_tracks: int, max_final_tracks: int
) -> MapperInput:
    """The mapping problem of `views`, with about so many tracks a view while views are added, and in the end."""
    every = triangulation.build([view.points for view in views], pairs)
    return MapperInput(
        views=tuple(views),
        lenses=tuple(lenses),
        pairs=pairs,
        scale=np.array([view.longer_side for view in views]) / REFERENCE_SIDE,
        growing_tracks=triangulation.thin(every, max_growing_tracks),
        final_tracks=triangulation.thin(every, max_final_tracks),
    )


def difference(one: PartialMap, other: PartialMap) -> tuple[float, float]:
    """The largest rotation between the views that both maps have, degrees, and the largest change of a log focal.

    Each map has a world frame of its own: the rotation from one frame to the other, as the first common view gives it,
    is taken out.
    """
    common = sorted(set(one.registered) & set(other.registered))
    if not common:
        return 0.0, 0.0
    rotations = one.estimate.rotations[common].transpose(0, 2, 1) @ other.estimate.rotations[common]
    cosine = (np.trace(rotations[0].T @ rotations, axis1=1, axis2=2) - 1.0) / 2.0
    rotation_deg = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
    return rotation_deg, float(np.abs(one.estimate.log_focals - other.estimate.log_focals).max())
