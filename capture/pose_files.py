"""Poses that others estimated, in metres: a TUM trajectory, nerfstudio's transforms.json, or a COLMAP model."""

from __future__ import annotations

import math
import struct
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from splatnode.capture.frame import LARGEST_M, Clock, DroppedFrame, Frame, are_rigid, rigid_problem
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.text import guard_untrusted, sanitize_text

# The photographs of a COLMAP model: images.txt and images.bin. Their points are passed over.

_POINT2D_BYTES = 24
_LONGEST_NAME = 4096  # bytes


class ImageRow(NamedTuple):
    name: str
    motion: tuple[float, ...]  # quaternion wxyz and translation of T_camera_world
    camera_id: int


def content_lines(text: str) -> Iterator[str]:
    """The lines of a text file of a model, without its comments."""
    return (line for line in each_line(text) if not line.startswith("#"))


def each_line(text: str) -> Iterator[str]:
    """The lines of a text, one after the other: a list of all, which may be empty ones, takes far more memory."""
    end_of_line = "\n" if "\n" in text else "\r"
    start = 0
    while start < len(text):
        end = text.find(end_of_line, start)
        end = len(text) if end < 0 else end
        yield text[start:end].rstrip("\r")
        start = end + 1


def text_images(text: str) -> Iterator[ImageRow]:
    """Parses images.txt: two lines an image, of which the second, its points, may be empty. Raises ValueError."""
    lines = content_lines(text)
    for line in lines:
        if line.strip():
            _, *motion, camera_id, name = line.split(maxsplit=9)
            yield ImageRow(name.strip(), tuple(map(float, motion)), int(camera_id))
            next(lines, "")


def binary_images(data: bytes) -> Iterator[ImageRow]:
    """Parses images.bin. Raises ValueError, struct.error."""
    (count,), position = struct.unpack_from("<Q", data), 8
    for _ in range(count):  # ends at the latest where the bytes do
        _, *motion, camera_id = struct.unpack_from("<I7dI", data, position)
        end = data.index(b"\0", position + 64, position + 64 + _LONGEST_NAME)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        name, position = data[position + 64 : end].decode(), end + 9 + _POINT2D_BYTES * points
        if position > len(data):
            raise ValueError(f"{sanitize_text(name, 100)} has {points} points, which are not there")
        yield ImageRow(name, tuple(motion), camera_id)


Array = npt.NDArray[np.float64]

_MAX_BYTES = 200_000_000
MOST_POSES = 1_000_000  # of a file: those of five hours at 60 a second
_LONGEST_GAP_S = 1.0  # between two poses, over which a time between them is interpolated
_NEAREST_S = 0.02  # of a time to the one pose that counts where there is none on its other side
_LARGEST_DEG = 180.0  # of a sigma
_NO_SIGMAS = math.nan, math.nan
_FARTHEST_M = 1e9  # of a coordinate
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's cameras: x right, y up, z back
_Row = tuple[float, float, float, float]
_Name = Annotated[str, msgspec.Meta(max_length=4096)]


class PosesFileError(ValueError):
    """A file of poses that is not what it should be; the message names it."""


class _Frame(msgspec.Struct, frozen=True):
    file_path: _Name
    transform_matrix: tuple[_Row, _Row, _Row, _Row]
    sigma_m: float | None = None  # standard deviation of the position in each direction, metres
    sigma_deg: float | None = None  # of the orientation about each axis, degrees


