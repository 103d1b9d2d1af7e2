"""The verbs of the command line that reconstruct."""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from torch import Tensor

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.keyframe_selection import THINNED
from splatnode.capture.lens_file import Lenses, read_lenses
from splatnode.capture.pose_files import Trajectory, poses_of, read_poses
from splatnode.capture.process.config import read_yaml
from splatnode.capture.process.terminal import ProgressStep, Tell, say, show_progress
from splatnode.recon import cost
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.evaluate import methods
from splatnode.recon.evaluate.dataset import Split, load_scene
from splatnode.recon.evaluate.demo import compute_max_capture_bytes, write_held_out_images, write_training_images
from splatnode.recon.evaluate.protocol import (
    INTERPOLATED_START,
    PerceptualNetworks,
    Run,
    Settings,
    evaluate,
    load_networks,
    psnr,
)
from splatnode.recon.evaluate.report import Bench, explain_missing_seconds, merge_benches, read_bench, redraw
from splatnode.recon.evaluate.runner import MethodRunner, Plan, Scoring, format_run, run_bench
from splatnode.recon.jobs.calls import engine as opened
from splatnode.recon.mapping.command import replay_map
from splatnode.recon.metric.arguments import collect_drift_changes, collect_metric_changes, trusts_poses
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.metric.stereo import make_pairs, stream_right_images
from splatnode.recon.pipeline import check_baseline, ignore_snapshot, reconstruct_source, run, set_preview_interval
from splatnode.recon.rasterize import dispatch
from splatnode.recon.rasterize.dispatch import Device, make_rasterizer
from splatnode.recon.replay_source import Request, Source, add_poses, load_source, parse_sources
from splatnode.recon.result import snapshot as result_snapshot
from splatnode.recon.result.export.result import LIVE_PICTURE
from splatnode.recon.result.folder import hold_result_folder
from splatnode.recon.result.report import bound_result_bytes, write_result_folder
from splatnode.recon.result.snapshot import Snapshot, describe_moving
from splatnode.recon.result.submap_index import FILE, is_map_set
from splatnode.recon.rig_choice import apply_rig
from splatnode.recon.viewer_process import Show, viewer

EXIT_GOOD, EXIT_REFUSED = 0, 65
# Of the search for a held-out view's pose, half of them at half the resolution: 33.0 dB in the mean, as 100 at full.
DEMO_STEPS = 80
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
    if not args.json and (taken := cost.format_cost(given.sizes)) is not None:
        say(taken, error=True)
    given, config = apply_rig(given, config, args.rig, tell)
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
            _print_summary(snapshot, args.out)
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


def demo(args: argparse.Namespace) -> int:
    """Writes the built-in capture, reconstructs it, and then measures the result on views that it has not seen."""
    with show_progress(quiet=args.json) as tell:
        return _demo(args, tell)


def _demo(args: argparse.Namespace, tell: Tell) -> int:
    seed = args.seed or 0
    config = apply_changes(preset("balanced"), {"seed": seed, "device": args.device or "cpu"})
    place = synthetic.Config(seed=seed)
    needed_bytes = bound_result_bytes([(place.width, place.height)] * place.views, config.size, None)
    with hold_result_folder(args.out, needed_bytes + compute_max_capture_bytes(place)):
        capture = args.out / "capture"
        tell(f"photographing the built-in place, {place.views} times")
        split = write_training_images(capture, place)
        photographs = folder.stream(folder.Config(folder=capture / "images", names=split.train))
        snapshot = run(photographs, config, tell=tell)
        write = partial(write_result_folder, snapshot, args.out, seed=seed, preset_name="balanced")
        tell(ProgressStep("writing the results"))
        report = write()
        if not args.json:
            _print_summary(snapshot, args.out)
        if snapshot.verdict.publishable:
            tell(f"measuring it on {len(split.test)} views that it has not seen")
            write_held_out_images(capture, place)
            report = write(told={"held_out": evaluate_held_out_views(snapshot, capture, split, config.device, tell)})
        if args.json:
            print(json.dumps(report))
    return EXIT_GOOD if snapshot.verdict.publishable else EXIT_REFUSED


