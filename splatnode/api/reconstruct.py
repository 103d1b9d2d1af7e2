"""Photographs that are all at hand, reconstructed in the process that asks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.api.photographs import (
    Images,
    LensChoice,
    Masks,
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
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.odometry import GRAVITY_SIGMA_DEG, GivenPose, Gravity, Motion, make_given_pose
from splatnode.capture.pose_files import create_trajectory, poses_of, read_poses
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.terminal import Tell, ignore_progress
from splatnode.capture.rig_file import read_rig
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.config import preset as named
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.metric.measurement import MetricConfig
from splatnode.recon.metric.stereo import StereoPair, make_pairs, stream_right_images
from splatnode.recon.pipeline import check_baseline, reconstruct_source
from splatnode.recon.replay_source import add_poses, apply_masks

# Poses as a program has them: a file, or matrices, by the photographs' names or in their order.

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
    return Gravity((x, y, z), GRAVITY_SIGMA_DEG if sigma_deg is None else float(sigma_deg))


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
            changes |= {"stereo_m": each.baseline_m, "stereo_sigma_m": each.sigma_m}
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
        "marker_m": marker.side_m,
        "marker_sigma_m": marker.sigma_m,
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


def reconstruct(
    images: Images,
    *,
    intrinsics: LensChoice | None = None,
    poses: Poses | None = None,
    poses_sigma: tuple[float, float] | None = None,
    poses_only_check: bool = False,
    rig: str | PathLike[str] | None = None,
    masks: Masks | None = None,
    scale: Scale | None = None,
    budget_s: float | None = None,
    preset: str = "balanced",
    config: Changes | None = None,
    views: int | None = None,
    every_frame: bool = False,
    only_seen: bool = False,
    seed: int | None = None,
    threads: int | None = None,
    tell: Tell | None = None,
) -> Result:
    """Reconstructs photographs: the same cameras and Gaussians, to the bit, as `splatnode replay`.

    A refusal is a result, too: ask `verdict.publishable`. Several threads may call this at once.

    - `images`: a folder, a film (a video, an image topic `"drive.mcap#/front/image"`, an episode of a LeRobot data set
      `"pusht#3/CAMERA"`), a list of photographs of one folder (paths), or a list of pictures: NumPy arrays (H, W, 3)
      uint8 RGB, or PIL images. Grey becomes RGB, where alpha is 0 there is no photograph. Of a film, and of more
      than 30 photographs, keyframes are chosen.
    - `intrinsics`: the lens of all photographs of its aspect ratio: `Intrinsics`, or K (3, 3) in pixels of the
      photographs without distortion; or a list of these, one of each photograph (None: not known); or a mapping of
      them by photograph, by camera with which names begin, or by pattern: `{"left": a, "right": b}`. None: what EXIF
      tells, else it is estimated.
    - `poses`: T_world_camera (4, 4) in metres that others estimated: by the photographs' names, in the order of a list
      (None: not known), or a file as `--poses` reads it. They give metres and the world's axes; one that does not fit
      is left out and named. `poses_sigma`: standard deviations of a position, metres, and an orientation, degrees: with
      `intrinsics` the poses then hold the cameras, also where photographs share nothing. `poses_only_check`: they do
      not even then, but are compared with the cameras that the photographs alone tell.
    - `rig`: a file that tells where the cameras of one robot stand to each other, as `--rig` reads it. None: the images
      that they took together tell.
    - `masks`: what of the photographs is used: white (any value above 0) is used, black is ignored. A folder of masks
      with the photographs' names, one file for all, or a list, for each photograph an array (H, W), a path, or None
      for one that is used whole. None: all is used.
    - `scale`: two photographs and the metres between their cameras: `("a.jpg", "b.jpg", 0.5)`, of pictures their
      places in the list: `(0, 3, 0.5)`; or a printed marker, `splatnode.Marker(0.1)`; or `splatnode.Stereo`; or a
      list of these, which check one another. None: lengths have no unit.
    - `budget_s`: the best scene within so many seconds. `preset`: `preview`, `fast`, `balanced` or `quality`.
    - `config`: what differs from the preset, as `docs/configuration.md` lists it: a mapping, or a YAML file.
    - `views`: so many photographs or keyframes, evenly spread. `every_frame`: all that are sharp and no copies.
    - `only_seen`: leaves out what no two photographs confirm, and the far background.
    - `seed`: of what is drawn by chance. None: the configuration's, 0.
    - `threads`: of this call at most, of torch and of the compiled core. None: as many as there are processors.
    - `tell`: hears what is being done, in the calling thread: a step with `doing`, `done`, `of`, or a line of text.
      What it raises ends the work.

    Raises TypeError and ValueError where an argument is not what it must be, and FileNotFoundError.
    """
    telling = tell or ignore_progress
    check_count("views", views)
    check_count("threads", threads)
    source = load_frames(images, views, every_frame, telling)
    source = source if masks is None else apply_masks(source, make_mask_finder(masks, images), telling)
    source = apply_lens(source, intrinsics, images)
    trusted = poses is not None and poses_sigma is not None and not poses_only_check
    flags = {"budget_s": budget_s, "seed": seed, "metric": sigmas_of(poses_sigma)}
    on_rig = {} if rig is None else {"rig": msgspec.to_builtins(read_rig(Path(rig)))}
    flags["registration"] = (on_rig | ({"trust_poses": True} if trusted else {})) or None
    chosen = build_config(preset, config, flags, scale, of_pictures=source.photographs is None)
    check_baseline(chosen, source)
    known = poses_given(poses, images, source.frames)
    if trusted and known is not None:
        source = add_poses(source, known, chosen.metric.poses_sigma_m, chosen.metric.poses_sigma_deg)
        known = None  # they are the photographs' own now
    given = Evidence((), known, pairs_given(scale, images, source.frames))
    made = reconstruct_source(source, chosen, preset, only_seen, threads, given, tell=telling)
    return result_of(made.snapshot, made, lenses(source.frames))


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


def check_count(name: str, value: int | None) -> None:
    """Raises ValueError for an argument that is neither a number of things nor None."""
    if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
        raise ValueError(f"{name} must be a whole number of 1 or more, or None, got {value!r}")
