"""What is wrong with all given poses alike: how the camera sits on what carries it was told wrongly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatnode.recon.geometry import align_cameras, compute_rms_radius
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.registration.known_poses import Offset, has_pose
from splatnode.recon.registration.registration import Registration

Array = npt.NDArray[np.float64]

_LEAST_CAMERAS = 4  # 24 numbers for a similarity and an offset, which are 13
_LEAST_TURN_DEG = 5.0  # by which orientations must differ: of cameras that look one way a shift is one of the world
_MOST_SIGMAS = 3.0  # root of the mean square of what is left, of which images are a part
_IMAGES = 2.0  # times as wide as given: what images do not know of their cameras counts, too
_OF_SHIFT_M = 1.0  # standard deviation of the offset's shift before anything is known, metres


def offset_of(keyframes: Sequence[Keyframe], registration: Registration) -> Offset | None:
    """The offset in the camera's frame in which all given poses agree with the cameras of the images alone.

    None where there are too few cameras to tell it, or no offset explains the poses.
    """
    chosen = [camera for camera in registration.cameras if has_pose(keyframes[camera.index])]
    poses = [keyframes[camera.index].frame.given_pose for camera in chosen]
    if len(chosen) < _LEAST_CAMERAS:
        return None
    scene, given = np.stack([camera.T_world_camera for camera in chosen]), np.stack([p.matrix for p in poses if p])
    turned = Rotation.from_matrix(np.swapaxes(scene[:1, :3, :3], 1, 2) @ scene[:, :3, :3]).magnitude()
    if np.degrees(turned.max()) < _LEAST_TURN_DEG:
        return None
    sigmas = _IMAGES * np.array([(np.radians(pose.sigma_deg), pose.sigma_m) for pose in poses if pose])
    begun = align_cameras(scene, given)
    middle, size = scene[:, :3, 3].mean(0), max(compute_rms_radius(given[:, :3, 3]), 1e-9)

    def offset(values: Array) -> Array:
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = Rotation.from_rotvec(values[7:10]).as_matrix(), size * values[10:13]
        return X

    def errors(values: Array) -> Array:
        rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ begun.rotation
        scale = begun.scale * np.exp(values[6])
        moved = np.tile(np.eye(4), (len(scene), 1, 1))
        moved[:, :3, :3] = rotation @ scene[:, :3, :3]
        moved[:, :3, 3] = begun(middle) + size * values[3:6] + scale * (scene[:, :3, 3] - middle) @ rotation.T
        expected = moved @ offset(values)
        turns = Rotation.from_matrix(np.swapaxes(expected[:, :3, :3], 1, 2) @ given[:, :3, :3]).as_rotvec()
        moves = expected[:, :3, 3] - given[:, :3, 3]
        parts = [(turns / sigmas[:, :1]).ravel(), (moves / sigmas[:, 1:]).ravel(), size * values[10:13] / _OF_SHIFT_M]
        return np.concatenate(parts)

    found = least_squares(errors, np.zeros(13), x_scale=0.01)
    left = float(np.sqrt(2.0 * found.cost / (6 * len(scene) - 13)))
    if left >= _MOST_SIGMAS:
        return None
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    turn, shift = (float(np.sqrt(np.linalg.eigvalsh(covariance[b, b]).max())) for b in (slice(7, 10), slice(10, 13)))
    return Offset(offset(found.x), turn, size * shift)
