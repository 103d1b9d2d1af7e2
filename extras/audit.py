"""Which camera of a station has moved, when and by how much: recordings placed in a scene that was made before.

`audit` finds the cameras of each recording, places the few photographs of them that are looked at, measures how a
camera moved between two photographs of the same place, and makes periods and rigs of it.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture import film
from splatnode.capture.cameras import folder as cameras_folder
from splatnode.capture.cameras.folder import explain_unreadable_file, frame_name, image_paths
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lenses import assign_lens
from splatnode.capture.process.system import raise_shortage, remedy
from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress
from splatnode.capture.process.text import sanitize_name, sanitize_text
from splatnode.capture.recording import is_recording
from splatnode.extras import batch, lerobot
from splatnode.extras.cameras.mcap import SUFFIX as MCAP
from splatnode.recon.geometry import angles_deg, cross_matrix
from splatnode.recon.locating.localize import (
    Localization,
    choose_intrinsics,
    localize_with_inliers,
    prepare_query_image,
    stream_query_frames,
)
from splatnode.recon.locating.pose_refinement import POSE, optimize_camera, pose_covariance
from splatnode.recon.result.snapshot import Landmarks

MOST_PHOTOGRAPHS = 3  # of a camera that took many in one recording: the first, the last, and between
_ONE_CAMERA = "camera"  # the name of that which took a video that is named itself

_log = logging.getLogger(__name__)

_Place = tuple[str, ...]  # where a recording is: the parts of a path, of a data set's with the episode


@dataclass(frozen=True)
class ImageFiles:
    """Files, in their order; at most MOST_PHOTOGRAPHS."""

    paths: tuple[Path, ...]


@dataclass(frozen=True)
class Film:
    """A recording that is read in its order: what `capture/film.py` names, or a folder that `splatnode record` made."""

    path: Path


@dataclass(frozen=True)
class StationRecording:
    """One visit to the station."""

    name: str
    cameras: Mapping[str, ImageFiles | Film]  # by the name of the camera
    problem: str = ""  # why it has no cameras, in a sentence: it cannot be read


@dataclass(frozen=True)
class _Shot:
    """The images of one camera in one recording."""

    place: _Place
    camera: str
    pictures: ImageFiles | Film


@dataclass(frozen=True)
class _Unreadable:
    place: _Place
    reason: str


def find_recordings(named: Sequence[Path]) -> list[StationRecording]:
    """Finds the recordings in the order given: episodes by number, the content of a folder by name.

    A recording is a folder of photographs, one a camera, or of a folder a camera; an MCAP file, whose image topics are
    cameras; an episode of a LeRobot data set; a video, or a folder of videos, one a camera. A folder may hold such at
    any depth, and a text file may name them. Folders of photographs that lie side by side are cameras, or recordings if
    `_hold_a_camera_a_photograph` says so. Where two have one name, more of their paths tells them apart. What cannot be
    read is a recording with a problem.
    Raises FileNotFoundError or ValueError, with what to do, for what is named and is not there, holds nothing, or is
    named twice.
    """
    found: dict[_Place, dict[str, ImageFiles | Film]] = {}
    problems: dict[_Place, str] = {}
    lists: set[Path] = set()
    for path in named:
        for each in _find_shots(path, lists):
            cameras = found.setdefault(each.place, {})
            if each.place in problems or (isinstance(each, _Shot) and each.camera in cameras):
                raise ValueError(f"{str(Path(*each.place))!r} is given twice; give each recording once")
            if isinstance(each, _Shot):
                cameras[each.camera] = each.pictures
            else:
                problems[each.place] = sanitize_text(each.reason)
    names = _make_short_names(list(found))
    return [
        StationRecording(name, found[place], problems.get(place, "")) for name, place in zip(names, found, strict=True)
    ]


def _find_shots(path: Path, seen: set[Path], lists: tuple[Path, ...] = ()) -> Iterator[_Shot | _Unreadable]:
    """Yields what `path` names; `lists` led to it, and those of `seen` were read before."""
    if path.suffix.lower() == batch.LIST and path.is_file():
        for listed in batch.read_list(path, lists, seen):
            try:
                yield from _find_shots(listed, seen, (*lists, batch.real(path)))
            except (ValueError, FileNotFoundError) as error:
                raise_shortage(error)
                yield _Unreadable(listed.absolute().parts, str(error))
        return
    cameras = _find_cameras(path) if path.is_dir() else {}
    for camera, pictures in cameras.items():
        yield _Shot(path.absolute().parts, camera, pictures)
    if not cameras:
        of_days: dict[Path, bool] = {}  # of each folder, whether those in it are recordings
        for each in batch.recordings([path], None):
            source = Path(each.source)
            above = source.parent
            if source.is_dir() and above not in of_days:
                of_days[above] = _hold_a_camera_a_photograph(_folders_of_photographs(above))
            if source.is_dir() and of_days[above]:
                yield from (_Shot(source.parts, camera, of) for camera, of in _find_cameras(source).items())
            else:
                yield _make_shot(source, named=path.resolve())


def _find_cameras(folder: Path) -> dict[str, ImageFiles | Film]:
    """The cameras of a folder of photographs, or of folders of them; none of any other.

    What photographs lie beside is left out, and said: small copies of them, for example.
    """
    if is_recording(folder):
        return {_ONE_CAMERA: Film(folder)}
    if lerobot.is_data_set(folder):
        return {}
    below, photographs = _folders_of_photographs(folder), image_paths(folder)
    if photographs and below:
        names = ", ".join(frame_name(child) for child in below)
        _log.warning("%s: its photographs are its cameras; left out: %s", sanitize_name(folder.name), names)
    if not photographs:
        return (
            {} if _hold_a_camera_a_photograph(below) else {frame_name(child): _make_pictures(child) for child in below}
        )
    cameras: defaultdict[str, list[Path]] = defaultdict(list)
    for path in photographs:
        cameras[_parse_camera_name(path)].append(path)
    return {camera: ImageFiles(_select_few(_skip_raw_files(paths))) for camera, paths in cameras.items()}


def _folders_of_photographs(folder: Path) -> list[Path]:
    return sorted(child for child in folder.iterdir() if child.is_dir() and _is_of_one_camera(child))


def _is_of_one_camera(folder: Path) -> bool:
    return is_recording(folder) or (bool(image_paths(folder)) and not (folder / batch.REPORT).is_file())


def _hold_a_camera_a_photograph(folders: Sequence[Path]) -> bool:
    """Whether folders that lie side by side are recordings, with a photograph a camera, rather than cameras.

    They are if two of them have two names of photographs in common that are no numbers of a sequence.
    """
    named = [
        {_parse_camera_name(path) for path in image_paths(folder)} for folder in folders if not is_recording(folder)
    ]
    named = [{name for name in names if not name[-1].isdigit()} for names in named]
    return any(len(one & other) > 1 for one, other in combinations(named, 2))


def _parse_camera_name(path: Path) -> str:
    """The name of the camera that a photograph, beside those of others, or a video is called by."""
    return Path(frame_name(path)).stem


def _skip_raw_files(paths: Sequence[Path]) -> Sequence[Path]:
    """Without raw files, beside which their cameras put photographs; all where there is nothing else."""
    return [path for path in paths if explain_unreadable_file(path) is None] or paths


def _make_pictures(folder: Path) -> ImageFiles | Film:
    return Film(folder) if is_recording(folder) else ImageFiles(_select_few(_skip_raw_files(image_paths(folder))))


def _make_shot(path: Path, named: Path) -> _Shot | _Unreadable:
    """Makes the shot of one recording of a batch; `named` is the path that led to it."""
    file, part = film.file_and_part(path)
    try:
        if part and lerobot.is_data_set(file):
            number, key = lerobot.episode_and_camera(file, lerobot.read_info(file), part)
            return _Shot((*file.parts, lerobot.episode_name(number)), sanitize_name(key), Film(path))
        if not part and (lerobot.is_data_set(file) or file.suffix.lower() == MCAP):
            batch.list_parts(file)  # which has found none; one of both tells why
            film.stream(file)
    except ModuleNotFoundError as error:
        return _Unreadable(path.parts, f"{error.name} is not installed. {remedy(error.name or '')}")
    except (ValueError, OSError) as error:
        raise_shortage(error)
        return _Unreadable(path.parts, str(error))
    if part and file.suffix.lower() == MCAP:
        return _Shot(file.parts, sanitize_name(part), Film(path))
    if path == named:
        return _Shot(path.parts, _ONE_CAMERA, Film(path))
    camera = frame_name(path) if path.is_dir() else _parse_camera_name(file)
    return _Shot(path.parent.parts, camera, _make_pictures(path) if path.is_dir() else Film(path))


def _select_few(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The first, the last, and what lies evenly between."""
    most = min(len(paths), MOST_PHOTOGRAPHS)
    return tuple(paths[round(i * (len(paths) - 1) / max(most - 1, 1))] for i in range(most))


