"""How well it is known where the lens shows a ray."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.estimate import Estimate
from splatnode.capture.calibration.projection import project_points
from splatnode.capture.lenses import lens as lenses

Array = npt.NDArray[np.float64]

_SAME_PX = 0.01  # a ray is a pixel's if the lens sees it so near: a lens that folds the picture has none for some


def pixel_sigmas(estimate: Estimate, pixels: Array) -> Array:
    """(K,) standard deviations, in pixels, of where the rays of `pixels` (K, 2) are seen: both directions together.

    The lens's covariance, carried to the picture. Not a number where the lens shows no ray.
    """
    sigmas = np.full(len(pixels), np.nan)
    rays = lenses.unproject(pixels, estimate.lens)
    there = np.flatnonzero(np.isfinite(rays).all(axis=1))
    apart = np.linalg.norm(lenses.project(rays[there], estimate.lens) - pixels[there], axis=1)
    seen = there[apart < _SAME_PX]
    by_lens = project_points(rays[seen], estimate.solution.numbers, estimate.model.kind).by_lens
    variances = np.einsum("kip,pq,kiq->k", by_lens, estimate.covariance, by_lens)
    sigmas[seen] = np.sqrt(np.maximum(variances, 0.0))
    return sigmas
