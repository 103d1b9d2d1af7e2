"""Landmarks: the points of a scene by which a photograph that was not in the set is placed in it.

They are the points on which verified cameras agree, each with the descriptors of its features and its uncertainty, and
what is known of the cameras that saw them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KnownLenses:
    """The lenses of C cameras. Lengths in the picture count over its longer side."""

    focals: Array  # (C,)
    radials: Array  # (C, 2) radial coefficients, as recon/registration/bundle.py has them
    shifts: Array  # (C, 2) of the principal point from the middle of the picture
    shapes: Array  # (C,) height over width


@dataclass(frozen=True, eq=False)
class Landmarks:
    """P points of a scene with D descriptors in C photographs. Lengths are in the unit of the result."""

    points: Array  # (P, 3) world
    covariances: Array  # (P, 3, 3) of the points' errors, the cameras taken as exact
    descriptors: npt.NDArray[np.uint8]  # (D, 128) as matching/nearest_neighbours.py quantises them
    point_of: Index  # (D,) the point that a descriptor is of
    photograph_of: Index  # (D,) the photograph that it is from
    names: tuple[str, ...]  # of the C photographs
    Ts_world_camera: Array  # (C, 4, 4)
    lenses: KnownLenses
    rotation_bounds: Array  # (C,) 95 % bounds of the cameras' errors, degrees
    centre_bounds: Array  # (C,) likewise of their centres
    noise_px: float  # standard deviation of an observation's error, pixels at REFERENCE_SIDE
    unit: float = 1.0  # the median depth of the scene's points: metres where the result is metric
    metric: bool = False  # lengths are metres
    focal_bounds: Array | None = None  # (C,) 95 % bounds of the focal lengths, percent; None: an earlier file has none

    def transform(self, scale: float, rotation: Array, translation: Array, *, metric: bool = False) -> Landmarks:
        """The same in the world to which x -> scale * rotation @ x + translation leads.

        `metric` says whether its unit is the metre.
        """
        Ts_world_camera = np.tile(np.eye(4), (len(self.names), 1, 1))
        Ts_world_camera[:, :3, :3] = rotation @ self.Ts_world_camera[:, :3, :3]
        Ts_world_camera[:, :3, 3] = scale * self.Ts_world_camera[:, :3, 3] @ rotation.T + translation
        return replace(
            self,
            points=scale * self.points @ rotation.T + translation,
            covariances=scale**2 * rotation @ self.covariances @ rotation.T,
            Ts_world_camera=Ts_world_camera,
            centre_bounds=scale * self.centre_bounds,
            unit=scale * self.unit,
            metric=metric,
        )
