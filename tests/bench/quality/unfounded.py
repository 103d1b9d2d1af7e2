"""Which Gaussians of a scene stand where nothing is, and how much of a picture they cover."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import transform_to_camera
from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.placement import matrices_from_quats
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays
from tests.bench.quality.known_surfaces import KnownSurfaces, lines_of_sight
from tests.bench.quality.viewpoints import Viewpoint

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LONG = 1 / 16  # of the picture's longer side: a footprint of that length, four standard deviations, is seen as long
SLENDER = 5.0  # times as long as wide: a footprint of that shape is seen as a needle
REACH = 1.5  # standard deviations along its longest axis to which a Gaussian is seen as a needle
COVERED = 0.25  # of a pixel's light comes from them, and
VISIBLE = 0.1  # its colour, in [0, 1], would change by that without them: both make a covered pixel
_SH_C0 = 0.5 / np.sqrt(np.pi)


@dataclass(frozen=True, eq=False)
class Footing:
    """(3, N) of the centre and the two ends of each Gaussian: where they stand, whoever looks."""

    points: Array  # (3, N, 3)
    through: Mask  # a camera looks through there
    on: Mask  # there is a surface


def footing(gaussians: GaussianArrays, known: KnownSurfaces) -> Footing:
    axes = matrices_from_quats(gaussians.quats.astype(np.float64))
    longest, rows = gaussians.scales.argmax(1), np.arange(len(gaussians))
    along = axes[rows, :, longest] * gaussians.scales[rows, longest][:, None]
    points = np.stack([gaussians.means + step * along for step in (0.0, REACH, -REACH)])
    through, on = (each.reshape(3, -1) for each in known.crossed(points.reshape(-1, 3)))
    return Footing(points, through, on)


@dataclass(frozen=True, eq=False)
class Covered:
    """(H, W) which pixels these cover."""

    rgb: npt.NDArray[np.float32]  # (H, W, 3) what is seen
    needles: Mask
    floaters: Mask
    either: Mask  # one of them, or the two together


def covered(gaussians: GaussianArrays, stands: Footing, known: KnownSurfaces, viewpoint: Viewpoint) -> Covered:
    """What is seen from `viewpoint` of Gaussians that stand in empty space, or hide from it what is known."""
    camera = viewpoint.T_world_camera, viewpoint.K, viewpoint.width, viewpoint.height
    hides, _ = lines_of_sight(known.seen_from(*camera), stands.points.reshape(-1, 3))
    empty = (stands.through | hides.reshape(3, -1)) & ~stands.on
    needle = needle_shaped(gaussians, viewpoint) & empty.any(0)
    floater = empty[0] & ~needle
    colours = np.stack([needle, floater, np.zeros_like(needle)], 1)
    painted = replace(gaussians, sh=((colours - 0.5) / _SH_C0).astype(np.float32)[:, None])
    shares = render_arrays(painted, *camera).rgb
    rgb = render_arrays(gaussians, *camera).rgb
    without = render_arrays(select_gaussians(gaussians, ~(needle | floater)), *camera).rgb
    seen = np.abs(rgb - without).max(-1) >= VISIBLE
    needles, floaters = (seen & (shares[..., i] >= COVERED) for i in (0, 1))
    return Covered(rgb, needles, floaters, seen & (shares.sum(-1) >= COVERED))


def needle_shaped(gaussians: GaussianArrays, viewpoint: Viewpoint) -> Mask:
    """(N,) which Gaussians are seen from there as at least LONG and SLENDER."""
    R = viewpoint.T_world_camera[:3, :3]
    in_camera = transform_to_camera(gaussians.means.astype(np.float64), viewpoint.T_world_camera)
    z = np.maximum(in_camera[:, 2], 1e-6)
    axes = matrices_from_quats(gaussians.quats.astype(np.float64)) * gaussians.scales[:, None, :]
    axes = R.T @ axes
    fx, fy = viewpoint.K[0, 0], viewpoint.K[1, 1]
    u = fx * (axes[:, 0] - axes[:, 2] * (in_camera[:, 0] / z)[:, None]) / z[:, None]
    v = fy * (axes[:, 1] - axes[:, 2] * (in_camera[:, 1] / z)[:, None]) / z[:, None]
    a, b, c = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    half, root = (a + c) / 2, np.sqrt(((a - c) / 2) ** 2 + b * b)
    major, minor = np.sqrt(half + root), np.sqrt(np.maximum(half - root, 0) + 0.3)
    long = 4 * major >= LONG * max(viewpoint.width, viewpoint.height)
    return (in_camera[:, 2] > 0) & long & (major >= SLENDER * minor)
