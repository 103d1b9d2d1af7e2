"""Photographs, all at hand or one at a time, reconstructed in the process that has them: no sockets, no daemon."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.api.arguments import (
    DepthOf,
    Mounts,
    Sigmas,
    append_motion,
    check_camera_id,
    enter_api,
    find_mount,
    make_gravity,
    make_intrinsics,
    make_pose,
    parse_mounts,
    parse_sigmas,
    parse_single_depth,
)
from splatnode.api.photographs import (
    Depths,
    Images,
    Lens,
    LensChoice,
    Masks,
    Picture,
    SeveralCameras,
    add_depths,
    apply_lens,
    lenses,
    list_images,
    load_frames,
    make_frame,
    make_mask_finder,
    names_of,
)
from splatnode.api.result import Result, result_of
from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.frame import Baseline as Apart
from splatnode.capture.frame import DroppedFrame, Frame, Motion, RightImage, Stamp, grey
from splatnode.capture.keyframe_selection import Config as Selection
from splatnode.capture.keyframe_selection import Limits, Selector
from splatnode.capture.lenses import assign_lens, check_fits
from splatnode.capture.pose_files import Trajectory, create_trajectory, poses_of, read_poses
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.terminal import Tell, add_remaining_time, ignore_progress, notify
from splatnode.recon import threads as limits
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.config import preset as named
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.metric.metres import NOTHING, Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.metric.stereo import StereoPair, make_pairs, stream_right_images
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.pipeline import OfflineResult, check_baseline, rebuild_from_scratch, reconstruct_source
from splatnode.recon.replay_source import Source, add_poses, apply_masks, apply_rig
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import FrameChoice

# Photographs that are all at hand, reconstructed in the process that asks.

log = logging.getLogger(__name__)

# Poses as a program has them: a file, or matrices, by the photographs' names or in their order.

Matrix: TypeAlias = "npt.NDArray[np.floating]"
PosesSigma: TypeAlias = "Sigmas | Mapping[str, Sigmas] | Sequence[Sigmas | None]"
Poses: TypeAlias = "str | PathLike[str] | Mapping[str, Matrix] | Sequence[Matrix | None]"


def sigmas_of(poses_sigma: PosesSigma | None) -> dict[str, float] | None:
    """Returns the settings of `metric` that the standard deviations of all poses change. Raises TypeError."""
    if poses_sigma is None or not _is_of_all(poses_sigma):
        return None
    return dict(zip(("poses_sigma_m", "poses_sigma_deg"), parse_sigmas(poses_sigma, "poses_sigma"), strict=True))


def poses_given(
    poses: Poses | None, images: Images, frames: Sequence[Frame | DroppedFrame]
) -> dict[str, npt.NDArray[np.float64]] | None:
    """The poses of the frames that have one, by their names. Raises TypeError, ValueError, FileNotFoundError."""
    trajectory = load_trajectory(poses, images)
    where = fspath(poses) if isinstance(poses, (str, PathLike)) else "poses"
    return None if trajectory is None else poses_of(trajectory, frames, where)


def load_trajectory(poses: Poses | None, images: Images) -> Trajectory | None:
    """The poses as they are given, by name or time. Raises TypeError, ValueError, FileNotFoundError."""
    if poses is None:
        return None
    if isinstance(poses, (str, PathLike)):
        return read_poses(Path(poses))
    return create_trajectory(_list_named_poses(poses, images))


def own_sigmas_of(
    poses: Poses | None, sigma: PosesSigma | None, images: Images, frames: Sequence[Frame | DroppedFrame]
) -> dict[str, Sigmas]:
    """The standard deviations of single poses, by the frames' names: as given, else as their file tells them.

    Raises TypeError, ValueError.
    """
    if sigma is not None and not _is_of_all(sigma):
        return _list_named_sigmas(sigma, images)
    trajectory = load_trajectory(poses, images) if isinstance(poses, (str, PathLike)) else None
    return {} if trajectory is None else trajectory.find_sigmas(frames)


def _is_of_all(sigma: PosesSigma) -> bool:
    """Whether these are two numbers, of all poses, or else no mapping or list of such."""
    return not isinstance(sigma, Mapping) and not (
        isinstance(sigma, Sequence) and any(isinstance(each, (Sequence, type(None))) for each in sigma)
    )


def _list_named_sigmas(sigma: Any, images: Images) -> dict[str, Sigmas]:
    if isinstance(sigma, Mapping):
        return {frame_name(Path(name)): parse_sigmas(each, "poses_sigma") for name, each in sigma.items()}
    names = names_of(images)
    if len(sigma) != len(names):
        raise ValueError(f"poses_sigma must be one for each of the {len(names)} photographs, got {len(sigma)}")
    pairs = zip(names, sigma, strict=True)
    return {name: parse_sigmas(each, "poses_sigma") for name, each in pairs if each is not None}


def _list_named_poses(
    poses: Mapping[str, Matrix] | Sequence[Matrix | None], images: Images
) -> list[tuple[str, npt.NDArray[np.float64]]]:
    if isinstance(poses, Mapping):
        return [(str(Path(name).parent / frame_name(Path(name))), parse_matrix(T)) for name, T in poses.items()]
    names = names_of(images)
    if len(poses) != len(names):
        raise ValueError(f"poses must be one for each of the {len(names)} photographs, got {len(poses)}")
    return [(name, parse_matrix(T)) for name, T in zip(names, poses, strict=True) if T is not None]


def parse_matrix(T: Any) -> npt.NDArray[np.float64]:
    """Returns a pose as a matrix (4, 4). Raises TypeError where it is none."""
    matrix = np.asarray(T, np.float64)
    if matrix.shape != (4, 4):
        raise TypeError(f"a pose must be T_world_camera (4, 4) or None, got shape {matrix.shape}")
    return matrix


# What a program knows of a scene's size: measured distances, printed markers, stereo pairs.

Baseline: TypeAlias = tuple[str | int, str | int, float]  # two photographs and the metres between their cameras


@dataclass(frozen=True)
class Marker:
    """Printed markers in the scene, all of one size: those of `splatnode marker`, ArUco's, or AprilTags."""

    side_m: float  # of the black square, metres
    sigma_m: float = 0.0005  # standard deviation of that side as it was measured, metres
    dictionary: str = "4X4_50"  # of OpenCV's ArUco dictionaries, or APRILTAG_36h11


