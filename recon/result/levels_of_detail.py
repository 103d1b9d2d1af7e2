"""Levels of detail: fewer, larger Gaussians that look the same from far enough away.

The Gaussians of a voxel become one with their moments: its mass (opacity times area), its centre, its covariance and
its colour are theirs, weighted by mass. A centre moves by at most .87 of the voxel's side (half its diagonal), so from
a distance of `focal * side` on the error stays below a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.placement import matrices_from_quats, quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot, find_confirmed

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


# levels.json: which coarser files of a scene there are, and from how far away each suffices.

LEVELS_FILE = "levels.json"
_FOCAL = 500.0  # pixels, where there is no camera


def make_levels_record(levels: Sequence[DetailLevel], cameras: Sequence[CameraEstimate]) -> dict[str, object]:
    """Makes the record of the `levels`, finest first, for levels.json and report.json.

    `from_distance`, in the file's unit, is where a camera of `focal_px`, the longest of the scene's, begins to see
    errors below a pixel; for another focal length it is longer or shorter in proportion.
    """
    focal = max((float(camera.K[0, 0]) for camera in cameras), default=_FOCAL)
    return {
        "focal_px": focal,
        "levels": [
            {
                "file": f"levels/{number}.ply",
                "num_gaussians": len(level.gaussians),
                "voxel": level.side,
                "from_distance": level.compute_min_distance(focal),
            }
            for number, level in enumerate(levels, 1)
        ],
    }


# only_seen: a snapshot without its guesses.


def remove_unconfirmed(snapshot: Snapshot) -> Snapshot:
    """The snapshot without Gaussians at depths that no two photographs confirm, and without the far shell."""
    return replace(
        snapshot, gaussians=select_gaussians(snapshot.gaussians, find_confirmed(snapshot.gaussians.source_frame))
    )


# Which Gaussians of a finished scene are its far shell (`recon.scene.background`): files do not say.
#
# They are told by what the shell is: Gaussians on a sphere around the cameras that see as much of the sky each, thin
# across it.

EXTENT, THICKNESS = 0.7, 0.1  # as splatnode.recon.scene.background has them, which needs torch
_SPACING_DEG = 4.0, 25.0  # of the shell's Gaussians: 5, and more where a limit on their number bound it
_THINNER = 2.0  # largest factor between the thickness of a shell's Gaussian, which was refined, and what it began with
_FEWEST = 24  # Gaussians of a shell; fewer that look like it are none
_SMALLER = 1.5  # by which refinement may have made the extent of one smaller
_SAME_RADIUS = 0.03  # by how much of the radius those may be off it that no longer look like the shell
_ONE_RADIUS = 0.1  # by how much of the shell's radius its Gaussians may be off their median


def find_far_shell(gaussians: GaussianArrays, cameras: Sequence[CameraEstimate]) -> npt.NDArray[np.bool_]:
    """(N,) which Gaussians are the shell; none where there is no shell."""
    nowhere = np.zeros(len(gaussians), bool)
    if not cameras or not len(gaussians):
        return nowhere
    centre = np.mean([camera.T_world_camera[:3, 3] for camera in cameras], axis=0)
    distances = np.linalg.norm(gaussians.means - centre, axis=1)
    thin, first, second = np.sort(gaussians.scales, axis=1).T
    least, most = (EXTENT * np.radians(degrees) for degrees in _SPACING_DEG)
    apart = np.maximum(distances, 1e-12)
    alike = (first / apart >= least) & (second / apart <= most) & (second <= _THINNER * first)
    alike &= (thin <= _THINNER * THICKNESS * second) & (thin >= THICKNESS / _THINNER * first)
    candidates = distances[alike & (distances > np.median(distances))]
    if len(candidates) < _FEWEST:
        return nowhere
    # Pieces of the sky, which are nearer, may look like it: the shell is the largest number at one distance.
    edges = np.geomspace(candidates.min() * (1 - 1e-6), candidates.max() * (1 + 1e-6), _count_edges(candidates))
    counts, _ = np.histogram(candidates, edges)
    fullest = int(counts.argmax())
    if counts[fullest] < _FEWEST:
        return nowhere
    there = candidates[(candidates >= edges[fullest]) & (candidates <= edges[fullest + 1])]
    radius = float(np.median(there))
    off, large = np.abs(distances - radius) / radius, second / apart >= least / _SMALLER
    return (alike & (off <= _ONE_RADIUS)) | (large & (off <= _SAME_RADIUS))


def _count_edges(distances: npt.NDArray[np.floating]) -> int:
    """So many edges that neighbouring ones are about a tenth apart."""
    return max(2, int(np.log(distances.max() / distances.min()) / _ONE_RADIUS) + 2)
