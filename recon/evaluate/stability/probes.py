"""What rows measure besides the verdict. A probe runs after the trial's own reconstruction, in the same process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import msgspec
import numpy as np

from splatnode.capture.frame import Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.camera_errors import compare_cameras
from splatnode.recon.evaluate.perceptual import PerceptualNetworks
from splatnode.recon.evaluate.protocol import Run, Settings, evaluate
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.stability.case import Probe, ProbeResult, make_frames
from splatnode.recon.evaluate.stability.methods import splatnode
from splatnode.recon.evaluate.stability.places import TrialImage
from splatnode.recon.evaluate.truth import EvaluationScene
from splatnode.recon.rasterize.dispatch import rasterize
from splatnode.recon.result.snapshot import Snapshot

_MAX_OVERFIT_DB = 0.3  # PSNR that ten times the iterations may lose
_MAX_CHANGE = 0.2  # of the number of Gaussians, between a budget and ten times that budget
_MAX_LOSS_ONE_BY_ONE = 0.03  # share of the PSNR that may be lost when frames come one by one
_REPEATS = 2  # further runs that must give the same bits


def make_same_cameras_probe(photos: Sequence[TrialImage], *, rotation_deg: float, centre_pct: float) -> Probe:
    """The cameras of `photos` in this order are those of the trial, within the limits."""
    return partial(_measure_same_cameras, make_frames(photos), rotation_deg, centre_pct)


def _measure_same_cameras(
    others: Sequence[Frame], rotation_deg: float, centre_pct: float, snapshot: Snapshot, config: ReconstructionConfig
) -> ProbeResult:
    second = {camera.name: camera for camera in splatnode(list(others), config).cameras}
    pairs = [(camera, second[camera.name]) for camera in snapshot.cameras if camera.name in second]
    errors = compare_cameras(
        *(np.array([pair[i].T_world_camera for pair in pairs]).reshape(-1, 4, 4) for i in (0, 1)),
        *(np.array([pair[i].K for pair in pairs]).reshape(-1, 3, 3) for i in (0, 1)),
    )
    rotation, centre = errors.rotation_pair_deg, errors.centre_pct
    if rotation is None or centre is None:
        return ProbeResult({"common_cameras": len(pairs)}, held=False)
    values = {"common_cameras": len(pairs), "rotation_difference_deg": rotation, "centre_difference_pct": centre}
    everyone = len(pairs) == len(snapshot.cameras) == len(second)
    return ProbeResult(values, held=everyone and rotation < rotation_deg and centre < centre_pct)


def make_repeatability_probe(photos: Sequence[TrialImage]) -> Probe:
    """The same frames give the same scene again."""
    return partial(_measure_repeatability, make_frames(photos))


def _measure_repeatability(same: Sequence[Frame], snapshot: Snapshot, config: ReconstructionConfig) -> ProbeResult:
    largest = 0.0
    for _ in range(_REPEATS):
        again = splatnode(list(same), config)
        if len(again.gaussians) != len(snapshot.gaussians) or len(again.cameras) != len(snapshot.cameras):
            return ProbeResult({"num_gaussians": len(snapshot.gaussians), "again": len(again.gaussians)}, held=False)
        poses = [(a.T_world_camera, b.T_world_camera) for a, b in zip(again.cameras, snapshot.cameras, strict=True)]
        for ours, before in [*poses, (again.gaussians.means, snapshot.gaussians.means)]:
            largest = max(largest, float(np.abs(ours - before).max(initial=0.0)))
    return ProbeResult({"repeats": _REPEATS, "largest_difference": largest}, held=largest == 0.0)


def make_overfit_probe(photos: Sequence[TrialImage], scene: EvaluationScene, test: Sequence[str]) -> Probe:
    """Ten times the iterations do not show the unseen views worse."""
    return partial(_measure_overfit, make_frames(photos), scene, tuple(test))


def _measure_overfit(
    same: Sequence[Frame],
    scene: EvaluationScene,
    test: tuple[str, ...],
    snapshot: Snapshot,
    config: ReconstructionConfig,
) -> ProbeResult:
    longer = msgspec.structs.replace(config.optimize, iterations=10 * config.optimize.iterations)
    long = splatnode(list(same), msgspec.structs.replace(config, optimize=longer))
    before, after = (_measure_held_out_psnr(found, scene, test, config) for found in (snapshot, long))
    values = {"psnr": before, "psnr_ten_times_longer": after}
    return ProbeResult(values, held=after > before - _MAX_OVERFIT_DB)


def make_budget_probe(photos: Sequence[TrialImage]) -> Probe:
    """Ten times the Gaussians allowed does not mean more Gaussians."""
    return partial(_measure_bigger_budget, make_frames(photos))


def _measure_bigger_budget(same: Sequence[Frame], snapshot: Snapshot, config: ReconstructionConfig) -> ProbeResult:
    count = len(snapshot.gaussians)
    wide = splatnode(list(same), msgspec.structs.replace(config, max_gaussians=10 * count))
    values = {"num_gaussians": count, "with_ten_times_the_budget": len(wide.gaussians)}
    return ProbeResult(values, held=abs(len(wide.gaussians) - count) <= _MAX_CHANGE * count)


def make_stream_quality_probe(photos: Sequence[TrialImage], scene: EvaluationScene, test: Sequence[str]) -> Probe:
    """Frames that came one by one show the unseen views as well as if all had been there at once."""
    return partial(_measure_stream_quality, make_frames(photos), scene, tuple(test))


def _measure_stream_quality(
    same: Sequence[Frame],
    scene: EvaluationScene,
    test: tuple[str, ...],
    snapshot: Snapshot,
    config: ReconstructionConfig,
) -> ProbeResult:
    batch = splatnode(list(same), config)
    one_by_one, at_once = (_measure_held_out_psnr(found, scene, test, config) for found in (snapshot, batch))
    values = {"psnr_one_by_one": one_by_one, "psnr_at_once": at_once}
    return ProbeResult(values, held=one_by_one > (1.0 - _MAX_LOSS_ONE_BY_ONE) * at_once)


def _measure_held_out_psnr(
    snapshot: Snapshot, scene: EvaluationScene, test: tuple[str, ...], config: ReconstructionConfig
) -> float:
    """dB; 0 where nothing was published."""
    scored = evaluate(
        snapshot,
        scene,
        Split(tuple(camera.name for camera in snapshot.cameras), test),
        Run("splatnode", config.seed, None, {}, None),
        rasterize=rasterize,
        networks=PerceptualNetworks(alex=None, vgg=None),
        settings=Settings(longer_side=config.size, alignment_steps=60, alignment_levels=2),
    )
    return scored.psnr or 0.0