@dataclass(frozen=True, eq=False)
class Stereo:
    """A second camera to the right of the first: what both saw at once are rectified pairs."""

    right: (
        str | PathLike[str] | Sequence[Any]
    )  # its photographs: a folder, where both of a pair have one name, or a list
    baseline_m: float  # between the two cameras, metres
    sigma_m: float = 0.0003  # standard deviation of that distance, metres


Known: TypeAlias = Baseline | Marker | Stereo
Scale: TypeAlias = Known | Sequence[Known]


def metric_changes(scale: Scale, of_pictures: bool) -> dict[str, Any]:
    """Returns the settings of `metric` for this scale; `of_pictures`: photographs are named by their places in a list.

    Raises TypeError, and ValueError for markers of two kinds.
    """
    changes: dict[str, Any] = {}
    baselines = []
    markers = {each for each in _list_scale_sources(scale) if isinstance(each, Marker)}
    if len(markers) > 1:
        raise ValueError(f"scale can have markers of one size and dictionary alone, got {len(markers)} kinds of Marker")
    for each in _list_scale_sources(scale):
        if isinstance(each, Marker):
            changes |= _make_marker_settings(each)
        elif isinstance(each, Stereo):
            changes |= {"stereo_baseline_m": each.baseline_m, "stereo_baseline_sigma_m": each.sigma_m}
        else:
            baselines.append(_baseline(each, of_pictures))
    if baselines:
        changes |= {"baseline": baselines[0], "further_baselines": baselines[1:]}
    return changes


