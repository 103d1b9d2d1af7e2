"""The verbs that measure: what runs them."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from torch import Tensor

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.process.terminal import ProgressStep, Tell, say, show_progress
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.dataset import (
    Split,
    compute_max_capture_bytes,
    load_scene,
    write_held_out_images,
    write_training_images,
)
from splatnode.extras.evaluate.protocol import (
    INTERPOLATED_START,
    PerceptualNetworks,
    Run,
    Settings,
    evaluate,
    load_networks,
    psnr,
)
from splatnode.extras.evaluate.report import Bench, explain_missing_seconds, merge_benches, read_bench, redraw
from splatnode.extras.evaluate.runner import MethodRunner, Plan, Scoring, format_run, run_bench
from splatnode.extras.jobs.calls import engine as opened
from splatnode.recon import rasterize
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.pipeline import run
from splatnode.recon.rasterize import Device, make_rasterizer
from splatnode.recon.result.export.staged import hold_result_folder
from splatnode.recon.result.report import bound_result_bytes, print_summary, write_result_folder
from splatnode.recon.result.snapshot import Snapshot

EXIT_GOOD, EXIT_REFUSED = 0, 65
# Of the search for a held-out view's pose, half of them at half the resolution: 33.0 dB in the mean, as 100 at full.
DEMO_STEPS = 80


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
            print_summary(snapshot, args.out)
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
        rasterize=make_rasterizer(rasterize.choose_device(on)),
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
    on = rasterize.choose_device(wanted)
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
