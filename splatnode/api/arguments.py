"""What a program gives: its arguments as records, its warnings at its own line, its errors as text that only shows."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage, describe_doubtful_unit, make_depth_image, read_depth_file
from splatnode.capture.frame import (
    GRAVITY_SIGMA_DEG,
    MOTION_DRIFT,
    MOTION_SIGMA_DEG,
    MOTION_SIGMA_M,
    POSE_SIGMA_DEG,
    POSE_SIGMA_M,
    GivenPose,
    Gravity,
    Intrinsics,
    Motion,
    make_given_pose,
    rigid_problem,
)
from splatnode.capture.image_file import UnusableImage
from splatnode.capture.messaging.network import CAMERA_ID
from splatnode.capture.process.terminal import give_warnings, notify
from splatnode.capture.process.text import LONGEST_NAME, is_printable, sanitize_lines

# The entrance of a program: it hears warnings at its own line, and errors as text that only shows.


@contextlib.contextmanager
def enter_api() -> Iterator[None]:
    """In here notices are Python warnings, and the texts of errors are those that the command line would print.

    What a file or a sender wrote may be part of them: a traceback in a terminal shows it and does nothing else.
    """
    with give_warnings():
        try:
            yield
        except Exception as error:
            sanitize_error(error)
            raise


def sanitize_error(error: BaseException) -> None:
    """Makes the texts of an error, and of those that led to it, printable."""
    seen: set[int] = set()
    waiting: list[BaseException | None] = [error]
    while waiting:
        each = waiting.pop()
        if each is None or id(each) in seen:
            continue
        seen.add(id(each))
        waiting += [each.__cause__, each.__context__]
        if not isinstance(each, UnicodeError) and any(isinstance(part, str) for part in each.args):
            each.args = tuple(sanitize_lines(part) if isinstance(part, str) else part for part in each.args)


# Lens, depth image, pose, motion, gravity and mount of one image, as a program gives them, as records of a frame.

log = logging.getLogger(__name__)

Lens: TypeAlias = "Intrinsics | npt.NDArray[np.floating]"
DepthOf: TypeAlias = "DepthImage | npt.NDArray[Any] | str | PathLike[str] | None"
Sigmas: TypeAlias = "tuple[float, float]"  # metres and degrees


def make_intrinsics(lens: Lens, width: int, height: int) -> Intrinsics:
    """Returns the lens of an image of this size: as it is, or a pinhole of a matrix K (3, 3) in its pixels.

    Raises TypeError, ValueError.
    """
    if isinstance(lens, Intrinsics):
        return lens
    K = np.asarray(lens, np.float64) if isinstance(lens, (np.ndarray, list, tuple)) else None
    if K is None or K.shape != (3, 3):
        shape = type(lens).__name__ if K is None else str(K.shape)
        raise TypeError(f"intrinsics must be splatnode.Intrinsics or a matrix K (3, 3), got {shape}")
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(width, height, fx, fy, cx, cy, source="given")


def make_pose(
    pose: npt.ArrayLike | None, sigma: Sigmas | None, usual: Sigmas = (POSE_SIGMA_M, POSE_SIGMA_DEG)
) -> GivenPose | None:
    """Returns the pose T_world_camera (4, 4), metres, of an image; None without one. `sigma` None: as `usual`.

    Raises TypeError, ValueError.
    """
    if pose is None:
        if sigma is not None:
            raise ValueError("pose_sigma says how unsure a pose is: give pose, too")
        return None
    sigmas = usual if sigma is None else parse_sigmas(sigma, "pose_sigma")
    return make_given_pose(np.asarray(pose, np.float64), *sigmas)


def append_motion(
    before: Motion | None,
    name: str,
    step: npt.ArrayLike | None,
    sigma: Sigmas | None,
    drift: float = MOTION_DRIFT,
    sigma_deg: float = MOTION_SIGMA_DEG,
) -> Motion:
    """Returns the motions up to the image `name`: with one `step` more, T_previous_current (4, 4), metres.

    Without a step a chain begins with the image. `sigma` None: `drift` times the length of the step, and `sigma_deg`.
    Raises TypeError, ValueError.
    """
    if step is None:
        if sigma is not None:
            raise ValueError("motion_sigma says how unsure a motion is: give motion, too")
        return Motion(name)
    if before is None:
        raise ValueError("motion is that since the photograph before: the first one has none")
    moved = np.asarray(step, np.float64)
    if moved.shape != (4, 4):
        raise TypeError(f"motion must be T_previous_current (4, 4) or None, got shape {moved.shape}")
    usual = max(drift * float(np.linalg.norm(moved[:3, 3])), MOTION_SIGMA_M), sigma_deg
    return before.append_step(moved, *(usual if sigma is None else parse_sigmas(sigma, "motion_sigma")))


def make_gravity(gravity: npt.ArrayLike | None, sigma_deg: float | None) -> Gravity | None:
    """Returns the direction of down (3,) in the camera's frame; None without one. Raises TypeError, ValueError."""
    if gravity is None:
        if sigma_deg is not None:
            raise ValueError("gravity_sigma says how unsure gravity is: give gravity, too")
        return None
    down = np.asarray(gravity, np.float64)
    if down.shape != (3,):
        raise TypeError(f"gravity must be a direction (3,) in the camera's frame, got shape {down.shape}")
    x, y, z = down.tolist()
    return Gravity((x, y, z), GRAVITY_SIGMA_DEG if sigma_deg is None else float(sigma_deg))