def is_stereo(scale: Scale | None) -> bool:
    """Whether stereo pairs are among what is known."""
    return any(isinstance(each, Stereo) for each in _list_scale_sources(scale))


def pairs_given(scale: Scale | None, images: Images, frames: Sequence[Frame | DroppedFrame]) -> tuple[StereoPair, ...]:
    """The stereo pairs of the frames, in which `images` resulted, of several stereo cameras each with their baseline.

    Raises TypeError, ValueError, FileNotFoundError.
    """
    stereos = [each for each in _list_scale_sources(scale) if isinstance(each, Stereo)]
    several = len(stereos) > 1  # else the configuration's is theirs
    return tuple(
        replace(pair, baseline=Apart(each.baseline_m, each.sigma_m)) if several else pair
        for each in stereos
        for pair in make_pairs(frames, _load_right_frames(each.right, images, frames))
    )


def _load_right_frames(
    right: object, images: Images, frames: Sequence[Frame | DroppedFrame]
) -> Iterable[Frame | DroppedFrame]:
    if isinstance(right, (str, PathLike)):
        return stream_right_images(Path(right), frames)
    names, pictures = names_of(images), list_images(right)
    if len(names) != len(pictures):
        raise ValueError(f"right must have one picture for each of the {len(names)} photographs, got {len(pictures)}")
    return [
        make_frame(each, number, name, number) for number, (name, each) in enumerate(zip(names, pictures, strict=True))
    ]


def _list_scale_sources(scale: object) -> Sequence[object]:
    """Lists the scale sources one by one: a sequence of distances, markers and pairs is several."""
    if isinstance(scale, (list, tuple)) and all(isinstance(each, (list, tuple, Marker, Stereo)) for each in scale):
        return scale
    return (scale,)


def _make_marker_settings(marker: Marker) -> dict[str, Any]:
    return {
        "marker_size_m": marker.side_m,
        "marker_size_sigma_m": marker.sigma_m,
        "marker_dictionary": marker.dictionary,
    }


def _baseline(scale: object, of_pictures: bool) -> list[Any]:
    """As the configuration has it."""
    if not isinstance(scale, (tuple, list)) or len(scale) != 3 or not isinstance(scale[2], (int, float)):
        raise TypeError(
            "scale must be two photographs and the metres between them, ('a.jpg', 'b.jpg', 0.5), or a Marker, or a "
            f"Stereo, or a list of these; got {scale!r}"
        )
    first, second, metres = scale
    return [_name(first, of_pictures), _name(second, of_pictures), float(metres)]


def _name(photograph: object, of_pictures: bool) -> str:
    if isinstance(photograph, int) and of_pictures:
        return f"{photograph:04d}.png"
    if isinstance(photograph, (str, PathLike)):
        return frame_name(Path(fspath(photograph)))
    raise TypeError(f"scale must name photographs by their files, or pictures by their places, got {photograph!r}")


Changes = Mapping[str, Any] | str | PathLike[str]


