"""What all attempts at a map share: views, lenses, verified pairs, tracks. And what a map under way is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle, resection, tracks

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Pairs = Mapping[tuple[int, int], TwoView]


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the mapper sees it."""

    points: Array  # (M, 2) feature pixels relative to the principal point
    lens: int  # cameras with the same number share focal length and distortion
    longer_side: int


@dataclass(frozen=True, eq=False)
class Lens:
    focals: tuple[float, ...]  # candidates in pixels, most likely first
    sigma: float  # of log focal around the candidate; 0 means that it is known
    radial: float = 0.0


@dataclass(frozen=True, eq=False)
class Survey:
    views: tuple[View, ...]
    lenses: tuple[Lens, ...]
    pairs: Pairs
    scale: Array  # (C,) longer side of each view over 1024: limits are in pixels at that size
    coarse: tracks.Tracks  # few, for the map while it grows
    fine: tracks.Tracks  # for the map in the end


@dataclass(frozen=True, eq=False)
class Growth:
    """A map under way. The problem numbers the cameras as the survey does; those not registered mean nothing."""

    registered: tuple[int, ...]  # the first is held still
    problem: bundle.Problem
    prior: bundle.LensPrior
    track_of_point: Index  # (P,)


def survey(
    views: Sequence[View], lenses: Sequence[Lens], pairs: Pairs, growing_tracks: int, final_tracks: int
) -> Survey:
    """The survey of `views`, with at most so many tracks a view while the map grows, and in the end."""
    every = tracks.build([view.points for view in views], pairs)
    return Survey(
        views=tuple(views),
        lenses=tuple(lenses),
        pairs=pairs,
        scale=np.array([view.longer_side for view in views]) / 1024.0,
        coarse=tracks.thin(every, len(views), growing_tracks),
        fine=tracks.thin(every, len(views), final_tracks),
    )


def pair_errors(of: Survey, growth: Growth) -> dict[tuple[int, int], Array]:
    """Sampson errors of the matches of all pairs of registered views, pixels at 1024 px on the longer side."""
    return {
        key: resection.pair_errors(growth.problem, key, pair) / of.scale[key[0]]
        for key, pair in of.pairs.items()
        if key[0] in growth.registered and key[1] in growth.registered
    }


def agreement(of: Survey, growth: Growth, max_error_px: float) -> dict[tuple[int, int], float]:
    """The share of each pair's matches that the map explains."""
    return {key: float((errors < max_error_px).mean()) for key, errors in pair_errors(of, growth).items()}


def difference(one: Growth, other: Growth) -> tuple[float, float]:
    """The largest turn of a camera that both maps have, degrees, and the largest difference of a log focal.

    Each map has a world of its own: the turn from one to the other must be the same for every camera.
    """
    members = sorted(set(one.registered) & set(other.registered))
    if not members:
        return 0.0, 0.0
    turns = one.problem.rotations[members].transpose(0, 2, 1) @ other.problem.rotations[members]
    cosine = (np.trace(turns[0].T @ turns, axis1=1, axis2=2) - 1.0) / 2.0
    turned = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
    return turned, float(np.abs(one.problem.log_focals - other.problem.log_focals).max())