class _Transforms(msgspec.Struct, frozen=True):
    frames: tuple[_Frame, ...]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T_world_camera (4, 4) in metres, OpenCV's axes, by the name of the photograph or by the time."""

    by_name: Mapping[str, Array] = field(default_factory=dict)
    seconds: Array = field(default_factory=lambda: np.zeros(0))  # (M,) rising
    Ts: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (M, 4, 4)
    # Of several cameras: by the folder and the name of the photograph, left/0001.jpg
    by_camera: Mapping[str, Array] = field(default_factory=dict)
    # Standard deviations (2,) of a position in each direction, metres, and of an orientation about each axis, degrees,
    # of those poses that tell them: by the name of the photograph, or of each time (M, 2), 0 where nothing is told
    sigmas_by_name: Mapping[str, Array] = field(default_factory=dict)
    sigmas: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def find_poses(self, frames: Iterable[Frame | DroppedFrame]) -> dict[str, Array]:
        """The poses of the frames that have one, by their names."""
        found = {each.name: self.pose_of(each) for each in frames if isinstance(each, Frame)}
        return {name: T for name, T in found.items() if T is not None}

    def find_sigmas(self, frames: Iterable[Frame | DroppedFrame]) -> dict[str, tuple[float, float]]:
        """The standard deviations, metres and degrees, of the poses that tell them, by the frames' names."""
        found = {each.name: self.sigmas_of(each) for each in frames if isinstance(each, Frame)}
        return {name: sigmas for name, sigmas in found.items() if sigmas is not None}

    def pose_of(self, frame: Frame) -> Array | None:
        """Returns the pose of one frame, T_world_camera (4, 4); None where it has none."""
        if self.by_name or self.by_camera:
            named = self.by_camera if "/" in frame.name else self.by_name
            return named[known] if (known := self.names(frame.name)) else None
        return None if (time := self._time_of(frame)) is None else self._interpolate_pose(time)

    def sigmas_of(self, frame: Frame) -> tuple[float, float] | None:
        """Returns the sigmas of one frame's pose, metres and degrees: between two poses the larger; None: not told."""
        if self.by_name or self.by_camera:
            sigmas = self.sigmas_by_name.get(self.names(frame.name))
        else:
            time = self._time_of(frame) if len(self.sigmas) else None
            near = np.zeros((0, 2)) if time is None else self.sigmas[self._neighbours(time)]
            sigmas = near.max(0) if len(near) and (near > 0).all() else None
        return None if sigmas is None or not np.isfinite(sigmas).all() else (float(sigmas[0]), float(sigmas[1]))

    def _time_of(self, frame: Frame) -> float | None:
        """The time at which the frame has a pose, seconds; or its number, where times are numbers."""
        if frame.captured_at is not None:
            seconds = frame.captured_at.ns / 1e9
            if self._neighbours(seconds) or frame.captured_at.clock is Clock.RECORDING:
                return seconds  # whole seconds of a recording are seconds, and no numbers of frames
        return float(frame.frame_id) if self._are_numbers else None

    @cached_property
    def _are_numbers(self) -> bool:
        """Whether the times are the numbers of frames, as where nobody knows when they were taken."""
        return bool((self.seconds == np.floor(self.seconds)).all() and (self.seconds < 1e6).all())

    def names(self, photograph: str) -> str:
        """The name by which it knows the photograph, which may lack the suffix; empty where it does not.

        Of several cameras it must know it with its camera's folder: photographs of two cameras may have one name.
        """
        named = self.by_camera if "/" in photograph else self.by_name
        return next((name for name in (photograph, photograph.rpartition(".")[0]) if name in named), "")

    def _neighbours(self, seconds: float) -> list[int]:
        """The poses between which this time is, or the one that counts for it; none where they are too far away."""
        after = int(np.searchsorted(self.seconds, seconds))
        near = [index for index in (after - 1, after) if 0 <= index < len(self.seconds)]
        if not near:
            return []
        nearest = min(near, key=lambda index: abs(self.seconds[index] - seconds))
        if abs(self.seconds[nearest] - seconds) < 1e-6:
            return [nearest]
        if len(near) < 2 or self.seconds[after] - self.seconds[after - 1] > _LONGEST_GAP_S:
            return [nearest] if abs(self.seconds[nearest] - seconds) <= _NEAREST_S else []
        return near

    def _interpolate_pose(self, seconds: float) -> Array | None:
        """The pose at this time, between its two neighbours; None where they are too far away."""
        near = self._neighbours(seconds)
        if len(near) < 2:
            return self.Ts[near[0]] if near else None
        between, T = self.seconds[near], np.eye(4)
        share = (seconds - between[0]) / (between[1] - between[0])
        T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix(self.Ts[near, :3, :3]))(share).as_matrix()
        T[:3, 3] = (1.0 - share) * self.Ts[near[0], :3, 3] + share * self.Ts[near[1], :3, 3]
        return T


def poses_of(trajectory: Trajectory, frames: Sequence[Frame | DroppedFrame], where: str) -> dict[str, Array]:
    """The poses of the frames that have one, by their names. Raises PosesFileError, `where` in it, where none has."""
    found = trajectory.find_poses(frames)
    if not found and any(isinstance(each, Frame) for each in frames):
        first = sanitize_text(next(each.name for each in frames if isinstance(each, Frame)), 100)
        known = [*trajectory.by_camera, *trajectory.by_name]
        has = (
            f"photographs such as {sanitize_text(min(known), 100)}"
            if known
            else (f"the times {trajectory.seconds[0]:.3f} to {trajectory.seconds[-1]:.3f} s")
        )
        raise PosesFileError(
            f"{where} has no pose of any photograph: it has {has}, and the first photograph is {first}. "
            "Name the photographs by their time in seconds, or give poses by the photographs' names"
        )
    return found