def _make_short_names(places: Sequence[_Place]) -> list[str]:
    """As short as tells them apart."""
    length = 1
    while len({place[-length:] for place in places}) < len(places):
        length += 1
    return [sanitize_name("/".join(place[-length:])) for place in places]


# The few photographs of a camera that tell where it stood in a recording, and whether it stood still.

_MOST_HELD = 9  # photographs in memory, evenly spread over what was read of a film so far


def load_sample_frames(pictures: ImageFiles | Film, given: Intrinsics | None) -> list[Frame | DroppedFrame]:
    """The photographs; of a film the first, one from about the middle and the last. `given` is their lens.

    At least one: where nothing can be read, it is a dropped frame that says why.
    """
    if isinstance(pictures, ImageFiles):
        return _read_all(stream_query_frames(pictures.paths, given), pictures.paths[0])
    frames = _read_all(_sample_frames(_stream(pictures.path)), pictures.path)
    return frames if given is None else [assign_lens(frame, given) for frame in frames]


def load_first_frames(recordings: Iterable[StationRecording]) -> Iterator[Frame | DroppedFrame]:
    """The first photograph that can be read of each camera in each recording; where there is none, why."""
    for pictures in (each for recording in recordings for each in recording.cameras.values()):
        if isinstance(pictures, ImageFiles):
            frames, path = stream_query_frames(pictures.paths, None), pictures.paths[0]
        else:
            frames, path = _stream(pictures.path), pictures.path
        yield from _read_all(islice((frame for frame in frames if isinstance(frame, Frame)), 1), path)


