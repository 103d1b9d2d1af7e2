"""Where the board was, from the rays that meet its corners: a start for the estimate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.rotations import cross_matrices

Array = npt.NDArray[np.float64]


def board_pose(rays: Array, corners: Array) -> Array | None:
    """T_camera_board (4, 4) from unit rays (N, 3) that meet the board's corners (N, 2); None where they fix none.

    The homography from the board to the rays by the direct linear transform, which takes rays of every direction, also
    from behind the camera's plane (Hartley and Zisserman, Multiple View Geometry, chapter 4).
    """
    middle = corners.mean(axis=0)
    size = np.abs(corners - middle).max()
    flat = np.column_stack([(corners - middle) / size, np.ones(len(corners))])
    rows = np.einsum("nij,nk->nijk", cross_matrices(rays), flat).reshape(-1, 9)
    _, singular, right = np.linalg.svd(rows, full_matrices=False)
    if len(singular) < 9 or singular[7] < 1e-6 * singular[0]:
        return None
    homography = right[8].reshape(3, 3)
    if np.median(np.einsum("ni,ni->n", rays, flat @ homography.T)) < 0:
        homography = -homography
    homography /= np.sqrt(np.linalg.norm(homography[:, 0]) * np.linalg.norm(homography[:, 1])) + 1e-300
    left, _, turned = np.linalg.svd(np.column_stack([homography[:, :2], np.cross(homography[:, 0], homography[:, 1])]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ turned)]) @ turned
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = size * homography[:, 2] - rotation[:, :2] @ middle
    return T