@enter_api()
def reconstruct(
    images: Images,
    *,
    cameras: str | Sequence[str] | None = None,
    camera_ids: Sequence[str | None] | None = None,
    captured_at: Sequence[Stamp | None] | None = None,
    intrinsics: LensChoice | None = None,
    poses: Poses | None = None,
    poses_sigma: PosesSigma | None = None,
    check_poses: bool = False,
    rig: str | PathLike[str] | None = None,
    masks: Masks | None = None,
    depths: Depths | None = None,
    scale: Scale | None = None,
    frame: FrameChoice | None = None,
    T_base_camera: Mounts | None = None,
    gravity: npt.ArrayLike | Mapping[str, npt.ArrayLike] | None = None,
    budget_s: float | None = None,
    preset: str = "balanced",
    config: Changes | None = None,
    views: int | None = None,
    every_frame: bool = False,
    multi_view_only: bool = False,
    seed: int | None = None,
    threads: int | None = None,
    tell: Tell | None = None,
    only_seen: bool | None = None,
    poses_only_check: bool | None = None,
) -> Result:
    """Reconstructs images: the same cameras and Gaussians, to the bit, as `splatnode replay`.

    A rejection is a result, too: ask `verdict.publishable`. Several threads may call this at once. Raises TypeError,
    ValueError, FileNotFoundError. What of an input is left out is told as an `InputWarning`.

    - `images`: a folder, a video, an image topic `"drive.mcap#/front/image"`, an episode `"pusht#3/CAMERA"` of a
      LeRobot data set, a list of paths in one folder, or a list of arrays (H, W, 3) uint8 RGB or PIL images. Grey
      becomes RGB; alpha 0 is masked. Of a video, and of more than 30 images, keyframes are selected.
    - `cameras`: the cameras of one robot, as `--cameras`: `"all"`, or names of folders, topics or keys; of listed
      folders or videos a name for each. Each camera has its own lens; images are called `left/0001.jpg`.
    - `camera_ids`, `captured_at`: of listed images, which camera took each (None: unknown) and when, a `Stamp`. Images
      of different cameras within `frame_set_tolerance_s` of `config` are a frame set, used or left out as one.
    - `intrinsics`: `Intrinsics`, or K (3, 3) in pixels of undistorted images: for all images of its aspect ratio, in a
      list for each image (None: unknown), or in a mapping by image, camera id, name prefix or pattern:
      `{"left": a, "right": b}`. None: EXIF's, else estimated.
    - `poses`: T_world_camera (4, 4) in metres by image name, in a list (None: unknown), or a file as for `--poses`.
      They give metres and the world's axes; one that does not fit is named and left out. `poses_sigma`: standard
      deviations, metres and degrees, of all poses or in a list or mapping. With sigmas (also from the file) and
      `intrinsics` they are priors of the cameras, unless `check_poses` (formerly `poses_only_check`).
    - `rig`: a file with where the cameras stand to each other, as for `--rig`. None: a log tells, else the images do.
    - `masks`: white (any value above 0) is used, black is ignored. A folder of masks with the images' names, one file
      for all, or a list of arrays (H, W), paths, or None. None: all is used.
    - `depths`: of a depth camera, for metres and plain walls: a folder, a mapping by names, or a list of `DepthImage`,
      files (16-bit PNG, .npy, .exr), or aligned arrays (H, W): uint16 millimetres, float metres; None: unknown.
    - `scale`: the metres between two cameras, `("a.jpg", "b.jpg", 0.5)` or by places in the list, `(0, 3, 0.5)`;
      `splatnode.Marker(0.1)`; `splatnode.Stereo`; or a list of these. None: lengths have no unit.
    - `frame`: of reference: `first_camera`, `base` (the robot's, at the first image), `odometry` (that of the poses) or
      `upright` (z up). None: that of the poses, else the first camera's. Unknown: the verdict is `FRAME_UNKNOWN`.
    - `T_base_camera` (4, 4): metres, on the base; or by camera id. `gravity`: down (3,) in the first camera or by name.
    - `budget_s`: the best scene within so many seconds. `preset`: `preview`, `fast`, `balanced` or `quality`.
    - `config`: a mapping or a YAML file of what differs from the preset (`docs/configuration.md`).
    - `views`: so many images or keyframes, evenly spread. `every_frame`: all that are sharp and no copies.
    - `multi_view_only` (formerly `only_seen`): leaves out what no two images confirm, and the far background.
    - `seed`: of random numbers (None: the configuration's). `threads`: at most (None: as many as processors).
    - `tell`: gets steps (`doing`, `done`, `of`, `left_s`) and lines of text, in this thread; raise in it to cancel.
    """
    check_poses, multi_view_only = _merge_former(check_poses, poses_only_check, multi_view_only, only_seen)
    check_counts(views=views, threads=threads)
    telling = add_remaining_time(tell or ignore_progress)
    several = SeveralCameras(cameras, camera_ids, captured_at, tolerance_of(preset, config))
    loaded = load_frames(images, views, every_frame, telling, several)
    source = add_depths(_apply_given(loaded, masks, intrinsics, images, telling), depths, images)
    own = own_sigmas_of(poses, poses_sigma, images, source.frames)
    trusted = poses is not None and (poses_sigma is not None or bool(own)) and not check_poses
    metric = frame_changes(frame, gravity, poses_sigma)
    flags = {"budget_s": budget_s, "seed": seed, "metric": metric, "registration": hold_poses(trusted)}
    chosen = build_config(preset, config, flags, scale, of_pictures=source.photographs is None)
    source, chosen = apply_rig(_add_frame_evidence(source, T_base_camera, gravity), chosen, rig, telling)
    source, given = _collect_evidence(source, poses, poses_sigma, chosen, own if trusted else None, scale, images)
    made = reconstruct_source(source, chosen, preset, multi_view_only, threads, given, tell=telling)
    return result_of(made.snapshot, made, lenses(source.frames))


