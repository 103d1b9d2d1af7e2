"""How much the answer depends on single parts of the pictures: it is found again without each of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle
from splatnode.recon.verification import refit

Array = npt.NDArray[np.float64]

GROUPS = 4  # in which the points are divided, each way: the quarters of a picture


@dataclass(frozen=True)
class JackknifeSpread:
    """Standard errors by the delete-a-group jackknife (Efron 1982), the points grouped by where they are.

    Neighbours err together: by distortion that is not modelled, by things that moved, by wrong matches of a structure
    that repeats. The covariance takes errors for independent and is several times too small; leaving out whole regions
    lets them show.
    """

    rotation_deg: tuple[float, ...]  # of each camera, after the best common rotation
    centre: tuple[float, ...]  # of each camera, after the best similarity, in the unit of the world
    focal_rel: tuple[float, ...]  # of the logarithm of each lens' focal length


def estimate_spread(fit: refit.BundleFit) -> JackknifeSpread:
    """The spread when quarters of the points are left out: columns, rows, corners and depths in turn."""
    whole = refit.adjust(fit)
    rotations, centres, focals = [], [], []
    for groups in _group_points(fit.problem):
        moved = [
            refit.compute_camera_shifts(whole, refit.adjust(refit.remove_points(whole, groups == group)))
            for group in range(GROUPS)
        ]
        rotations.append(_compute_variance([each.rotation_deg for each in moved]))
        centres.append(_compute_variance([each.centre for each in moved]))
        focals.append(_compute_variance([each.focals_rel for each in moved]))
    return JackknifeSpread(
        rotation_deg=tuple(np.sqrt(np.mean(rotations, axis=0)).tolist()),
        centre=tuple(np.sqrt(np.mean(centres, axis=0)).tolist()),
        focal_rel=tuple(np.sqrt(np.mean(focals, axis=0)).tolist()),
    )


def _compute_variance(changes: Sequence[Array]) -> Array:
    """(C,) of what leaving out one group after the other changes."""
    return np.square(changes).sum(0) * (GROUPS - 1) / GROUPS


def _group_points(problem: bundle.Problem) -> Iterator[npt.NDArray[np.int64]]:
    """(P,) groups, by the picture in which a point is seen first."""
    first = np.full(len(problem.points), -1)
    order = np.arange(len(problem.pixels))[::-1]
    first[problem.point_of[order]] = order
    pixels, camera = problem.pixels[first], problem.camera_of[first]
    depths = np.einsum("pi,pi->p", problem.rotations[camera, 2], problem.points) + problem.translations[camera, 2]
    yield _assign_quarters(pixels[:, 0])
    yield _assign_quarters(pixels[:, 1])
    yield 2 * (pixels[:, 0] > np.median(pixels[:, 0])) + (pixels[:, 1] > np.median(pixels[:, 1]))
    yield _assign_quarters(depths)


def _assign_quarters(values: Array) -> npt.NDArray[np.int64]:
    """(P,) in which quarter of `values` (P,) each of them is."""
    return GROUPS * np.argsort(np.argsort(values)) // max(1, len(values))