def _stream(path: Path) -> Iterator[Frame | DroppedFrame]:
    yield from film.stream(path) if film.is_film(path) else cameras_folder.stream(cameras_folder.Config(folder=path))


def _read_all(frames: Iterator[Frame | DroppedFrame], path: Path) -> list[Frame | DroppedFrame]:
    """All of them; in place of what cannot be read from `path`, why."""
    found: list[Frame | DroppedFrame] = []
    try:
        found += frames
    except ModuleNotFoundError as error:
        reason = f"{error.name} is not installed. {remedy(error.name or '')}"
    except (ValueError, OSError) as error:
        raise_shortage(error)
        reason = str(error)
    else:
        reason = "it holds no photographs"
    return found or [DroppedFrame(sanitize_name(path.name), sanitize_text(reason))]


def _sample_frames(frames: Iterator[Frame | DroppedFrame]) -> Iterator[Frame | DroppedFrame]:
    """The first, one within an eighth of the middle, and the last; what cannot be used only where there is no other.

    However many there are, few are in memory: when these are too many, every second one is given up, and from then on
    every second one is held.
    """
    held: list[tuple[int, Frame]] = []
    unusable: DroppedFrame | None = None
    last, count, step = None, 0, 1
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            unusable = unusable or frame
            continue
        if count % step == 0:
            held.append((count, frame))
        if len(held) > _MOST_HELD:
            held, step = held[::2], 2 * step
        last, count = frame, count + 1
    if last is not None:
        middle, between = min(held, key=lambda each: abs(2 * each[0] - count + 1))
        chosen = {0: held[0][1], middle: between, count - 1: last}
        yield from chosen.values()
    elif unusable is not None:
        yield unusable


# How a camera moved between two photographs, by the landmarks that both show.
#
# Each photograph by itself is placed as well as the landmarks are known. What is wrong with a landmark moves it alike
# in both pictures, so that the difference tells of a move far smaller than that: here the shift in the picture, of
# each landmark that both show, is explained by a turn and a shift of the camera.

Array = npt.NDArray[np.float64]

