"""Photographs that are all at hand, reconstructed in the process that asks."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from splatnode.api.masks import Masks, make_mask_finder
from splatnode.api.photographs import Images, LensChoice, apply_lens, lenses, load_frames
from splatnode.api.poses import Poses, poses_given, sigmas_of
from splatnode.api.result import Result, result_of
from splatnode.api.scale import Scale, metric_changes, pairs_given
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.progress import Tell, ignore_progress
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.config import preset as named
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.offline import check_baseline, reconstruct_source
from splatnode.recon.replay_source import add_poses, apply_masks

Changes = Mapping[str, Any] | str | PathLike[str]


def reconstruct(
    images: Images,
    *,
    intrinsics: LensChoice | None = None,
    poses: Poses | None = None,
    poses_sigma: tuple[float, float] | None = None,
    poses_only_check: bool = False,
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
    flags["registration"] = {"trust_poses": True} if trusted else None
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
