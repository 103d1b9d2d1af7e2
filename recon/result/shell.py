"""Which Gaussians of a finished scene are its far shell (`recon.scene.background`): files do not say.

They are told by what the shell is: Gaussians on a sphere around the cameras that see as much of the sky each, thin
across it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

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