# Chi-squared with 6 degrees of freedom that chance exceeds once in a million: the move is no chance beyond it.
UNLIKELY = 38.26
MIN_COMMON = 30  # landmarks that both photographs must show; with fewer, what is known of each by itself decides
_LEAST_NOISE = 2.5e-4  # of the longer side: no shift of a feature is known better than an eighth of 512 pixels' one


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """The motion of a camera between two images, in the frame of the first: x right, y down, z forward."""

    T_before_after: Array  # (4, 4): p_before = T_before_after @ p_after
    covariance: Array  # (6, 6) of a small motion in that frame: shift (result's unit), then turn (radians)
    common: int  # landmarks that both show and that it was measured by; 0: each photograph was placed by itself

    @property
    def degrees(self) -> float:
        """The angle of the rotation."""
        return float(angles_deg(self.T_before_after[None, :3, :3], np.eye(3)[None])[0])

    @property
    def distance(self) -> float:
        """The length of the shift, in the result's unit."""
        return float(np.linalg.norm(self.T_before_after[:3, 3]))

    @property
    def degrees_sigma(self) -> float:
        """The standard deviation of the turn along the axis about which it is known worst."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))

    @property
    def distance_sigma(self) -> float:
        """The standard deviation of the shift in the direction in which it is known worst."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def format_motion(self, unit: float, metric: bool) -> str:
        """How far, with two standard deviations: in centimetres if the result is `metric`, else over its `unit`."""
        turn = f"{self.degrees:.2g} degrees (± {2 * self.degrees_sigma:.1g})"
        distance, sigma = self.distance, 2 * self.distance_sigma
        if metric:
            return f"{turn} and {100 * distance:.2g} cm (± {100 * sigma:.1g})"
        return f"{turn} and {100 * distance / unit:.2g} % of the distance (± {100 * sigma / unit:.1g})"

    @property
    def is_significant(self) -> bool:
        """Whether the motion exceeds chance."""
        step = twist(self.T_before_after)
        return float(step @ np.linalg.solve(self.covariance, step)) > UNLIKELY

    @property
    def least_turn_deg(self) -> float:
        """The smallest turn alone that would be significant, about the axis about which the least is known."""
        information = np.linalg.inv(self.covariance)[3:, 3:]
        return float(np.degrees(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0])))

    @property
    def least_shift(self) -> float:
        """The smallest shift alone that would be significant, in the direction in which the least is known."""
        information = np.linalg.inv(self.covariance)[:3, :3]
        return float(np.sqrt(UNLIKELY / np.linalg.eigvalsh(information)[0]))


def measure_motion(before: Localization, after: Localization) -> MeasuredMotion:
    """How the camera of the photograph `before` moved until `after`; both are of one camera.

    Where it has another lens since, as once it zoomed, what each photograph says by itself is compared.
    """
    own, other = _find_common(before, after)
    T = np.linalg.inv(before.camera.T_world_camera) @ after.camera.T_world_camera
    apart = before.located.covariance + _rotate_covariance(after.located.covariance, T)
    if len(own) >= MIN_COMMON and before.size == after.size and _has_same_lens(before, after):
        measured = _fit_motion(before, own, after.seen.pixels[other] - before.seen.pixels[own])
        if measured is not None:
            depth = float(np.median(before.camera.project(before.seen.points[own])[1]))
            otherwise = _compute_unshared_error(measured, min(depth, before.spread))
            return replace(measured, covariance=measured.covariance + otherwise**2 * apart)
    return MeasuredMotion(T, apart, 0)


def _has_same_lens(before: Localization, after: Localization) -> bool:
    """Whether the focal lengths differ by no more than their bounds allow."""
    first, second = (np.diag(each.located.K)[:2] for each in (before, after))
    bounds = [math.log1p(each.located.claim.focal_percent / 100.0) for each in (before, after)]
    return bool(np.abs(np.log(second / first)).max() <= math.hypot(*bounds))


def _compute_unshared_error(motion: MeasuredMotion, reach: float) -> float:
    """The share of what is wrong with the scene that is not the same for both cameras, in [0, 1].

    A scene that is bent turns its cameras against each other, those that are farther apart by more: it is all for two
    that are `reach` apart, which is how far the scene's cameras stand from each other, or from the scene, if that is
    less. It grows with the angle between the directions in which the two look, too.
    """
    if motion.distance >= reach:
        return 1.0
    return min(1.0, motion.distance / reach + np.radians(motion.degrees))


