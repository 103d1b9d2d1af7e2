"""Photographs that are all at hand, reconstructed in the process that asks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.api.depths import Depths, add_depths
from splatnode.api.image_arguments import Sigmas, parse_sigmas
from splatnode.api.photographs import (
    Images,
    LensChoice,
    Masks,
    SeveralCameras,
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
from splatnode.capture.frame import DroppedFrame, Frame, Stamp
from splatnode.capture.pose_files import Trajectory, create_trajectory, poses_of, read_poses
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.terminal import Tell, ignore_progress
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.config import preset as named
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.metric.stereo import StereoPair, make_pairs, stream_right_images
from splatnode.recon.pipeline import check_baseline, reconstruct_source
from splatnode.recon.replay_source import add_poses, apply_masks

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
    told = zip(names, sigma, strict=True)
    return {name: parse_sigmas(each, "poses_sigma") for name, each in told if each is not None}


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


def reconstruct(
    images: Images,
    *,
    cameras: str | Sequence[str] | None = None,
    camera_ids: Sequence[str | None] | None = None,
    captured_at: Sequence[Stamp | None] | None = None,
    intrinsics: LensChoice | None = None,
    poses: Poses | None = None,
    poses_sigma: PosesSigma | None = None,
    poses_only_check: bool = False,
    masks: Masks | None = None,
    depths: Depths | None = None,
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
    - `cameras`: which cameras of one robot are used together, as `--cameras`: `"all"`, or a list of names: folders of
      a folder, topics of an MCAP file, keys of an episode `"pusht#3"`; of listed folders or films, a name for each.
      Frames are called `left/0001.jpg` then, and each camera has its own lens.
    - `camera_ids`, `captured_at`: of listed images which camera took each (None: not known), and when, a `Stamp`. What
      different cameras took together, to `frame_set_tolerance_s` of `config`, is used, or left out, as one.
    - `intrinsics`: the lens of all photographs of its aspect ratio: `Intrinsics`, or K (3, 3) in pixels of the
      photographs without distortion; or a list of these, one of each photograph (None: not known); or a mapping of
      them by photograph, by camera id, by camera with which names begin, or by pattern: `{"left": a, "right": b}`.
      None: what EXIF tells, else it is estimated.
    - `poses`: T_world_camera (4, 4) in metres that others estimated: by the photographs' names, in the order of a list
      (None: not known), or a file as `--poses` reads it. They give metres and the world's axes; one that does not fit
      is left out and named. `poses_sigma`: standard deviations of a position, metres, and an orientation, degrees, of
      all poses, or a mapping or list of such as `poses` is: with `intrinsics` the poses then hold the cameras, also
      where photographs share nothing. So do poses whose file tells their sigmas. `poses_only_check`: they do not even
      then, but are compared with the cameras that the photographs alone tell.
    - `masks`: what of the photographs is used: white (any value above 0) is used, black is ignored. A folder of masks
      with the photographs' names, one file for all, or a list, for each photograph an array (H, W), a path, or None
      for one that is used whole. None: all is used.
    - `depths`: of a depth camera, for metres and plain walls: a folder, a mapping by names, or a list of `DepthImage`,
      files (16-bit PNG, .npy, .exr), or arrays (H, W), aligned: uint16 millimetres, float metres; None: not measured.
    - `scale`: two photographs and the metres between their cameras: `("a.jpg", "b.jpg", 0.5)`, of pictures their
      places in the list: `(0, 3, 0.5)`; or a printed marker, `splatnode.Marker(0.1)`; or `splatnode.Stereo`; or a
      list of these, which check one another. None: lengths have no unit.
    - `budget_s`: the best scene within so many seconds. `preset`: `preview`, `fast`, `balanced` or `quality`.
    - `config`: what differs from the preset, as `docs/configuration.md` lists it: a mapping, or a YAML file.
    - `views`: so many photographs or keyframes, evenly spread. `every_frame`: all that are sharp and no copies.
      `only_seen`: leaves out what no two photographs confirm, and the far background.
    - `seed`: of what is drawn by chance; None: the configuration's, 0. `threads`: at most; None: one a processor.
    - `tell`: hears what is being done, in the calling thread: a step with `doing`, `done`, `of`, or a line of text.
      What it raises ends the work.

    Raises TypeError and ValueError where an argument is not what it must be, and FileNotFoundError.
    """
    telling = tell or ignore_progress
    check_counts(views=views, threads=threads)
    several = SeveralCameras(cameras, camera_ids, captured_at, tolerance_of(preset, config))
    source = load_frames(images, views, every_frame, telling, several)
    source = source if masks is None else apply_masks(source, make_mask_finder(masks, images), telling)
    source = add_depths(apply_lens(source, intrinsics, images), depths, images)
    own = own_sigmas_of(poses, poses_sigma, images, source.frames)
    trusted = poses is not None and (poses_sigma is not None or bool(own)) and not poses_only_check
    flags = {"budget_s": budget_s, "seed": seed, "metric": sigmas_of(poses_sigma), "registration": hold_poses(trusted)}
    chosen = build_config(preset, config, flags, scale, of_pictures=source.photographs is None)
    check_baseline(chosen, source)
    known = poses_given(poses, images, source.frames)
    if trusted and known is not None:
        source = add_poses(source, known, None if sigmas_of(poses_sigma) is None else chosen.metric.poses_sigmas, own)
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


def tolerance_of(preset: str, changes: Changes | None) -> float:
    """The seconds between images of a frame set, by the preset and what differs from it."""
    return build_config(preset, changes, {}, None, of_pictures=False).frame_set_tolerance_s


def hold_poses(trusted: bool) -> Mapping[str, bool] | None:
    """Returns what makes given poses hold the cameras; None: nothing."""
    return {"trust_poses": True} if trusted else None


def check_counts(**values: int | None) -> None:
    """Raises ValueError for an argument, by its name, that is neither a number of things nor None."""
    for name, value in values.items():
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise ValueError(f"{name} must be a whole number of 1 or more, or None, got {value!r}")
