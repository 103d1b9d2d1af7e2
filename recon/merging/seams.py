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
from splatnode.recon.merging.sight import Sight, depth_views, sight, surface_views
from splatnode.recon.merging.submap import Submap
from splatnode.recon.result.export.prepare import take

Mask = npt.NDArray[np.bool_]

_WITNESSES = 2  # cameras of another submap that must look through a Gaussian before it counts as a veil


def kept(submaps: Sequence[Submap]) -> tuple[Mask, ...]:
    """(N,) for each submap, which of its Gaussians stay."""
    if len(submaps) < 2:
        return tuple(np.ones(len(each.gaussians), bool) for each in submaps)
    views = [surface_views(each.gaussians, each.shell, each.cameras) for each in submaps]
    points = np.concatenate([each.gaussians.means for each in submaps])
    seen = [sight(each, points) for each in views]
    shell = np.concatenate([each.shell for each in submaps])
    mine = np.repeat(np.arange(len(submaps)), [len(each.gaussians) for each in submaps])
    stays = shell | ~(_better_elsewhere(points, mine, seen))
    stays &= ~_veils(mine, seen, shell)
    ends = np.cumsum([len(each.gaussians) for each in submaps])[:-1]
    return _without_near_shells(submaps, np.split(stays, ends))


def _better_elsewhere(points: npt.NDArray[np.floating], mine: npt.NDArray[np.intp], seen: Sequence[Sight]) -> Mask:
    """(M,) whether the region's owner is another submap, and has a surface at the point."""
    quality = np.stack([each.quality for each in seen], 1)
    owner = owners(regions(points, np.stack([each.resolution for each in seen], 1).max(1)), quality)
    on = np.stack([each.on for each in seen], 1)
    return (owner != NOBODY) & (owner != mine) & (on[np.arange(len(points)), owner] > 0)


def _veils(mine: npt.NDArray[np.intp], seen: Sequence[Sight], shell: Mask) -> Mask:
    """(M,) whether a Gaussian hangs before a surface of another submap which is better seen than it is itself.

    A shell is seen by nobody: one camera that looks through it is enough.
    """
    own_on = np.stack([each.on for each in seen], 1)[np.arange(len(mine)), mine]
    own_quality = np.stack([each.quality for each in seen], 1)[np.arange(len(mine)), mine]
    found = np.zeros(len(mine), bool)
    for number, each in enumerate(seen):
        others = mine != number
        through = (each.before >= _WITNESSES) & (each.before > each.on)
        better = (each.veiled > own_quality) | (each.before > own_on)
        found |= others & np.where(shell, each.before > 0, through & better)
    return found


def _without_near_shells(submaps: Sequence[Submap], stays: Sequence[Mask]) -> tuple[Mask, ...]:
    """The masks without the shells' Gaussians that hang before what another submap shows behind them.

    One submap after the other, each judged by what is left of the others: two shells never drop each other.
    """
    left = [mask.copy() for mask in stays]
    for number, each in enumerate(submaps):
        for other_number, other in enumerate(submaps):
            mine = np.flatnonzero(each.shell & left[number])
            if other_number == number or not len(mine) or not (other.shell & left[other_number]).any():
                continue
            views = depth_views(take(other.gaussians, left[other_number]), other.cameras)
            left[number][mine[sight(views, each.gaussians.means[mine]).before > 0]] = False
    return tuple(left)