def read_poses(path: Path) -> Trajectory:
    """The poses in `path`: transforms.json, a folder with images.txt or images.bin, one of these, or a TUM trajectory.

    Raises PosesFileError, which names the file, and OSError.
    """
    if path.is_dir():
        there = [path / name for name in ("images.bin", "images.txt") if (path / name).exists()]
        if not there:
            raise PosesFileError(f"{path} must hold images.txt or images.bin of a COLMAP model; give that folder")
        path = there[0]
    where = str(path)
    if not path.exists():
        raise PosesFileError(
            f"{where} is not there; give a TUM trajectory, nerfstudio's transforms.json, or a COLMAP model's folder"
        )
    with guard_untrusted(PosesFileError, where):
        data = read_bounded(path, _MAX_BYTES, PosesFileError, where)
        try:
            return _read(path, data)
        except PosesFileError:
            raise
        except (ValueError, struct.error) as error:  # msgspec's errors are ValueErrors, too
            raise PosesFileError(
                f"{where} must be a TUM trajectory (time x y z qx qy qz qw), nerfstudio's transforms.json, or COLMAP's "
                f"images.txt or images.bin: {sanitize_text(str(error), 200)}"
            ) from error


def _read(path: Path, data: bytes) -> Trajectory:
    if path.suffix == ".json":
        content = record_in(data, _Transforms)
        _check_count(len(content.frames))
        matrices = np.array([each.transform_matrix for each in content.frames], np.float64).reshape(-1, 4, 4)
        has_sigmas = any(each.sigma_m is not None or each.sigma_deg is not None for each in content.frames)
        sigmas = (
            np.array([(each.sigma_m, each.sigma_deg) for each in content.frames], np.float64) if has_sigmas else None
        )
        return _make_named_trajectory([each.file_path for each in content.frames], matrices @ _OPENGL, sigmas)
    if path.suffix == ".bin":
        return _parse_colmap(binary_images(data))
    text = data.decode()
    if path.name.startswith("images"):
        return _parse_colmap(text_images(text))
    return _parse_tum(text)


def create_trajectory(poses: Iterable[tuple[str, Array]]) -> Trajectory:
    """Poses by the names of their photographs. Raises ValueError where one is no rigid motion or comes twice."""
    names, matrices = [], []
    for name, T in poses:
        names.append(name)
        matrices.append(np.asarray(T, np.float64))
    return _make_named_trajectory(names, np.stack(matrices) if matrices else np.zeros((0, 4, 4)))


def _make_named_trajectory(
    paths: Sequence[str], Ts: Array, sigmas: Sequence[Sequence[float]] | Array | None = None
) -> Trajectory:
    """As `create_trajectory`; Ts (M, 4, 4), sigmas (M, 2), NaN where a pose tells none."""
    names = [path if "/" not in path and path != "." else PurePosixPath(path).name for path in paths]
    if not names:
        raise ValueError("it holds no poses")
    by_name: dict[str, int] = {}  # places of the poses
    by_camera: dict[str, int] = {}
    shared = {name for name, count in Counter(names).items() if count > 1}  # by cameras, each in its folder
    for place, (path, name) in enumerate(zip(paths, names, strict=True)):
        folder = path.rstrip("/").rpartition("/")[0].rpartition("/")[2]
        of_camera = "" if folder in ("", ".", "..") else f"{folder}/{name}"
        if (name in shared and not of_camera) or of_camera in by_camera:
            raise ValueError(f"there are two poses of {sanitize_text(of_camera or name, 100)}")
        if of_camera:
            by_camera[of_camera] = place
        if name not in shared:
            by_name[name] = place
    _check(names, Ts)
    sigma_rows = None if sigmas is None else _check_sigmas(names, sigmas)
    known = (
        {}
        if sigma_rows is None
        else {key: sigma_rows[at] for key, at in (by_name | by_camera).items() if sigma_rows[at, 0] > 0}
    )
    poses = ({key: Ts[place] for key, place in places.items()} for places in (by_name, by_camera))
    return Trajectory(next(poses), by_camera=next(poses), sigmas_by_name=known)


