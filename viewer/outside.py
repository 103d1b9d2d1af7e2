"""A scene seen from outside of its far shell, which would hide all that it surrounds: it is not drawn then."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.sources import SHELL


def cull_far_shell(gaussians: GaussianArrays, eye: npt.NDArray[np.floating]) -> GaussianArrays:
    """Those that a viewer at `eye` (3,) is to see: all, or where it is outside of the far shell, all but that.

    Of a file that does not tell which these are, all.
    """
    shell = gaussians.source_frame == SHELL
    if not shell.any() or shell.all():
        return gaussians
    centre, radius = _fit_sphere(gaussians.means[shell].astype(np.float64))
    inside = float(np.linalg.norm(np.asarray(eye, np.float64) - centre)) < radius
    return gaussians if inside else select_gaussians(gaussians, ~shell)


def _fit_sphere(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Centre (3,) and radius of the sphere on which the points (N, 3) lie, by least squares.

    |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre c and in what is left.
    """
    middle = points.mean(0)
    there = points - middle
    unknowns = np.column_stack([2.0 * there, np.ones(len(there))])
    solution = np.linalg.lstsq(unknowns, (there * there).sum(1), rcond=None)[0]
    centre = solution[:3]
    return centre + middle, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))
