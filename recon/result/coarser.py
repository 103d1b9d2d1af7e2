"""Levels of detail: fewer, larger Gaussians that look the same from far enough away.

The Gaussians of a voxel become one with their moments: its mass (opacity times area), its centre, its covariance and
its colour are theirs, weighted by mass. A centre moves by at most .87 of the voxel's side (half its diagonal), so from
a distance of `focal * side` on the error stays below a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.export.quaternions import matrices_from_quats, quats_from_matrices
from splatnode.recon.result.snapshot import GaussianArrays

Array = npt.NDArray[np.float64]

FEWER = 4  # times as few Gaussians on each further level
FEWEST = 500  # Gaussians that are worth a coarser level
_SMALL = 1.0  # standard deviation over a voxel's side up to which a Gaussian is merged; larger ones stay as they are
_LARGE = 16.0  # times the median extent
_STEP = 2**0.5  # by which voxels grow until a level has few enough Gaussians
_MOST_STEPS = 60
_MOST_OPAQUE = 0.99
_COVERING = 0.8  # standard deviation over a voxel's side with which neighbours cover a surface without gaps
_LEAST_OPAQUE = 1e-3


@dataclass(frozen=True, eq=False)
class DetailLevel:
    """Coarse Gaussians, and how far away they suffice."""

    gaussians: GaussianArrays
    side: float  # of the voxels, in the scene's unit

    def compute_min_distance(self, focal_px: float) -> float:
        """How far away a camera of this focal length must be for errors below a pixel."""
        return focal_px * self.side


def make_detail_levels(gaussians: GaussianArrays, most: int = 2) -> tuple[DetailLevel, ...]:
    """At most `most` levels, each with a quarter of the Gaussians of the one before, or fewer, finest first.

    What is large, as a far shell, stays in all of them and is not counted. There are fewer levels where the scene is
    small or merges no further.
    """
    found: list[DetailLevel] = []
    finer, side = gaussians, _choose_first_side(gaussians)
    large = int((gaussians.scales.max(1) > _LARGE * side).sum()) if len(gaussians) else 0
    while len(found) < most and len(finer) - large >= FEWER * FEWEST:
        wanted = large + (len(finer) - large) // FEWER
        for _ in range(_MOST_STEPS):
            coarse = merge_by_voxel(gaussians, side)
            if len(coarse) <= wanted:
                break
            side *= _STEP
        else:
            break
        found.append(DetailLevel(coarse, side))
        finer = coarse
    return tuple(found)


def merge_by_voxel(gaussians: GaussianArrays, side: float) -> GaussianArrays:
    """The Gaussians with those of one voxel of this `side` merged into one; larger ones stay.

    The merged ones come from no frame (source_frame -1). Raises ValueError for a side that is not above 0.
    """
    if not side > 0:
        raise ValueError(f"side must be above 0, got {side}")
    small = gaussians.scales.max(1) <= _SMALL * side if len(gaussians) else np.zeros(0, bool)
    cells = np.floor(gaussians.means[small] / side).astype(np.int64)
    _, voxel, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.reshape(-1)
    alone = counts[voxel] == 1
    merged = np.flatnonzero(small)[~alone]
    stays = np.ones(len(gaussians), bool)
    stays[merged] = False
    if not len(merged):
        return gaussians
    _, group = np.unique(voxel[~alone], return_inverse=True)
    return concatenate_gaussians(
        [
            select_gaussians(gaussians, stays),
            _merge_groups(select_gaussians(gaussians, merged), group.reshape(-1), side),
        ]
    )


def concatenate_gaussians(parts: Iterable[GaussianArrays]) -> GaussianArrays:
    """All Gaussians of `parts`, in order; lower degrees of spherical harmonics are filled up with zeros."""
    every = list(parts) or [GaussianArrays.empty()]
    bases = max(part.sh.shape[1] for part in every)
    filled = [replace(part, sh=np.pad(part.sh, ((0, 0), (0, bases - part.sh.shape[1]), (0, 0)))) for part in every]
    names = [field.name for field in fields(GaussianArrays)]
    return GaussianArrays(*(np.concatenate([getattr(part, name) for part in filled]) for name in names))


def _choose_first_side(gaussians: GaussianArrays) -> float:
    """The median extent: smaller voxels hold hardly more than one Gaussian each."""
    return float(np.median(gaussians.scales.max(1))) if len(gaussians) else 1.0


def _merge_groups(gaussians: GaussianArrays, group: npt.NDArray[np.intp], side: float) -> GaussianArrays:
    """One Gaussian for each group 0, 1 ... with the moments of those in it.

    One that would have to be more than opaque to have their mass is wider instead, as far as it still is one of a
    voxel: many small ones that cover a surface, one beside the other, would else become one with gaps around it.
    """
    count = int(group.max()) + 1
    areas = _areas(gaussians.scales.astype(np.float64))
    mass = gaussians.opacities * areas
    total = np.bincount(group, mass, count)

    def mean(values: Array) -> Array:
        """(count, ...) of `values` (N, ...), weighted by mass."""
        flat = values.reshape(len(values), -1)
        sums = np.stack([np.bincount(group, mass * column, count) for column in flat.T], 1)
        return (sums / total[:, None]).reshape(count, *values.shape[1:])

    means = gaussians.means.astype(np.float64)
    centres = mean(means)
    axes = matrices_from_quats(gaussians.quats) * gaussians.scales[:, None]
    offsets = means - centres[group]
    covariances = mean(axes @ axes.transpose(0, 2, 1) + offsets[:, :, None] * offsets[:, None])
    variances, directions = np.linalg.eigh(covariances)
    directions[:, :, 0] *= np.sign(np.linalg.det(directions))[:, None]
    scales = np.sqrt(np.maximum(variances, 1e-18))
    surplus = np.sqrt(np.maximum(total / (_MOST_OPAQUE * _areas(scales)), 1.0))
    wider = np.minimum(surplus[:, None] * scales, np.maximum(_COVERING * side, scales))
    scales[:, 1:] = wider[:, 1:]  # of rising variances, the first is the thickness
    return GaussianArrays(
        means=centres.astype(np.float32),
        quats=quats_from_matrices(directions).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=np.clip(total / _areas(scales), _LEAST_OPAQUE, _MOST_OPAQUE).astype(np.float32),
        sh=mean(gaussians.sh.astype(np.float64)).astype(np.float32),
        source_frame=np.full(count, -1, np.int32),
    )


def _areas(scales: Array) -> Array:
    """(N,) the largest area that an ellipsoid of semi-axes (N, 3) shows, but for a factor of pi."""
    _, middle, largest = np.sort(scales, axis=1).T
    return middle * largest