def _parse_colmap(rows: Iterable[ImageRow]) -> Trajectory:
    names, numbers = [], array("d")
    for name, motion, _ in rows:
        _add(names, name)
        numbers.extend((*motion[4:], *motion[:4]))
    Ts_camera_world = _motions(numbers)
    _check(names, Ts_camera_world)
    return _make_named_trajectory(names, np.asarray(np.linalg.inv(Ts_camera_world), np.float64))


def _parse_tum(text: str) -> Trajectory:
    names, numbers, sigma_numbers = [], array("d"), array("d")
    for line in each_line(text):
        if line.strip() and not line.lstrip().startswith("#"):
            name, *motion = line.split(maxsplit=10)
            if len(motion) not in (7, 9):
                raise ValueError("each line must have eight values, or ten with the sigmas in metres and degrees")
            x, y, z, qx, qy, qz, qw, *sigmas = map(float, motion)
            _add(names, name)
            numbers.extend((x, y, z, qw, qx, qy, qz))
            sigma_numbers.extend(sigmas or _NO_SIGMAS)
    if not names:
        raise ValueError("each line must have eight values, and there must be one")
    Ts, by_line = _motions(numbers), np.array(sigma_numbers, np.float64).reshape(-1, 2)
    try:
        seconds = np.array([float(name) for name in names])
    except ValueError:  # names of photographs in place of times
        return _make_named_trajectory(names, Ts, by_line)
    _check(names, Ts)
    if not np.isfinite(seconds).all():
        raise ValueError("times must be finite")
    order = np.argsort(seconds, kind="stable")
    return Trajectory(seconds=seconds[order], Ts=Ts[order], sigmas=np.nan_to_num(_check_sigmas(names, by_line)[order]))


def _check_sigmas(names: Sequence[str], sigmas: Sequence[Sequence[float]] | Array) -> Array:
    """(M, 2) metres and degrees; NaN where a pose tells none. Raises ValueError where some are no sigmas."""
    rows = np.asarray(sigmas, np.float64).reshape(-1, 2)
    is_absent = np.isnan(rows).all(1)
    usable = (rows > 0).all(1) & (rows[:, 0] <= LARGEST_M) & (rows[:, 1] <= _LARGEST_DEG)
    for index in np.flatnonzero(~(is_absent | usable)):
        got = " and ".join("nothing" if math.isnan(value) else f"{value:g}" for value in rows[index])
        raise ValueError(
            f"the sigmas of the pose of {sanitize_text(names[int(index)], 100)} must be metres and degrees above 0, "
            f"up to {LARGEST_M:g} and {_LARGEST_DEG:g}; got {got}"
        )
    return rows


def _add(names: list[str], name: str) -> None:
    names.append(name)
    _check_count(len(names))


def _check_count(count: int) -> None:
    if count > MOST_POSES:
        raise ValueError(f"at most {MOST_POSES} poses are read, and there are more; leave some out")


def _motions(numbers: Sequence[float]) -> Array:
    """(M, 4, 4) of seven numbers each: a translation and a quaternion wxyz. NaN where that is no rotation."""
    rows = np.array(numbers, np.float64).reshape(-1, 7)
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3, 3] = rows[:, :3]
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(rows[:, 3:], axis=1)
        usable = np.isfinite(lengths) & (lengths > 0)
        quats = np.where(usable[:, None], rows[:, 3:] / lengths[:, None], [1.0, 0.0, 0.0, 0.0])
    if len(rows):
        Ts[:, :3, :3] = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    Ts[~usable, :3, :3] = np.nan
    return Ts


def _check(names: Sequence[str], Ts: Array) -> None:
    """Raises ValueError where one of the Ts (M, 4, 4) is no rigid motion of finite numbers."""
    in_place = Ts.copy()
    in_place[:, :3, 3] = 0.0
    is_near = np.all(np.abs(Ts[:, :3, 3]) <= _FARTHEST_M, axis=1)  # of NaN it is not said
    for index in np.flatnonzero(~(are_rigid(in_place) & is_near)):
        problem = rigid_problem(in_place[index].ravel().tolist())
        if not is_near[index]:
            problem = f"at finite coordinates within {_FARTHEST_M:g} m"
        if problem:
            raise ValueError(f"the pose of {sanitize_text(names[int(index)], 100)} must be {problem}")