def _find_common(before: Localization, after: Localization) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The places of the landmarks that both show, among those that each shows."""
    _, own, other = np.intersect1d(before.seen.landmark_of, after.seen.landmark_of, return_indices=True)
    return own, other


def _fit_motion(before: Localization, own: npt.NDArray[np.int64], shifts: Array) -> MeasuredMotion | None:
    """The motion that explains the `shifts` (M, 2) of the landmarks in the picture; None where they do not tell it.

    The landmarks, and the lens, count as exact: what is wrong with them is so in both photographs.
    """
    start, seen = before.camera, before.seen.select(own)
    pixels = start.project(seen.points)[0] + shifts
    exact = replace(seen, pixels=pixels, covariances=np.zeros_like(seen.covariances))
    lens = replace(start.lens, log_focal_sigma=0.0, radial_sigma=0.0, shift_sigma=0.0, log_aspect_sigma=0.0)
    fit = optimize_camera(start, lens, exact, _LEAST_NOISE * max(before.size))
    if not np.isfinite(fit.covariance).all():
        return None
    T = np.linalg.inv(start.T_world_camera) @ fit.camera.T_world_camera
    return MeasuredMotion(T, _rotate_covariance(pose_covariance(fit.camera, fit.covariance), T), len(own))


def adjoint(T: Array) -> Array:
    """(6, 6) what makes of a small motion, shift then turn, the same in the frame that T (4, 4) leads to."""
    result = np.zeros((POSE, POSE))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[:3, 3:] = cross_matrix(T[None, :3, 3])[0] @ T[:3, :3]
    return result


def twist(T: Array) -> Array:
    """(6,) the shift and the rotation vector of a motion (4, 4)."""
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def _rotate_covariance(covariance: Array, T_before_after: Array) -> Array:
    """The covariance (6, 6) of a small motion in the frame of the second photograph, along the axes of the first."""
    turn = np.kron(np.eye(2), T_before_after[:3, :3])
    return turn @ covariance @ turn.T


# A camera of a station in one recording: where it stood, or why that is not known.

MOVING = "MOVING"  # the code of a camera that did not stand still
UNREADABLE = "UNREADABLE"


@dataclass(frozen=True, eq=False)
class CameraSighting:
    """A camera that stood still."""

    photograph: str
    placed: Localization


@dataclass(frozen=True)
class SightingFailure:
    """Why it is not known where a camera stood."""

    photograph: str
    code: str  # a Reason of recon/locating/__init__.py, MOVING or UNREADABLE
    message: str


def localize_camera(
    landmarks: Landmarks, frames: Iterable[Frame | DroppedFrame], fov_deg: float | None = None
) -> CameraSighting | SightingFailure:
    """Localizes the camera that took these images of one recording; there is at least one.

    `fov_deg` is its angle of view across the longer side, in degrees. Of several photographs all that can be placed
    must be of one place.
    """
    first, problem = None, None
    for frame in frames:
        if isinstance(frame, DroppedFrame):
            problem = problem or SightingFailure(frame.name, UNREADABLE, frame.reason)
            continue
        try:
            photograph = prepare_query_image(frame.image, choose_intrinsics(frame, fov_deg), name=frame.name)
        except ValueError as error:  # of its lens, which nothing can undo
            problem = problem or SightingFailure(frame.name, UNREADABLE, str(error))
            continue
        found = localize_with_inliers(landmarks, photograph)
        if not isinstance(found, Localization):
            problem = problem or SightingFailure(frame.name, found.code.value, found.message)
        elif first is None:
            first = CameraSighting(frame.name, found)
        elif (since := measure_motion(first.placed, found)).is_significant:
            phrase = f"since {first.photograph} it moved by {since.format_motion(landmarks.unit, landmarks.metric)}"
            return SightingFailure(
                frame.name, MOVING, f"{phrase}: only a camera that stands still in a recording can be compared"
            )
    if first is not None:
        return first
    assert problem is not None  # there is at least one photograph
    return problem


# When each camera of a station stood still, when it moved, and which moved as one.


@dataclass(frozen=True, eq=False)
class Period:
    """Recordings in which a camera stood where it was in the first of them, as far as can be told."""

    recordings: tuple[int, ...]  # by number, rising: those in which the camera was placed
    sighting: CameraSighting  # in the first of them
    last_motion: MeasuredMotion | None  # from the first to the last of them, which tells what would have been noticed
    came_by: MeasuredMotion | None  # from the period before; None: it is the first


@dataclass(frozen=True)
class Move:
    """Cameras that moved as one between two recordings."""

    after: int  # the last recording before it, by number; of several cameras, the latest
    before: int  # the first recording after it; the earliest
    cameras: tuple[str, ...]


def extend_history(history: Sequence[Period], number: int, sighting: CameraSighting) -> list[Period]:
    """The periods of one camera, once it was seen in the recording `number`, too, which is later than theirs.

    It is compared with the first recording of the last period: drift adds up.
    """
    if not history:
        return [Period((number,), sighting, None, None)]
    *earlier, last = history
    since = measure_motion(last.sighting.placed, sighting.placed)
    if since.is_significant:
        return [*earlier, last, Period((number,), sighting, None, since)]
    return [*earlier, Period((*last.recordings, number), last.sighting, since, last.came_by)]


@dataclass(frozen=True, eq=False)
class _PeriodChange:
    """From one period of a camera to the next."""

    camera: str
    earlier: Period
    later: Period

    @property
    def after(self) -> int:
        return self.earlier.recordings[-1]

    @property
    def before(self) -> int:
        return self.later.recordings[0]


def find_moves(histories: Mapping[str, Sequence[Period]]) -> list[Move]:
    """All moves, in their order; cameras that moved alike in the world between the same recordings are one."""
    steps = [
        _PeriodChange(name, earlier, later)
        for name, history in histories.items()
        for earlier, later in pairwise(history)
    ]
    groups: list[list[_PeriodChange]] = []
    for step in sorted(steps, key=lambda step: (step.before, step.after, step.camera)):
        fitting = (
            group for group in groups if all(_overlap(step, each) and _is_same_motion(step, each) for each in group)
        )
        group = next(fitting, None)
        if group is None:
            groups.append([step])
        else:
            group.append(step)
    return [
        Move(
            max(each.after for each in group), min(each.before for each in group), tuple(each.camera for each in group)
        )
        for group in groups
    ]


def _overlap(one: _PeriodChange, other: _PeriodChange) -> bool:
    """Whether both may have happened at one moment."""
    return max(one.after, other.after) < min(one.before, other.before)


def _is_same_motion(one: _PeriodChange, other: _PeriodChange) -> bool:
    """Whether both cameras may be on one body that moved: the world's points moved alike for both."""
    first, second = _require_motion(one), _require_motion(other)
    T_other_one = np.linalg.inv(_pose(other)) @ _pose(one)
    expected = T_other_one @ first.T_before_after @ np.linalg.inv(T_other_one)
    covariance = adjoint(T_other_one) @ first.covariance @ adjoint(T_other_one).T + second.covariance
    difference = twist(np.linalg.inv(expected) @ second.T_before_after)
    return bool(difference @ np.linalg.solve(covariance, difference) < UNLIKELY)


