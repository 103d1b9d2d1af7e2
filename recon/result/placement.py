"""Where one scene lies in another one's world. `recon.geometry.Similarity` is the same for those that have torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.quaternions import quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.spherical_harmonics import rotate_sh

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placement:
    """The map x -> scale * rotation @ x + translation, from a scene's world to that which it is placed in."""

    scale: float
    rotation: Array  # (3, 3)
    translation: Array  # (3,), in the unit of the world that it leads to

    def transform_points(self, points: Array) -> Array:
        """The points (..., 3) where they lie in the other world."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, inner: Placement) -> Placement:
        """The placement that applies `inner` first and then this one."""
        return Placement(
            self.scale * inner.scale, self.rotation @ inner.rotation, self.transform_points(inner.translation)
        )

    def inverse(self) -> Placement:
        """The placement that undoes this one."""
        rotation = self.rotation.T
        return Placement(1.0 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def transform_camera(self, camera: CameraEstimate) -> CameraEstimate:
        """The camera in the other world. It sees there what it saw here; its bounds keep their sizes in percent."""
        T = np.eye(4)
        T[:3, :3] = self.rotation @ camera.T_world_camera[:3, :3]
        T[:3, 3] = self.transform_points(camera.T_world_camera[:3, 3])
        bounds = camera.bounds
        if bounds is not None:
            first, second, third = (tuple(row) for row in (np.array(bounds.axes) @ self.rotation.T).tolist())
            bounds = replace(bounds, axes=(first, second, third)).rescale(self.scale)
        given = camera.given
        if given is not None:
            T_given = np.eye(4)
            T_given[:3, :3] = self.rotation @ given.T_world_camera[:3, :3]
            T_given[:3, 3] = self.transform_points(given.T_world_camera[:3, 3])
            given = replace(given, T_world_camera=T_given, sigma_m=self.scale * given.sigma_m)
        return replace(camera, T_world_camera=T, bounds=bounds, given=given)

    def transform_gaussians(self, gaussians: GaussianArrays) -> GaussianArrays:
        """The Gaussians in the other world: means, extents, rotations, and colours that depend on the direction."""
        w, x, y, z = quats_from_matrices(self.rotation[None])[0]
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        return replace(
            gaussians,
            means=self.transform_points(gaussians.means.astype(np.float64)).astype(np.float32),
            quats=(gaussians.quats @ left.T).astype(np.float32),
            scales=(self.scale * gaussians.scales).astype(np.float32),
            sh=rotate_sh(gaussians.sh, self.rotation),
        )


IDENTITY = Placement(1.0, np.eye(3), np.zeros(3))