def evaluate_held_out_views(
    snapshot: Snapshot, capture: Path, split: Split, on: Device = "cpu", tell: Callable[[str], None] = say
) -> dict[str, float | None]:
    """Mean scores over the test views, each of which is told, and the errors of the estimated cameras."""

    def report_view(name: str, truth: Tensor, image: Tensor) -> None:
        tell(f"{name}: {psnr(image, truth):.1f} dB")

    row = evaluate(
        snapshot,
        load_scene(capture),
        split,
        Run("balanced", 0, None, snapshot.seconds, None),
        rasterize=make_rasterizer(dispatch.choose_device(on)),
        networks=PerceptualNetworks(alex=None, vgg=None),
        settings=Settings(alignment_steps=DEMO_STEPS, alignment_levels=2),
        show=report_view,
    )
    tell(f"held-out views: {row.psnr:.1f} dB PSNR, {row.ssim:.3f} SSIM")
    wanted = ("psnr", "ssim", "rotation_error_deg", "centre_error_pct", "focal_error_pct")
    return {name: getattr(row, name) for name in wanted}


def bench(args: argparse.Namespace) -> int:
    """Measures methods on scenes with true cameras, or draws again what was measured."""
    if bool(args.scenes) == bool(args.redraw):
        raise ValueError("bench must get scenes to measure, or --redraw with what was measured")
    if args.redraw:
        found = merge_benches([read_bench(path) for path in args.redraw])
    else:
        found = _run_bench(args)
        for row in found.rows:
            if row.final:
                say(format_run(row))
        if why := explain_missing_seconds([row.others for row in found.rows if row.final]):
            say(why)
    redraw(found, args.out)
    say(f"results: {args.out}/ (report.html, report.md, bench.json, bench.csv)")
    return EXIT_GOOD


def _run_bench(args: argparse.Namespace) -> Bench:
    wanted = args.device or "cpu"
    on = dispatch.choose_device(wanted)
    one_gpu = on.type != "cpu" and (args.ray is not None or (args.cores or 1) > 1)
    plan = Plan(
        tuple(args.scenes),
        args.views,
        methods.expand_method_names(args.methods),
        tuple(range(args.seeds)),
        args.checkpoints,
        args.timeout_s,
        args.max_memory,
        timed=not one_gpu,
    )
    scoring = Scoring(
        make_rasterizer(on),
        partial(load_networks, args.weights_dir and args.weights_dir.absolute()),
        replace(INTERPOLATED_START if args.interpolate_start else Settings(), best_gain=args.color_correct),
        args.score_regions,
    )
    with opened(args.cores, args.ray) as engine:
        return run_bench(
            plan,
            MethodRunner(partial(methods.run_method, device=wanted), methods.select_start_config, on.type),
            args.out,
            scoring=scoring,
            command=shlex.join(["splatnode", *sys.argv[1:]]),
            resume=args.resume,
            engine=engine,
        )


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


def _print_summary(snapshot: Snapshot, out: Path) -> None:
    verdict = snapshot.verdict
    say(f"{verdict.code.value}: {verdict.message}" + (f" {verdict.advice}" if verdict.advice else ""))
    for frame in snapshot.dropped:
        say(f"left out: {frame.name}: {frame.reason}")
    if moved := describe_moving(snapshot.moving):
        say(moved)
    for hit in snapshot.budget:
        say(hit["message"])
    if verdict.publishable:
        counts = f"{len(snapshot.gaussians)} Gaussians, {len(snapshot.cameras)} cameras"
        say(f"{snapshot.seconds['total']:.1f} s, {counts}")
        if known := result_snapshot.format_widest_bounds(snapshot.cameras, snapshot.scale):
            say(f"how well the cameras are known: {known}")
        if snapshot.scale.source is not None:
            say(f"lengths: {snapshot.scale.sentence}")
    further = snapshot.seconds.get("ladder", 0.0)
    if further >= 0.1:
        say(
            f"{further:.1f} s of {snapshot.seconds['total']:.1f} s went into more matches "
            "(--no-fallbacks leaves them out)"
        )
    say(f"results: {out}/ ({'scene.ply, cameras.json, preview.png, ' if verdict.publishable else ''}report.json)")