def frame_changes(
    frame: FrameChoice | None,
    gravity: npt.ArrayLike | Mapping[str, npt.ArrayLike] | None,
    poses_sigma: PosesSigma | None,
) -> dict[str, Any] | None:
    """Returns the settings of `metric` for the frame of reference, gravity of the first image, and poses; None: none.

    Raises TypeError, ValueError.
    """
    first_gravity = None if gravity is None or isinstance(gravity, Mapping) else make_gravity(gravity, None)
    changes = {"frame": frame, "gravity": None if first_gravity is None else list(first_gravity.down)}
    return {key: value for key, value in changes.items() if value is not None} | (sigmas_of(poses_sigma) or {}) or None


def _add_frame_evidence(source: Source, T_base_camera: Mounts | None, gravity: Any) -> Source:
    """The frames with the mounts of their cameras, and with gravity by name. Raises TypeError, ValueError."""
    mounts = parse_mounts(T_base_camera)
    downs = {frame_name(Path(name)): make_gravity(each, None) for name, each in gravity.items()} if isinstance(
        gravity, Mapping) else {}  # fmt: skip
    frames = [each for each in source.frames if isinstance(each, Frame)]
    unknown = [repr(each) for each in {*mounts} - {"", *(frame.camera_id for frame in frames)}]
    unknown += [repr(each) for each in {*downs} - {frame.name for frame in frames}]
    if unknown:
        raise ValueError(f"T_base_camera must be by camera id and gravity by image name; unknown: {', '.join(unknown)}")
    known = {each.name: replace(
        each,
        T_base_camera=find_mount(mounts, each.camera_id) or each.T_base_camera,
        gravity=downs.get(each.name, each.gravity),
    ) for each in frames}  # fmt: skip
    return replace(source, frames=tuple(known.get(each.name, each) for each in source.frames))


def _apply_given(
    source: Source, masks: Masks | None, intrinsics: LensChoice | None, images: Images, tell: Tell
) -> Source:
    """The frames with their masks and lenses."""
    masked = source if masks is None else apply_masks(source, make_mask_finder(masks, images), tell)
    return apply_lens(masked, intrinsics, images)


def _merge_former(
    check_poses: bool, poses_only_check: bool | None, multi_view_only: bool, only_seen: bool | None
) -> tuple[bool, bool]:
    """The arguments check_poses and multi_view_only, also where they came by their former names."""
    return (
        merge_former_argument("poses_only_check", poses_only_check, "check_poses", check_poses),
        merge_former_argument("only_seen", only_seen, "multi_view_only", multi_view_only),
    )


