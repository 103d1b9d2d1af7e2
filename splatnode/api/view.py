"""What a camera that never was would see of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon import core
from splatnode.recon.result.camera_check import find_camera_problem
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.sources import find_confirmed
from splatnode.recon.result.spherical_harmonics import make_flat_sh

MOSTLY = 0.5  # of the light that reaches a pixel


@dataclass(frozen=True, eq=False)
class View:
    """A picture of the scene. H is its height, W its width."""

    rgb: npt.NDArray[np.uint8]  # (H, W, 3) RGB; black where there is nothing
    depth: npt.NDArray[np.float32]  # (H, W) along the camera's z axis, in the world's unit; 0 where there is nothing
    seen: npt.NDArray[np.bool_]  # (H, W) whether most of a pixel's light is of surfaces that two photographs confirm


def view(
    gaussians: GaussianArrays,
    T_world_camera: npt.ArrayLike,
    K: npt.ArrayLike,
    size: tuple[int, int],
    threads: int | None,
) -> View:
    """The Gaussians from a camera of `size` (width, height). Raises ValueError where it is none."""
    (width, height), pose, lens = _size(size), _matrix("T_world_camera", T_world_camera), _matrix("K", K)
    problem = find_camera_problem(pose, lens, width, height)
    if problem:
        raise ValueError(f"{problem}. Give a camera's own: camera.T_world_camera, camera.K, (camera.width, ...)")
    with core.apply_thread_limit(threads):
        shown = render_arrays(gaussians, pose, lens, width, height, channels=("rgb", "depth"))
        confirmed = find_confirmed(gaussians.source_frame).astype(np.float32)
        white = replace(gaussians, sh=make_flat_sh(np.repeat(confirmed[:, None], 3, 1)))  # and all else black
        light = render_arrays(white, pose, lens, width, height).rgb[..., 0]
    rgb = np.rint(255 * np.clip(shown.rgb, 0.0, 1.0)).astype(np.uint8)
    return View(rgb, shown.depth, light > MOSTLY)


def _matrix(name: str, given: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a matrix of numbers, got {type(given).__name__}") from error


def _size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = size
        if int(width) == width and int(height) == height:
            return int(width), int(height)
    except (TypeError, ValueError):
        pass
    raise TypeError(f"size must be (width, height) in whole pixels, got {size!r}")
