"""Several cameras on one robot: where they stand to each other, and which of their images were taken together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics, Stamp
from splatnode.capture.odometry import LARGEST_M, LEAST_SIGMA, rigid_problem
from splatnode.capture.process.text import LONGEST_NAME, sanitize_text

TOLERANCE_S = 0.02  # between images that were taken together, where nobody tells any
SIGMA_M, SIGMA_DEG = 0.001, 0.1  # of a camera's pose on its rig, where nobody tells any: as calibrated with a board
# Of a camera's pose on the robot's base, by a log's static transforms or a configuration: drawn, not calibrated
MOUNT_SIGMA_M, MOUNT_SIGMA_DEG = 0.005, 0.5


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig. Its pose is T_rig_camera in metres, row by row; the camera looks along z, x right, y down.

    Raises ValueError where the pose is no rigid motion, or a number is out of bounds.
    """

    camera_id: str  # as its frames have it
    T_rig_camera: tuple[float, ...] | None = None  # None: nobody knows, the images tell
    sigma_m: float = SIGMA_M  # standard deviation of the position in each direction, metres
    sigma_deg: float = SIGMA_DEG  # of the orientation about each axis, degrees
    intrinsics: Intrinsics | None = None

    def __post_init__(self) -> None:
        if not self.camera_id or sanitize_text(self.camera_id, LONGEST_NAME) != self.camera_id:
            raise ValueError(f"a camera id must be 1 to {LONGEST_NAME} printable letters, got {self.camera_id[:40]!a}")
        if not (LEAST_SIGMA <= self.sigma_m <= LARGEST_M and LEAST_SIGMA <= self.sigma_deg <= 180):
            raise ValueError(
                f"the sigmas of {self.camera_id} on its rig must be {LEAST_SIGMA:g} or more, up to {LARGEST_M:g} m and "
                f"180 degrees; got {self.sigma_m:g} m and {self.sigma_deg:g} degrees"
            )
        if self.T_rig_camera is not None and (problem := rigid_problem(self.T_rig_camera)):
            raise ValueError(f"the pose of {self.camera_id} on its rig must be {problem}")

    @property
    def matrix(self) -> npt.NDArray[np.float64] | None:
        """T_rig_camera (4, 4); None where nobody knows it."""
        return None if self.T_rig_camera is None else np.array(self.T_rig_camera, np.float64).reshape(4, 4)


@dataclass(frozen=True)
class Rig:
    """Cameras whose relative poses do not change.

    Raises ValueError for fewer than two, unless its frame is the robot's base, and for two of one camera id.
    """

    cameras: tuple[RigCamera, ...]
    is_base: bool = False  # its frame is the robot's base (x forward, y left, z up): T_rig_camera is T_base_camera

    def __post_init__(self) -> None:
        ids = [camera.camera_id for camera in self.cameras]
        if len(ids) < (1 if self.is_base else 2) or len(set(ids)) != len(ids):
            raise ValueError(
                f"a rig must have two cameras or more, each with its own camera id; got {ids}. A single camera is one "
                "by its T_base_camera alone"
            )

    def find_mount(self, camera_id: str) -> tuple[float, ...] | None:
        """Returns T_base_camera of a camera, of images that name none that of the only one; None where not told."""
        if not self.is_base:
            return None
        single = self.cameras[0] if len(self.cameras) == 1 and not camera_id else None
        found = single or self.find_camera(camera_id)
        return None if found is None else found.T_rig_camera

    def find_camera(self, camera_id: str) -> RigCamera | None:
        """Returns the camera with this id; None where the rig has none."""
        return next((camera for camera in self.cameras if camera.camera_id == camera_id), None)


@dataclass(frozen=True)
class FrameSet:
    """Images that the cameras of one robot took together: at most one of each camera."""

    names: Mapping[str, str]  # of the frames, by camera id
    stamp: Stamp  # the earliest of them


def are_taken_together(first: Stamp, later: Stamp, tolerance_s: float) -> bool:
    """Whether an image may be of the frame set whose earliest image is `first`: times of two clocks never are."""
    return first.clock is later.clock and 0 <= later.ns - first.ns <= tolerance_s * 1e9


def form_frame_sets(frames: Iterable[tuple[str, str, Stamp]], tolerance_s: float = TOLERANCE_S) -> Sequence[FrameSet]:
    """Groups frames, given by name, camera id and time, into those that were taken together; in order of time.

    Every frame with a camera id is in exactly one set, if need be alone. All of a set are within `tolerance_s` of its
    earliest. Times of different clocks are never together.
    """
    sets: list[tuple[dict[str, str], Stamp]] = []
    for name, camera_id, stamp in sorted(frames, key=lambda each: (each[2].clock.value, each[2].ns, each[1], each[0])):
        if not camera_id:
            continue
        if sets and camera_id not in sets[-1][0] and are_taken_together(sets[-1][1], stamp, tolerance_s):
            sets[-1][0][camera_id] = name
        else:
            sets.append(({camera_id: name}, stamp))
    return [FrameSet(MappingProxyType(names), first) for names, first in sets]


def form_mounted_rig(frames: Iterable[Frame]) -> Rig | None:
    """Forms the rig of where the frames' cameras stand on the robot's base; None where fewer than two stand still."""
    mounts: dict[str, set[tuple[float, ...]]] = {}
    for frame in frames:
        if frame.camera_id and frame.T_base_camera is not None:
            mounts.setdefault(frame.camera_id, set()).add(frame.T_base_camera)
    still = [RigCamera(camera_id, *each, sigma_m=MOUNT_SIGMA_M, sigma_deg=MOUNT_SIGMA_DEG)
             for camera_id, each in sorted(mounts.items()) if len(each) == 1]  # fmt: skip
    return Rig(tuple(still), is_base=True) if len(still) > 1 else None
