"""Several cameras on one robot: where they stand to each other, and which of their images were taken together."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import LARGEST_M, LEAST_SIGMA, Frame, Intrinsics, Stamp, rigid_problem
from splatnode.capture.lenses import UnusableLens, read_lenses
from splatnode.capture.process.config import MAX_BYTES, ConfigError, parse_yaml, record_of
from splatnode.capture.process.files import read_text
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text

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


# Rigs in files: rig.yaml, COLMAP's rig_config.json, or a camchain of Kalibr.
#
# Sources of the formats: COLMAP's page on rigs, Kalibr's wiki on its YAML formats. rig.yaml is our own:
#
#     cameras:
#       front: {T_rig_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
#       left: {T_rig_camera: [...], sigma_m: 0.002, sigma_deg: 0.1}
#
# Lengths are metres, cameras look along z, x right, y down. Of a camera without T_rig_camera nobody knows where it is.
# With T_base_camera in place of T_rig_camera the rig's frame is the robot's base: x forward, y left, z up. One camera
# is enough then.

Array = npt.NDArray[np.float64]

_READ = "a rig: rig.yaml, COLMAP's rig_config.json, or Kalibr's camchain"


_OF_COLMAP = (
    "Each has image_prefix, and cam_from_rig_rotation [w, x, y, z] and cam_from_rig_translation [x, y, z] unless it is "
    "the ref_sensor"
)
_OF_KALIBR = (
    "There must be cam0, cam1 and so on, each but the first with T_cn_cnm1, a matrix (4, 4) of its pose against the "
    "camera before"
)


class UnusableRig(ValueError):
    """A file that gives no rig; the text says what was expected."""


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    T_rig_camera: tuple[tuple[float, ...], ...] | None = None
    T_base_camera: tuple[tuple[float, ...], ...] | None = None
    sigma_m: float = SIGMA_M
    sigma_deg: float = SIGMA_DEG
    metric: bool = True


def read_rig(path: Path) -> Rig:
    """Returns the rig that a file gives. Raises UnusableRig."""
    shown = sanitize_text(str(path))
    text = read_text(path, MAX_BYTES, UnusableRig, shown, _READ)
    with guard_untrusted(UnusableRig, shown):
        try:
            content = parse_yaml(text, shown)  # JSON is YAML
        except ConfigError as error:  # on several lines, of which the first says it; it names the file already
            raise UnusableRig(f"{sanitize_text(' '.join(str(error).split()))}; it must give {_READ}") from error
        if isinstance(content, list):
            return _parse_colmap(shown, content)
        if isinstance(content, Mapping) and "cameras" in content:
            return _parse_own(shown, content)
        if isinstance(content, Mapping) and "cam0" in content:
            return _parse_kalibr(path, shown, content)
    raise UnusableRig(f"{shown} must give {_READ}; it has neither `cameras`, nor cam0, nor a list of rigs")


def _parse_own(shown: str, content: Mapping[str, Any]) -> Rig:
    cameras = content["cameras"]
    if not isinstance(cameras, Mapping):
        raise UnusableRig(
            f"{shown}: cameras must be a mapping of camera ids to T_rig_camera, got {type(cameras).__name__}"
        )
    found = [_parse_own_camera(shown, str(name), each) for name, each in cameras.items()]
    on_base, on_rig = ([str(name) for name, each in cameras.items() if isinstance(each, Mapping) and each.get(key)]
                       for key in ("T_base_camera", "T_rig_camera"))  # fmt: skip
    if on_base and on_rig:
        raise UnusableRig(
            f"{shown}: {sanitize_text(on_base[0], LONGEST_NAME)} has T_base_camera and "
            f"{sanitize_text(on_rig[0], LONGEST_NAME)} T_rig_camera: give all cameras the one or the other"
        )
    return _make_rig(shown, found, bool(on_base))


def _parse_own_camera(shown: str, name: str, given: Any) -> RigCamera:
    with _name_camera(shown, name):
        camera = record_of({} if given is None else given, _Camera)
        if not camera.metric and camera.T_rig_camera is not None:
            raise ValueError("it has no metres: its scene had none. Measure it, or leave T_rig_camera out")
        T = camera.T_base_camera or camera.T_rig_camera
        return RigCamera(name, _flatten(T), camera.sigma_m, camera.sigma_deg)


@contextlib.contextmanager
def _name_camera(shown: str, name: object, expected: str = "") -> Iterator[None]:
    """Makes what is wrong in here an UnusableRig that names the file and the camera, and what was expected of it."""
    try:
        yield
    except UnusableRig:
        raise
    except (KeyError, IndexError, TypeError, ValueError, np.linalg.LinAlgError, msgspec.ValidationError) as error:
        said = f"it has no {error}" if isinstance(error, KeyError) else sanitize_text(error).replace("`", "")
        raise UnusableRig(f"{shown}: camera {sanitize_text(name, 60)!r}: {said}{expected}") from error


def _make_rig(shown: str, cameras: Sequence[RigCamera], is_base: bool = False) -> Rig:
    try:
        return Rig(tuple(cameras), is_base)
    except ValueError as error:
        raise UnusableRig(f"{shown}: {error}") from error


def _flatten(rows: Sequence[Sequence[float]] | None) -> tuple[float, ...] | None:
    return None if rows is None else tuple(float(number) for row in rows for number in row)


def _parse_colmap(shown: str, content: list[Any]) -> Rig:
    """The first rig: cameras are called as the folders of their images are."""
    if len(content) != 1:
        raise UnusableRig(f"{shown} must have one rig, it has {len(content)}; leave the one that took the images")
    listed = content[0].get("cameras") if isinstance(content[0], Mapping) else None
    if not isinstance(listed, list) or not all(isinstance(each, Mapping) for each in listed):
        raise UnusableRig(f"{shown} must have one rig with `cameras`, a list of mappings. {_OF_COLMAP}")
    return _make_rig(shown, [_parse_colmap_camera(shown, number, given) for number, given in enumerate(listed)])


def _parse_colmap_camera(shown: str, number: int, given: Mapping[str, Any]) -> RigCamera:
    with _name_camera(shown, given.get("image_prefix", number), f". {_OF_COLMAP}"):
        name = sanitize_text(PurePosixPath(str(given["image_prefix"])).name, LONGEST_NAME)
        T_camera_rig = np.eye(4)
        if not given.get("ref_sensor", False):
            if "cam_from_rig_rotation" not in given:
                return RigCamera(name)
            w, x, y, z = map(float, given["cam_from_rig_rotation"])
            T_camera_rig[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
            T_camera_rig[:3, 3] = [float(number) for number in given["cam_from_rig_translation"]]
        return RigCamera(name, _invert(T_camera_rig))


def _parse_kalibr(path: Path, shown: str, content: Mapping[str, Any]) -> Rig:
    """Cameras are called cam0, cam1 and so on, as their lenses are; the rig is cam0."""
    try:
        lenses = read_lenses(path).by_key
    except UnusableLens as error:  # it names the file already
        raise UnusableRig(str(error)) from error
    T_camera_rig, found = np.eye(4), []
    for name in (f"cam{number}" for number in range(len(content))):
        with _name_camera(shown, name, f". {_OF_KALIBR}"):
            given = content.get(name, {})
            if name != "cam0":
                T_camera_rig = np.reshape([float(x) for row in given["T_cn_cnm1"] for x in row], (4, 4)) @ T_camera_rig
            found.append(RigCamera(name, _invert(T_camera_rig), intrinsics=lenses.get(name)))
    return _make_rig(shown, found)


def _invert(T: Array) -> tuple[float, ...]:
    return tuple(np.linalg.inv(T).ravel().tolist())


def format_rig(cameras: Sequence[tuple[str, Array, float, float]], metric: bool) -> str:
    """Formats rig.yaml of cameras by id, T_rig_camera (4, 4), and sigmas of position and orientation (degrees)."""
    lines = ["# Cameras on their rig: metres" if metric else "# Cameras on their rig: no metric unit", "cameras:"]
    for name, T, sigma, sigma_deg in cameras:
        rows = ", ".join("[" + ", ".join(f"{number:.9g}" for number in row) + "]" for row in T)
        lines.append(f"  {msgspec.json.encode(name).decode()}:")
        lines.append(f"    T_rig_camera: [{rows}]")
        lines.append(f"    sigma_m: {max(sigma, 1e-9):.6g}")
        lines.append(f"    sigma_deg: {max(sigma_deg, 1e-9):.6g}")
        lines += [] if metric else ["    metric: false"]
    return "\n".join(lines) + "\n"
