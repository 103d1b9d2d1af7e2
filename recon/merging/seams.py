"""Which Gaussians of each submap stay where submaps overlap.

A region stays with the submap that sees it best. Another submap's Gaussian goes only where the better one has a surface
itself: so no hole opens. What hangs before a surface that another submap sees, as a far shell does when the walk goes
on through it, goes too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.merging.regions import NOBODY, owners, regions
from splatnode.recon.merging.sight import DepthView, PointVisibility, depth_views, measure_visibility, surface_views
from splatnode.recon.merging.submap import Submap
from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.export.quaternions import matrices_from_quats
from splatnode.recon.result.snapshot import GaussianArrays

Mask = npt.NDArray[np.bool_]

_BODY = (-1.5, 0.0, 1.5)  # standard deviations at which a Gaussian of a far shell is looked at, along it
_WITNESSES = 2  # cameras of another submap that must look through a Gaussian before it counts as a veil


def resolve_seams(submaps: Sequence[Submap]) -> tuple[Mask, ...]:
    """(N,) for each submap, which of its Gaussians stay."""
    if len(submaps) < 2:
        return tuple(np.ones(len(each.gaussians), bool) for each in submaps)
    views = [surface_views(each.gaussians, each.shell, each.cameras) for each in submaps]
    points = np.concatenate([each.gaussians.means for each in submaps])
    seen = [measure_visibility(each, points) for each in views]
    shell = np.concatenate([each.shell for each in submaps])
    mine = np.repeat(np.arange(len(submaps)), [len(each.gaussians) for each in submaps])
    stays = shell | ~(_find_better_elsewhere(points, mine, seen))
    stays &= ~_find_occluders(mine, seen)
    ends = np.cumsum([len(each.gaussians) for each in submaps])[:-1]
    left = np.split(stays, ends)
    for number, each in enumerate(submaps):
        for other, its_views in enumerate(views):
            if other != number:
                left[number] &= ~_find_floaters(each.gaussians, each.shell & left[number], its_views)
    return _remove_near_shells(submaps, left)


def _find_better_elsewhere(
    points: npt.NDArray[np.floating], mine: npt.NDArray[np.intp], seen: Sequence[PointVisibility]
) -> Mask:
    """(M,) whether the region's owner is another submap, and has a surface at the point."""
    quality = np.stack([each.quality for each in seen], 1)
    owner = owners(regions(points, np.stack([each.resolution for each in seen], 1).max(1)), quality)
    on = np.stack([each.on for each in seen], 1)
    return (owner != NOBODY) & (owner != mine) & (on[np.arange(len(points)), owner] > 0)


def _find_occluders(mine: npt.NDArray[np.intp], seen: Sequence[PointVisibility]) -> Mask:
    """(M,) whether a Gaussian hangs before a surface of another submap which is better seen than it is itself."""
    own_on = np.stack([each.on for each in seen], 1)[np.arange(len(mine)), mine]
    own_quality = np.stack([each.quality for each in seen], 1)[np.arange(len(mine)), mine]
    found = np.zeros(len(mine), bool)
    for number, each in enumerate(seen):
        others = mine != number
        through = (each.before >= _WITNESSES) & (each.before > each.on)
        better = (each.veiled > own_quality) | (each.before > own_on)
        found |= others & through & better
    return found


def _find_floaters(gaussians: GaussianArrays, which: Mask, views: Sequence[DepthView]) -> Mask:
    """(N,) whether a Gaussian of `which` (N,) hangs with any part before what one of the `views` has as its surface.

    It is for a far shell: that is large, and nobody has seen it, so one camera that looks through it is enough.
    """
    chosen = np.flatnonzero(which)
    part = select_gaussians(gaussians, chosen)
    axes = matrices_from_quats(part.quats) * part.scales[:, None]  # (M, 3, 3), columns
    steps = np.array([[a, b, 0.0] for a in _BODY for b in _BODY])
    steps = np.take_along_axis(steps[None], np.argsort(np.argsort(-part.scales, 1), 1)[:, None], 2)  # (M, 9, 3)
    body = part.means[:, None] + steps @ axes.transpose(0, 2, 1)
    found = np.zeros(len(gaussians), bool)
    found[chosen] = (
        (measure_visibility(views, body.reshape(-1, 3)).before > 0).reshape(len(chosen), len(_BODY) ** 2).any(1)
    )
    return found


def _remove_near_shells(submaps: Sequence[Submap], stays: Sequence[Mask]) -> tuple[Mask, ...]:
    """The masks without the shells' Gaussians that hang before what another submap shows behind them.

    One submap after the other, each judged by what is left of the others: two shells never drop each other.
    """
    left = [mask.copy() for mask in stays]
    for number, each in enumerate(submaps):
        for other_number, other in enumerate(submaps):
            mine = each.shell & left[number]
            if other_number == number or not mine.any() or not (other.shell & left[other_number]).any():
                continue
            views = depth_views(select_gaussians(other.gaussians, left[other_number]), other.cameras)
            left[number] &= ~_find_floaters(each.gaussians, mine, views)
    return tuple(left)
