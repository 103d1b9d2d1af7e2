"""The verbs of the command line that reconstruct.

What a reconstruction will take is told before it begins, roughly: by what the built-in capture took, with as many
views.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatnode.capture.keyframe_selection import THINNED
from splatnode.capture.lens_file import Lenses, read_lenses
from splatnode.capture.pose_files import Trajectory, poses_of, read_poses
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.terminal import ProgressStep, Tell, say, show_progress
from splatnode.capture.rig_file import read_rig
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.mapping import replay_map
from splatnode.recon.metric.arguments import collect_drift_changes, collect_metric_changes, trusts_poses
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.metric.stereo import make_pairs, stream_right_images
from splatnode.recon.pipeline import check_baseline, ignore_snapshot, reconstruct_source, set_preview_interval
from splatnode.recon.replay_source import Request, Source, add_depth_folder, add_poses, load_source, parse_sources
from splatnode.recon.result.export.result import LIVE_PICTURE
from splatnode.recon.result.folder import hold_result_folder
from splatnode.recon.result.report import bound_result_bytes, print_summary
from splatnode.recon.result.submap_index import FILE, is_map_set
from splatnode.recon.rig_choice import apply_rig
from splatnode.recon.viewer_process import Show, viewer

FEW = 12  # photographs: of so many, the end is near before an estimate is read
# Views, seconds and 10^6 bytes of the largest memory; two cores, preset balanced (tests/bench/results/growth.json).
MEASURED = ((3, 17.5, 481), (6, 23.2, 543), (12, 33.0, 629), (24, 55.9, 775), (48, 103.0, 1212))
_BYTES_A_PIXEL = 3  # of each photograph, which stays in memory as it was read
_SECONDS_RANGE = 0.5, 3.0  # times as long: more cores and a preset that does less, or a slow machine with other work
_MEMORY_RANGE = 0.9, 1.6


def format_cost(sizes: Sequence[tuple[int, int]]) -> str | None:
    """One line about the photographs with these widths and heights; None for so few that nobody needs to know."""
    if len(sizes) <= FEW:
        return None
    views, seconds, megabytes = np.array(MEASURED).T
    count, pixels = len(sizes), sum(width * height for width, height in sizes)
    took_s, took_mb = (
        _interpolate(count, views, seconds),
        _interpolate(count, views, megabytes) + _BYTES_A_PIXEL * pixels / 1e6,
    )
    shortest, longest = (took_s * times for times in _SECONDS_RANGE)
    least, most = (took_mb * times / 1000 for times in _MEMORY_RANGE)
    time = (
        f"{shortest:.0f} to {longest:.0f} s" if longest < 120 else f"{shortest / 60:.1f} to {longest / 60:.0f} minutes"
    )
    memory = f"{least:.1f} to {most:.1f} GB of memory"
    return f"{count} photographs, {pixels / 1e6:.0f} megapixels in all: about {time}, {memory}"


def _interpolate(count: int, views: np.ndarray, measured: np.ndarray) -> float:
    """Between the measured counts; beyond the last one it goes on as between the last two."""
    if count <= views[-1]:
        return float(np.interp(count, views, measured))
    slope = (measured[-1] - measured[-2]) / (views[-1] - views[-2])
    return float(measured[-1] + slope * (count - views[-1]))


EXIT_GOOD, EXIT_REFUSED = 0, 65
LOOK_EVERY = 50  # iterations between the snapshots that a viewer is shown


def replay(args: argparse.Namespace) -> int:
    """Reconstructs a folder of photographs, some photographs of one, a recording, or a video."""
    config = _config(args)
    path, listed, cameras = parse_sources(args.source, args.cameras, config.frame_set_tolerance_s)
    request = Request(path, listed, args.views, args.frames or (), args.every_frame, args.masks, _lenses(args), cameras)
    for source in [path] if cameras is None else [path, *(camera.path for camera in cameras.cameras)]:
        _check_apart(args.out, source)
    if not args.map and is_map_set(args.out):
        raise ValueError(f"{args.out} holds the scenes of a map or of a node ({FILE}); give another --out")
    if args.map and args.multi_view_only:
        raise ValueError("--multi-view-only is for one scene: a merged map does not tell what two photographs confirm")
    if args.map and args.depths is not None:
        raise ValueError("--depths is for one scene; with --map give a folder whose layout has depth (docs/inputs.md)")
    if args.rig is not None:
        read_rig(args.rig)  # before images are read, which takes longer
    if args.map:
        return replay_map(args, request, config)
    with show_progress(quiet=args.json) as tell:
        return _replay(args, request, config, tell)


def _replay(args: argparse.Namespace, request: Request, config: ReconstructionConfig, tell: Tell) -> int:
    given = load_source(request, tell)
    if given.choice is not None:
        tell(str(given.choice))
        if given.choice.left_out.get(THINNED):
            tell("--map uses the keyframes that were thinned out, too, and makes a map of many scenes")
    if not args.json and (taken := format_cost(given.sizes)) is not None:
        say(taken, error=True)
    given, config = apply_rig(given, config, args.rig, tell)
    given = given if args.depths is None else add_depth_folder(given, args.depths)
    check_baseline(config, given)
    trajectory = None if args.poses is None else read_poses(args.poses)
    known = _load_scale_evidence(args, given, trajectory)
    own = {} if trajectory is None else trajectory.find_sigmas(given.frames)
    if known.poses is not None and trusts_poses(args, told=bool(own)):
        given = add_poses(given, known.poses, args.poses_sigma, own)
        known = replace(known, poses=None)  # they are the photographs' own now
        config = apply_changes(config, {"registration": {"trust_poses": True, **collect_drift_changes(args)}})
    elif args.poses_drift is not None:
        raise ValueError("--poses-drift is of poses that hold the cameras: give --poses FILE and --poses-sigma, too")
    needed_bytes = bound_result_bytes(given.sizes, config.size, config.most_gaussians) + given.further_bytes
    with hold_result_folder(args.out, needed_bytes), _viewer(args) as show:
        config = set_preview_interval(config, LOOK_EVERY) if args.view else config
        preset_name = args.preset or "balanced"
        made = reconstruct_source(
            given, config, preset_name, without_guesses=args.multi_view_only, given=known, show=show, tell=tell
        )
        del given  # and with it photographs that lie in a folder
        tell(ProgressStep("writing the results"))
        snapshot, report = made.snapshot, made.write(args.out)
        if args.json:
            print(json.dumps(report))
        else:
            print_summary(snapshot, args.out)
    return EXIT_GOOD if snapshot.verdict.publishable else EXIT_REFUSED


def _viewer(args: argparse.Namespace) -> contextlib.AbstractContextManager[Show]:
    """A viewer with --view, else nobody. The picture that an earlier run showed is none of this one: it is removed."""
    pictures = args.out / "view"
    (pictures / LIVE_PICTURE).unlink(missing_ok=True)
    return viewer(pictures) if args.view else contextlib.nullcontext(ignore_snapshot)


def _check_apart(out: Path, photographs: Path) -> None:
    """Raises ValueError where the preview would be a photograph of the next run."""
    if out.resolve() == photographs.resolve():
        raise ValueError(f"--out must not be the folder of the photographs; give one in it, such as {out / 'out'}")


def _load_scale_evidence(args: argparse.Namespace, given: Source, trajectory: Trajectory | None) -> Evidence:
    """Loads the scale evidence that the options name. Raises ValueError where it fits none of the images."""
    poses = None if trajectory is None else poses_of(trajectory, given.frames, str(args.poses))
    pairs = () if args.stereo is None else make_pairs(given.frames, stream_right_images(args.stereo, given.frames))
    return Evidence(poses=poses, pairs=pairs)


def _lenses(args: argparse.Namespace) -> Lenses | None:
    """The lenses that are given for photographs."""
    return None if args.intrinsics is None else read_lenses(args.intrinsics)


def _config(args: argparse.Namespace) -> ReconstructionConfig:
    """The preset, then the configuration file, then the flags: what comes later wins."""
    config = preset(args.preset or "balanced")
    if args.config is not None:
        config = apply_changes(config, read_yaml(args.config))
    if args.prior is not None and args.prior != config.prior.kind:
        config = apply_changes(config, {"prior": {"kind": args.prior}})
    config = apply_changes(config, {"metric": collect_metric_changes(args)})
    flags = {
        "size": args.size,
        "device": args.device,
        "seed": args.seed,
        "budget_s": args.budget_s,
        "max_gaussians": args.max_gaussians,
        "max_mb": args.max_mb,
        "frame_set_tolerance_s": args.frame_set_tolerance,
        "no_fallbacks": args.no_fallbacks or None,
        "decision": None
        if args.max_position_error is None
        else {"max_position_error_percent": args.max_position_error},
    }
    return apply_changes(config, {key: value for key, value in flags.items() if value is not None})
