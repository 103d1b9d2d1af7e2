"""Projection, rigid motions, quaternions and similarities. T_world_camera: p_world = T_world_camera @ p_camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[np.float64]
ArrayOrTensor = TypeVar("ArrayOrTensor", Array, Tensor)

MIN_DEPTH = 1e-9  # of a point that is projected; the scene's median depth is 1. Nearer points count as that near
_STRONG = 0.1  # radial coefficient from which on undoing it takes more steps


def transform_to_camera(points: ArrayOrTensor, T_world_camera: ArrayOrTensor) -> ArrayOrTensor:
    """World points (..., 3) in the frame of the camera `T_world_camera` (4, 4)."""
    return (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]


def project(in_camera: Array, K: Array) -> Array:
    """(N, 2) pixels of points (N, 3) in the camera frame, under intrinsics K (3, 3) without skew.

    Points behind the camera get pixels too, which mean nothing: look at their depth.
    """
    depth = np.maximum(in_camera[:, 2:], MIN_DEPTH)
    return in_camera[:, :2] / depth * np.diag(K)[:2] + K[:2, 2]


def exp_se3(twist: Tensor) -> Tensor:
    """(4, 4) rigid motion of a twist (6,): translation part first, then the rotation vector in radians.

    It does not carry gradients; `twist_gradient` is there for them.
    """
    *rho, x, y, z = twist.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square = cross @ cross
    # Taylor's series where the closed form would subtract nearly equal numbers; the first term left out is below 1e-16.
    if angle < 1e-2:
        first = 1.0 - angle**2 / 6 + angle**4 / 120 - angle**6 / 5040
        second = 1.0 / 2 - angle**2 / 24 + angle**4 / 720
        third = 1.0 / 6 - angle**2 / 120 + angle**4 / 5040
    else:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
        third = (angle - math.sin(angle)) / angle**3
    motion = np.eye(4)
    motion[:3, 3] = rho + (second * cross + third * square) @ rho
    motion[:3, :3] += first * cross + second * square
    return torch.from_numpy(motion).to(twist)


def twist_gradient(T: Tensor, gradient: Tensor) -> Tensor:
    """(6,) gradient at zero of a twist x in `T @ exp_se3(x)`, from the gradient (4, 4) with respect to `T`."""
    (_, xy, xz, x), (yx, _, yz, y), (zx, zy, _, z), _ = (T.T @ gradient).tolist()
    return T.new_tensor([x, y, z, zy - yz, xz - zx, yx - xy])


def quat_from_matrix(rotation: Tensor) -> Tensor:
    """(..., 4) unit quaternions wxyz, w >= 0, of rotations (..., 3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    # Four times the outer product of the quaternion with itself: its largest row is far from zero.
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    outer = torch.stack([torch.stack(row, -1) for row in rows], -2)
    row = torch.diagonal(outer, dim1=-2, dim2=-1).argmax(-1)
    quat = torch.gather(outer, -2, row[..., None, None].expand(*row.shape, 1, 4))[..., 0, :]
    quat = quat / quat.norm(dim=-1, keepdim=True)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def matrices_from_quats(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of quaternions (N, 4) wxyz of any length but zero, in as few operations as can be.

    Each is a launch on a GPU. A matrix, times the squared length, is linear in the products of two components. To be
    read are `rasterize.reference.rotations` and, without torch, `result.placement`.
    """
    products = (quats[:, :, None] * quats[:, None, :]).flatten(1)  # (N, 16)
    rows, squared_lengths = (products @ _quaternion_product_matrix(quats.dtype, quats.device)).split((9, 1), 1)
    return (rows / squared_lengths).unflatten(1, (3, 3))


@lru_cache(maxsize=8)
def _quaternion_product_matrix(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(16, 10): ww, wx, .. zz to the rows of the matrix and the squared length, of quaternions wxyz."""
    w, x, y, z = range(4)
    signs = [
        {(w, w): 1, (x, x): 1, (y, y): -1, (z, z): -1}, {(x, y): 2, (w, z): -2}, {(x, z): 2, (w, y): 2},
        {(x, y): 2, (w, z): 2}, {(w, w): 1, (x, x): -1, (y, y): 1, (z, z): -1}, {(y, z): 2, (w, x): -2},
        {(x, z): 2, (w, y): -2}, {(y, z): 2, (w, x): 2}, {(w, w): 1, (x, x): -1, (y, y): -1, (z, z): 1},
        {(w, w): 1, (x, x): 1, (y, y): 1, (z, z): 1},
    ]  # fmt: skip
    table = np.zeros((4, 4, 10))
    for column, terms in enumerate(signs):
        for (first, second), factor in terms.items():
            table[first, second, column] = factor
    return torch.from_numpy(table.reshape(16, 10)).to(device, dtype)


def multiply_quats(a: Tensor, b: Tensor) -> Tensor:
    """(..., 4) Hamilton products wxyz: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map x -> scale * rotation @ x + translation of points in 3D."""

    scale: float
    rotation: Array  # (3, 3)
    translation: Array  # (3,)

    def __call__(self, points: Array) -> Array:
        """The points (..., 3) after the similarity."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, inner: Similarity) -> Similarity:
        """The similarity that applies `inner` first and then this one."""
        return Similarity(self.scale * inner.scale, self.rotation @ inner.rotation, self(inner.translation))

    def inverse(self) -> Similarity:
        """The similarity that undoes this one."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def camera(self, T_world_camera: Array) -> Array:
        """(4, 4) the camera after the similarity moved the world; still a rigid motion: the scale moves its centre."""
        moved = np.eye(4)
        moved[:3, :3] = self.rotation @ T_world_camera[:3, :3]
        moved[:3, 3] = self.scale * self.rotation @ T_world_camera[:3, 3] + self.translation
        return moved

    def covariance(self, of_points: Array) -> Array:
        """The covariances (..., 3, 3) of points after the similarity."""
        return self.scale**2 * self.rotation @ of_points @ self.rotation.T


def umeyama(source: Array, target: Array) -> Similarity:
    """The similarity that carries points `source` (M, 3) onto `target` with the least squared error (Umeyama 1991)."""
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 2:
        raise ValueError(f"points must both be (M, 3) with M >= 2, got {source.shape} and {target.shape}")
    source_centred, target_centred = source - source.mean(0), target - target.mean(0)
    u, singular, vt = np.linalg.svd(target_centred.T @ source_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    spread = float((source_centred**2).sum())
    scale = float((singular * signs).sum() / spread) if spread > 0 else 1.0
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def compute_rms_radius(points: Array) -> float:
    """RMS distance of points (M, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def angles_deg(rotations: Array, others: Array) -> Array:
    """(...,) angles between rotations (..., 3, 3), accurate also where they are tiny."""
    chord = np.linalg.norm(rotations - others, axis=(-2, -1)) / math.sqrt(8.0)
    return np.rad2deg(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def align_cameras(Ts_source: Array, Ts_target: Array) -> Similarity:
    """The similarity that carries source cameras (C, 4, 4) onto target cameras (C, 4, 4).

    The rotation comes from the orientations, scale and translation from the centres: unlike a fit to the centres
    alone, this is well defined for two cameras and for cameras on a line.
    """
    u, _, vt = np.linalg.svd(np.einsum("cij,ckj->ik", Ts_target[:, :3, :3], Ts_source[:, :3, :3]))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    source, target = Ts_source[:, :3, 3] @ rotation.T, Ts_target[:, :3, 3]
    source_centred, target_centred = source - source.mean(0), target - target.mean(0)
    scale = float((source_centred * target_centred).sum() / max((source_centred**2).sum(), 1e-18))
    scale = scale if scale > 1e-9 else 1.0
    return Similarity(scale, rotation, target.mean(0) - scale * source.mean(0))


def distortion(squared_radii: Array, radials: Array) -> Array:
    """(M,) by which a lens with radial coefficients (2,) or (M, 2) lengthens rays at depth 1 of squared lengths (M,).

    It is 1 + k1 r^2 + k2 r^4, the first two terms of Brown's model ("Decentering distortion of lenses", 1966).
    """
    return 1.0 + (radials[..., 0] + radials[..., 1] * squared_radii) * squared_radii


def undistort_rays(rays: Array, radials: Array) -> Array:
    """(M, 2) at depth 1 what a lens with radial coefficients (2,) or (M, 2) shows at `rays` (M, 2)."""
    found = rays
    for _ in range(undistort_iterations(radials)):
        found = rays / distortion((found**2).sum(1), radials)[:, None]
    return found


def undistort_iterations(radials: Array) -> int:
    """How many steps of its fixed-point iteration undo a distortion to a hundredth of a pixel."""
    largest = float(np.abs(radials).max(initial=0.0))
    return 0 if largest == 0 else 5 if largest < _STRONG else 20


# Cross products of many vectors.


def invert_pose(T: Array) -> Array:
    """The inverse (4, 4) of a rigid motion `T` (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return inverse


def cross_matrix(vectors: Array) -> Array:
    """(M, 3, 3) matrices of `vectors` (M, 3) with cross_matrix(v) @ x = v x x."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)


def epipolar_errors(matrix: Array, points1: Array, points2: Array, least_slope: float = 1e-15) -> Array:
    """(M,) signed Sampson errors of matches (both (M, 2)) under a fundamental or an essential matrix (3, 3).

    They are in the points' unit. A smaller slope of the epipolar lines than `least_slope` counts as that, as at the
    epipoles (Hartley and Zisserman, 2004, 11.4.3).
    """
    first, second = (np.column_stack([points, np.ones(len(points))]) for points in (points1, points2))
    lines2, lines1 = first @ matrix.T, second @ matrix
    squares = (lines1[:, :2] ** 2).sum(1) + (lines2[:, :2] ** 2).sum(1)
    return (second * lines2).sum(1) / np.sqrt(np.maximum(squares, least_slope**2))


def cross(one: Array, other: Array) -> Array:
    """(M, 3) cross products of rows (M, 3) with rows or with one vector (3,); numpy.cross takes five times as long."""
    a, b = one.T, other.T
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], axis=1)