def _require_motion(step: _PeriodChange) -> MeasuredMotion:
    assert step.later.came_by is not None  # it is not the first period
    return step.later.came_by


def _pose(step: _PeriodChange) -> Array:
    """(4, 4) where the camera stood, to the world."""
    return step.earlier.sighting.placed.camera.T_world_camera


@dataclass(frozen=True, eq=False)
class Audit:
    """The result of `audit`. Recordings are identified by their number in `recordings`."""

    recordings: tuple[str, ...]  # their names, in the order given, which is that of time
    periods: Mapping[str, Sequence[Period]]  # of each camera that was placed at least once, by its name
    not_seen: Mapping[str, Mapping[int, SightingFailure]]  # of each camera, where it was not placed
    unreadable: Mapping[int, str]  # recordings of whose cameras nothing is known, and why
    moves: Sequence[Move]  # in their order
    unit: float  # the distance to the scene: the median depth of its points, in the unit of the result
    metric: bool  # lengths are metres

    @property
    def comparable_cameras(self) -> list[str]:
        """The cameras that were placed in two recordings or more."""
        return [name for name, history in self.periods.items() if sum(len(each.recordings) for each in history) > 1]


def audit(
    landmarks: Landmarks,
    recordings: Sequence[StationRecording],
    given: Intrinsics | None = None,
    fov_deg: float | None = None,
    tell: Tell = ignore_progress,
) -> Audit:
    """Localizes each camera in each recording, in the world of the landmarks, and finds when it moved.

    `given` is the cameras' lens; `fov_deg` their angle of view across the longer side, in degrees. What is in memory
    grows with the moves, not with the recordings.
    """
    histories: dict[str, list[Period]] = {}
    not_seen: dict[str, dict[int, SightingFailure]] = {}
    total, done = sum(len(recording.cameras) for recording in recordings), 0
    for number, recording in enumerate(recordings):
        for camera, pictures in recording.cameras.items():
            tell(ProgressStep("placing", done, total, "camera"))
            found = localize_camera(landmarks, load_sample_frames(pictures, given), fov_deg)
            if isinstance(found, CameraSighting):
                histories[camera] = extend_history(histories.get(camera, ()), number, found)
            else:
                not_seen.setdefault(camera, {})[number] = found
            done += 1
    histories = {camera: histories[camera] for camera in sorted(histories)}
    names = tuple(recording.name for recording in recordings)
    unreadable = {number: each.problem for number, each in enumerate(recordings) if each.problem}
    return Audit(names, histories, not_seen, unreadable, find_moves(histories), landmarks.unit, landmarks.metric)