def _collect_evidence(
    source: Source,
    poses: Poses | None,
    sigma: PosesSigma | None,
    config: ReconstructionConfig,
    own: Mapping[str, Sigmas] | None,
    scale: Scale | None,
    images: Images,
) -> tuple[Source, Evidence]:
    """The frames with the poses that hold their cameras, and what else is known.

    `own` are the standard deviations of single poses; None: poses are only compared. Raises as `check_baseline`.
    """
    check_baseline(config, source)
    known = poses_given(poses, images, source.frames)
    pairs = pairs_given(scale, images, source.frames)
    if known is None or own is None:
        return source, Evidence((), known, pairs)
    sigmas = None if sigmas_of(sigma) is None else config.metric.poses_sigmas
    return add_poses(source, known, sigmas, own), Evidence((), None, pairs)  # they are the photographs' own then


def build_config(
    preset: str, changes: Changes | None, flags: Mapping[str, Any], scale: Scale | None, of_pictures: bool
) -> ReconstructionConfig:
    """The preset, then what differs from it, then the arguments: what comes later wins."""
    config = named(preset)
    if isinstance(changes, (str, PathLike)):
        config = apply_changes(config, read_yaml(Path(changes)))
    elif isinstance(changes, Mapping):
        config = apply_changes(config, changes)
    elif changes is not None:
        raise TypeError(f"config must be a mapping or a YAML file, got {type(changes).__name__}")
    if scale is not None:
        config = apply_changes(config, {"metric": metric_changes(scale, of_pictures)})
    return apply_changes(config, {name: value for name, value in flags.items() if value is not None})


def tolerance_of(preset: str, changes: Changes | None) -> float:
    """The seconds between images of a frame set, by the preset and what differs from it."""
    return build_config(preset, changes, {}, None, of_pictures=False).frame_set_tolerance_s


def hold_poses(trusted: bool) -> Mapping[str, bool] | None:
    """Returns what makes given poses hold the cameras; None: nothing."""
    return {"trust_poses": True} if trusted else None


def merge_former_argument(former: str, former_value: bool | None, present: str, value: bool) -> bool:
    """Returns the value of an argument that had a former name, which is notified where it is used.

    Raises TypeError where both are given.
    """
    if former_value is None:
        return value
    if value:
        raise TypeError(f"{present} is given twice, once as {former}, its former name; give it once")
    text = f"the argument {former} is called {present} now; the former name is read in this release only"
    notify(log, text, DeprecationWarning)
    return former_value


def check_counts(**values: int | None) -> None:
    """Raises ValueError for an argument, by its name, that is neither a number of things nor None."""
    for name, value in values.items():
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise ValueError(f"{name} must be a whole number of 1 or more, or None, got {value!r}")


# Photographs that come one at a time, reconstructed in the process that has them: no sockets, no daemon.

_EACH = 1e9  # frames a second: each is examined


@dataclass(frozen=True, eq=False)
class Update:
    """The outcome for one photograph of a session, and the result after it."""

    name: str  # of the photograph
    taken: bool  # whether it counts; otherwise `reason` says why it does not
    reason: str  # why it was taken, or not: what it adds, or that it is blurred, a copy, ...
    result: Result  # of all photographs so far; coarse until `Session.finish`


