"""Where one scene lies in another one's world: rotations as matrices and quaternions, and colours that turn along."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

# Rotation matrices and unit quaternions (wxyz) in NumPy, for formats that are written without torch.

Array = npt.NDArray[np.float64]


def quats_from_matrices(matrices: npt.ArrayLike) -> Array:
    """(..., 3, 3) rotations as (..., 4) unit quaternions with w >= 0.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000): no
    branches, accurate at every angle, and a matrix with rounding errors gives the nearest rotation.
    """
    m = np.asarray(matrices, np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    skew = (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1])
    for i in range(3):
        k[..., 0, i + 1] = k[..., i + 1, 0] = skew[i]
        for j in range(3):
            k[..., i + 1, j + 1] = m[..., i, j] + m[..., j, i]
        k[..., i + 1, i + 1] -= k[..., 0, 0]
    quats = np.linalg.eigh(k)[1][..., -1]
    return np.where(quats[..., :1] < 0, -quats, quats)


def matrices_from_quats(quats: npt.ArrayLike) -> Array:
    """(..., 4) quaternions of any length as (..., 3, 3) rotations."""
    q = np.asarray(quats, np.float64)
    with np.errstate(all="ignore"):  # one whose length is zero or infinite is no rotation: it becomes NaN
        length = np.linalg.norm(q, axis=-1, keepdims=True)
        w, x, y, z = np.moveaxis(q / np.where(np.isfinite(length), length, np.nan), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


# Colours that depend on the direction: the basis of their coefficients, and these when the world is turned.


_CONSTANT = 0.28209479177387814  # the first term
_DIRECTIONS = 64  # of the fit; a band of degree 3 needs 7


def compute_sh_terms(x: Any, y: Any, z: Any, bases: int) -> list[Any]:
    """The first `bases` real spherical harmonics of unit vectors, in the order and with the signs of 3DGS; at most 16.

    The vectors' coordinates are arrays of NumPy or of torch, and so are the terms, of the same shape.
    """
    found = [0.0 * x + _CONSTANT]
    if bases > 1:
        found += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bases > 4:
        found += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if bases > 9:
        found += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return found


def compute_sh_basis(directions: Array, bases: int) -> Array:
    """(M, B) `compute_sh_terms` of unit vectors (M, 3)."""
    x, y, z = directions.T
    return np.stack(compute_sh_terms(x, y, z, bases), 1)


def rotate_sh(sh: npt.NDArray[np.float32], rotation: Array) -> npt.NDArray[np.float32]:
    """(N, B, 3) the coefficients of the same colours after the world was turned by `rotation` (3, 3).

    What was seen along d is seen along rotation @ d. A rotation mixes the coefficients of one degree only, so each
    degree's matrix is found from a few directions, exactly but for rounding. B must be 1, 4, 9 or 16.
    """
    bases = sh.shape[1]
    if bases not in (1, 4, 9, 16):
        raise ValueError(f"sh must be (N, B, 3) with B = 1, 4, 9 or 16, got {sh.shape}")
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = compute_sh_basis(directions @ rotation, bases), compute_sh_basis(directions, bases)
    result = sh.copy()
    for degree in range(1, round(bases**0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]
        result[:, band] = np.einsum("ab,nbc->nac", matrix, sh[:, band])
    return result


def make_flat_sh(colours: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, 1, 3) coefficients of colours (N, 3) in [0, 1] that are the same from all directions."""
    return ((colours - 0.5) / _CONSTANT)[:, None].astype(np.float32)


def compute_mean_colours(sh: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(N, 3) the colours in [0, 1] of coefficients (N, B, 3), without what depends on the direction."""
    return np.clip(0.5 + _CONSTANT * sh[:, 0], 0.0, 1.0).astype(np.float32)


# Where one scene lies in another one's world. `recon.geometry.Similarity` is the same for those that have torch.


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
