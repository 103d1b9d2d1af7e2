"""Poses as a program has them: a file, or matrices, by the photographs' names or in their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.api.photographs import Images, names_of
from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.given_pose import GivenPose, make_given_pose
from splatnode.capture.gravity import SIGMA_DEG, Gravity
from splatnode.capture.motion import Motion
from splatnode.capture.poses_file import create_trajectory, poses_of, read_poses
from splatnode.recon.metric.config import MetricConfig

LEAST_STEP_SIGMA_M = 0.001  # standard deviation of a motion, however short it is

Matrix: TypeAlias = "npt.NDArray[np.floating]"
Poses: TypeAlias = "str | PathLike[str] | Mapping[str, Matrix] | Sequence[Matrix | None]"


def sigmas_of(poses_sigma: tuple[float, float] | None) -> dict[str, float] | None:
    """Returns the settings of `metric` that the standard deviations change. Raises TypeError."""
    if poses_sigma is None:
        return None
    return dict(zip(("poses_sigma_m", "poses_sigma_deg"), _parse_sigmas(poses_sigma, "poses_sigma"), strict=True))


def pose_of(pose: npt.ArrayLike | None, sigma: tuple[float, float] | None, config: MetricConfig) -> GivenPose | None:
    """The pose of one photograph, T_world_camera (4, 4), metres; `sigma` None: as `config` has it.

    Raises TypeError, ValueError.
    """
    if pose is None:
        if sigma is not None:
            raise ValueError("pose_sigma says how unsure a pose is: give pose, too")
        return None
    usual = config.poses_sigma_m, config.poses_sigma_deg
    return make_given_pose(_matrix(pose), *(usual if sigma is None else _parse_sigmas(sigma, "pose_sigma")))


def next_motion(
    before: Motion | None,
    name: str,
    step: npt.ArrayLike | None,
    sigma: tuple[float, float] | None,
    config: MetricConfig,
) -> Motion:
    """The motions up to photograph `name`: with one `step` more, T_previous_current (4, 4), metres.

    Without a step, or a photograph before it, a chain begins with it. `sigma` None: as `config` has it.
    Raises TypeError, ValueError.
    """
    if step is None and sigma is not None:
        raise ValueError("motion_sigma says how unsure a motion is: give motion, too")
    if step is None:
        return Motion(name)
    if before is None:
        raise ValueError("motion is that since the photograph before: the first one has none")
    moved = _matrix(step)
    length = float(np.linalg.norm(moved[:3, 3]))
    usual = max(config.motions_drift * length, LEAST_STEP_SIGMA_M), config.motions_sigma_deg
    return before.append_step(moved, *(usual if sigma is None else _parse_sigmas(sigma, "motion_sigma")))


def gravity_of(gravity: npt.ArrayLike | None, sigma_deg: float | None) -> Gravity | None:
    """The direction of down in the camera's frame (3,). Raises TypeError, ValueError."""
    if gravity is None:
        if sigma_deg is not None:
            raise ValueError("gravity_sigma says how unsure gravity is: give gravity, too")
        return None
    down = np.asarray(gravity, np.float64)
    if down.shape != (3,):
        raise TypeError(f"gravity must be a direction (3,) in the camera's frame, got shape {down.shape}")
    x, y, z = down.tolist()
    return Gravity((x, y, z), SIGMA_DEG if sigma_deg is None else float(sigma_deg))


def poses_given(
    poses: Poses | None, images: Images, frames: Sequence[Frame | DroppedFrame]
) -> dict[str, npt.NDArray[np.float64]] | None:
    """The poses of the frames that have one, by their names. Raises TypeError, ValueError, FileNotFoundError."""
    if poses is None:
        return None
    if isinstance(poses, (str, PathLike)):
        return poses_of(read_poses(Path(poses)), frames, fspath(poses))
    return poses_of(create_trajectory(_list_named_poses(poses, images)), frames, "poses")


def _list_named_poses(
    poses: Mapping[str, Matrix] | Sequence[Matrix | None], images: Images
) -> list[tuple[str, npt.NDArray[np.float64]]]:
    if isinstance(poses, Mapping):
        return [(frame_name(Path(name)), _matrix(T)) for name, T in poses.items()]
    names = names_of(images)
    if len(poses) != len(names):
        raise ValueError(f"poses must be one for each of the {len(names)} photographs, got {len(poses)}")
    return [(name, _matrix(T)) for name, T in zip(names, poses, strict=True) if T is not None]


def _matrix(T: Any) -> npt.NDArray[np.float64]:
    matrix = np.asarray(T, np.float64)
    if matrix.shape != (4, 4):
        raise TypeError(f"a pose must be T_world_camera (4, 4) or None, got shape {matrix.shape}")
    return matrix


def _parse_sigmas(sigmas: Any, what: str) -> tuple[float, float]:
    if not isinstance(sigmas, (tuple, list)) or len(sigmas) != 2:
        raise TypeError(f"{what} must be metres and degrees, (0.01, 2.0), got {sigmas!r}")
    return float(sigmas[0]), float(sigmas[1])