Mounts: TypeAlias = "npt.ArrayLike | Mapping[str, npt.ArrayLike]"  # T_base_camera of all cameras, or by camera id


def parse_mounts(T_base_camera: Mounts | None) -> dict[str, tuple[float, ...]]:
    """Returns T_base_camera (4, 4) in metres as frames have it, by camera id; "" is of all.

    Raises TypeError, ValueError.
    """
    if T_base_camera is None:
        return {}
    if isinstance(T_base_camera, Mapping):
        return {camera_id: _parse_mount(T) for camera_id, T in T_base_camera.items()}
    return {"": _parse_mount(T_base_camera)}


def find_mount(mounts: Mapping[str, tuple[float, ...]], camera_id: str) -> tuple[float, ...] | None:
    """Returns the mount of a camera by its id; None where none was given."""
    return mounts.get(camera_id, mounts.get(""))


def _parse_mount(T: npt.ArrayLike) -> tuple[float, ...]:
    matrix = np.asarray(T, np.float64)
    if matrix.shape != (4, 4):
        raise TypeError(
            f"T_base_camera must be (4, 4) in metres, or a mapping of such by camera id, got {matrix.shape}"
        )
    numbers = tuple(matrix.ravel().tolist())
    if problem := rigid_problem(numbers):
        raise ValueError(f"T_base_camera must be {problem}")
    return numbers


def check_capture_id(camera_id: Any) -> str:
    """The id of a camera that sends to a node, as it is. Raises TypeError, ValueError."""
    if not isinstance(camera_id, str):
        raise TypeError(f"camera_id must be a text, got {type(camera_id).__name__}")
    if camera_id and not re.fullmatch(CAMERA_ID, camera_id):
        raise ValueError(f"camera_id must be up to 32 letters, digits, - and _, got {camera_id[:40]!a}")
    return camera_id


def check_camera_id(camera_id: Any, what: str) -> str:
    """The id of one of several cameras of one reconstruction, as it is. Raises TypeError, ValueError."""
    if not isinstance(camera_id, str):
        raise TypeError(f"{what} must be a text, got {type(camera_id).__name__}")
    if not is_printable(camera_id, LONGEST_NAME):
        raise ValueError(f"{what} must be at most {LONGEST_NAME} printable letters, got {camera_id[:40]!a}")
    return camera_id


def parse_sigmas(sigmas: Any, what: str) -> Sigmas:
    """Returns two standard deviations, metres and degrees. Raises TypeError; `what` is the argument."""
    if not isinstance(sigmas, (tuple, list)) or len(sigmas) != 2:
        raise TypeError(f"{what} must be metres and degrees, (0.01, 2.0), got {sigmas!r}")
    return float(sigmas[0]), float(sigmas[1])


def parse_depth(given: Any) -> DepthImage:
    """One depth image: a `DepthImage`, an array (H, W), or a file. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(given, DepthImage):
        return given
    if isinstance(given, np.ndarray):
        return make_depth_image(given)
    if isinstance(given, (str, PathLike)):
        try:
            return read_depth_file(Path(given))
        except UnusableImage as error:
            raise ValueError(str(error)) from error
    raise TypeError(
        f"must be a DepthImage, a NumPy array (H, W) of uint16 millimetres or float metres, or a file, got "
        f"{type(given).__name__}"
    )


def parse_optional_depth(given: DepthOf) -> DepthImage | None:
    """As `parse_depth`; None stays None."""
    return None if given is None else parse_depth(given)


def parse_single_depth(given: DepthOf) -> DepthImage | None:
    """As `parse_optional_depth`, of one image at a time: what speaks against its unit is notified."""
    found = parse_optional_depth(given)
    if found is not None and (doubt := describe_doubtful_unit(found)):
        notify(log, f"the depth image: {doubt}")
    return found