class Session:
    """A reconstruction of one submap, up to some 30 keyframes, that grows as a node's does.

    Most frames of a camera's loop add too little and are not taken. Thread-safe. As a context manager it closes itself.
    """

    @enter_api()
    def __init__(
        self,
        *,
        intrinsics: Lens | None = None,
        poses_sigma: tuple[float, float] | None = None,
        check_poses: bool = False,
        scale: Scale | None = None,
        frame: FrameChoice | None = None,
        T_base_camera: Mounts | None = None,
        preset: str = "balanced",
        config: Changes | None = None,
        every_frame: bool = False,
        seed: int | None = None,
        threads: int | None = None,
        tell: Tell | None = None,
        poses_only_check: bool | None = None,
    ) -> None:
        """The arguments are those of `reconstruct`, without `budget_s`.

        `poses_sigma` is of poses that `add` gets without their own. Poses with sigmas are priors of cameras with a
        known lens, unless `check_poses`. While `frame` is not known the verdict is `FRAME_UNKNOWN`. Images without
        a name are called 0000.png, 0001.png, ...
        """
        check_counts(threads=threads)
        if is_stereo(scale):
            raise TypeError("a session gets stereo pairs with add(image, right=..., baseline_m=...), not as its scale")
        flags = {"seed": seed, "metric": frame_changes(frame, None, poses_sigma)}
        self._mounts = parse_mounts(T_base_camera)
        self._config = build_config(preset, config, flags, scale, of_pictures=True)
        former = "poses_only_check", poses_only_check
        self._only_checks = merge_former_argument(*former, "check_poses", check_poses)
        if self._config.budget_s is not None:
            raise ValueError("a session has no budget_s, for its photographs come one at a time; reconstruct has one")
        self._preset, self._lens, self._threads, self._tell = preset, intrinsics, threads, tell or ignore_progress
        self._selection = Selection(every_frame=every_frame, max_fps=_EACH, patience_s=0.0)
        self._selectors: dict[str, Selector] = {}  # by camera id
        self._work: IncrementalReconstruction | None = IncrementalReconstruction(self._config)
        self._trust_poses(poses_sigma)
        self._frames: dict[str, Frame] = {}  # that were taken
        self._given: set[str] = set()
        self._sizes: list[tuple[int, int]] = []  # (width, height) of those that were given, each once
        self._motion: Motion | None = None  # up to the photograph that was given last
        self._evidence = NOTHING  # of metres, in these frames
        self._snapshot: Snapshot | None = None
        self._lock = threading.RLock()

    @enter_api()
    def add(
        self,
        image: Picture,
        *,
        name: str | None = None,
        captured_at: Stamp | None = None,
        intrinsics: Lens | None = None,
        camera: str | None = None,
        pose: npt.ArrayLike | None = None,
        pose_sigma: tuple[float, float] | None = None,
        motion: npt.ArrayLike | None = None,
        motion_sigma: tuple[float, float] | None = None,
        gravity: npt.ArrayLike | None = None,
        gravity_sigma: float | None = None,
        right: Picture | None = None,
        baseline_m: float | None = None,
        depth: DepthOf = None,
    ) -> Update:
        """Offers the session an image: an array (H, W, 3) uint8 RGB, or a PIL image.

        - `intrinsics`: this image's lens, instead of the session's. `camera`: the id of its camera, of several: they
          share no lens.
        - `pose`, `pose_sigma`: T_world_camera (4, 4) in metres from odometry or a tracker, all in one world; metres and
          degrees (default: the session's). Two or more give metres and axes, and with sigmas and a known lens they are
          priors of the cameras.
        - `motion`, `motion_sigma`: T_previous_current (4, 4) in metres from wheels or an IMU, since the image given
          before, taken or not; metres and degrees of this motion alone. One or more give metres.
        - `gravity`, `gravity_sigma`: down (3,) in the camera's frame; degrees. It gives `Result.map` its up.
        - `right`, `baseline_m`: the rectified right image of a stereo pair, of the image's size, and the distance of
          its camera, metres. Pairs give metres.
        - `depth`: a depth image, as for `reconstruct`. It gives metres, and depth where images have no texture.

        Returns the outcome once the scene has grown: after seconds if the image is taken, else milliseconds. Raises
        TypeError and ValueError for wrong arguments, a repeated name, or a session lens with the aspect ratio of no
        image so far, and RuntimeError after `finish` or `close`.
        """
        with self._lock, limits.apply_thread_limit(self._threads):
            work = self._open()
            number = len(self._given)
            frame = self._make_frame(image, number, name or f"{number:04d}.png", captured_at, intrinsics, camera)
            if frame.name in self._given:
                raise ValueError(f"name must be new for each photograph; {frame.name!r} was given before")
            metric = self._config.metric
            given = make_pose(None if pose is None else parse_matrix(pose), pose_sigma, metric.poses_sigmas)
            self._trust_poses(pose_sigma)
            usual = metric.odometry_drift, metric.odometry_sigma_deg
            moved = append_motion(self._motion, frame.name, motion, motion_sigma, *usual)
            came = {"given_pose": given, "motion": moved, "gravity": make_gravity(gravity, gravity_sigma)}
            came["T_base_camera"] = find_mount(self._mounts, frame.camera_id)
            beside = {"right": _make_right_image(right, baseline_m), "depth": parse_single_depth(depth)}
            frame = replace(frame, **came, **beside)
            self._motion = moved
            self._given.add(frame.name)
            self._sizes += {(frame.width, frame.height)}.difference(self._sizes)
            selector = self._selectors.setdefault(frame.camera_id, Selector(self._selection, Limits()))
            decision = selector.decide(frame)
            if decision.take:
                self._frames[frame.name] = frame
                self._evidence = self._evidence.merge(gather_evidence((frame,), self._config.metric))
                work.add_frame(frame)
                work.update()
                made = work.snapshot()  # stereo pairs and depth images are measured by landmarks
                by_points = bool(self._evidence.pairs or self._evidence.depths)
                self._snapshot = add_landmarks(made, work.find_reconstruction()) if by_points else made
            taken = frame.name in work.names
            left_out = {each.name: each.reason for each in work.dropped}
            return Update(frame.name, taken, left_out.get(frame.name, decision.reason), self.result)

    @enter_api()
    def finish(self) -> Result:
        """Judges all photographs with all evidence, and makes their scene anew; the session is closed then.

        Raises RuntimeError after `finish` or `close`.
        """
        with self._lock, limits.apply_thread_limit(self._threads):
            *_, self._snapshot = rebuild_from_scratch(self._open(), self._tell)
            self.close()
            return self.result

    @property
    def result(self) -> Result:
        """Returns the result of all photographs so far."""
        with self._lock:
            snapshot = self._snapshot or self._nothing_yet()
            snapshot = apply_metric_scale(snapshot, self._config.metric, self._evidence)
            frames = tuple(self._frames.values())
            made = OfflineResult(snapshot, Source(frames, None, None), self._config.seed, self._preset)
            return result_of(snapshot, made, lenses(frames))

    def close(self) -> None:
        """Gives back what the session holds beside its last result."""
        with self._lock:
            self._work = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> IncrementalReconstruction:
        if self._work is None:
            raise RuntimeError("the session is closed: begin another one")
        return self._work

    def _trust_poses(self, sigma: tuple[float, float] | None) -> None:
        """Lets poses hold cameras from now on, where their standard deviations are told."""
        if sigma is None or self._only_checks:
            return
        work = self._open()
        work.config = self._config = apply_changes(self._config, {"registration": {"trust_poses": True}})

    def _nothing_yet(self) -> Snapshot:
        work = self._open()
        work.estimate_soon()
        return work.snapshot()

    def _make_frame(
        self, image: Picture, number: int, name: str, captured_at: Stamp | None, lens: Lens | None, camera: str | None
    ) -> Frame:
        made = make_frame(image, number, name, time.monotonic_ns(), captured_at)
        made = made if camera is None else replace(made, camera_id=check_camera_id(camera, "camera"))
        if lens is not None:
            known = make_intrinsics(lens, made.width, made.height)
            check_fits(known, [(made.width, made.height)])
            return assign_lens(made, known)
        if self._lens is None:
            return made
        sizes = [*self._sizes, (made.width, made.height)]
        known = make_intrinsics(self._lens, *sizes[0])
        check_fits(known, sizes)
        return assign_lens(made, known)


def _make_right_image(picture: Picture | None, baseline_m: float | None) -> RightImage | None:
    if picture is None and baseline_m is None:
        return None
    if picture is None or baseline_m is None:
        raise TypeError("right and baseline_m belong together: what the right camera saw, and how far away it stands")
    return RightImage(grey(make_frame(picture, 0, "right", 0).image), Apart(float(baseline_m)))
