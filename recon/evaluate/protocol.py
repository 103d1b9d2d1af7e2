"""The protocol: what a reconstruction scores on the views that it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.evaluate.appearance import Appearance, Rasterize, make_appearance
from splatnode.recon.evaluate.camera_errors import CameraErrors, compare_cameras
from splatnode.recon.evaluate.held_out import load_held_out_views
from splatnode.recon.evaluate.metrics import fit_gains, psnr, ssim
from splatnode.recon.evaluate.perceptual import PerceptualNetworks
from splatnode.recon.evaluate.regions import (
    UNKNOWN,
    Counts,
    ErrorMaps,
    RegionScore,
    compute_error_maps,
    compute_region_scores,
)
from splatnode.recon.evaluate.same_lens import average_intrinsics, select_one_lens, undistort_counts
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.start_pose import interpolate_pose
from splatnode.recon.evaluate.test_pose import find_test_pose
from splatnode.recon.evaluate.truth import EvaluationScene
from splatnode.recon.geometry import align_cameras
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.scene.vignetting import relative_illumination

STAGES = ("poses", "points", "optimise")
FAILED = "FAILED"  # in place of a verdict's code
_FIRST_RATE, _CONTINUED_RATE = 3e-3, 5e-4  # learning rates of the test-pose search, in radians and parts of the depth


@dataclass(frozen=True)
class Settings:
    """How held-out views are scored; part of every benchmark's record."""

    longer_side: int = 512  # pixels
    alignment_steps: int = 120
    alignment_levels: int = 1
    continued_steps: int = 60  # from the pose that was found in another moment of the same run, at full size
    start: Literal["true", "interpolated"] = "true"  # of the search: start_pose.py
    # A render gets, a channel, the gain that fits the photograph best: how that was exposed is nobody's to know
    best_gain: bool = False


INTERPOLATED_START = Settings(alignment_steps=300, alignment_levels=3, start="interpolated")


@dataclass(frozen=True)
class Run:
    """Which reconstruction a row is about, and what it cost. `seconds` has STAGES and "total"; None: not measured."""

    method: str
    seed: int
    checkpoint: int | None  # the iterations at which this row was asked for; None: the end of the run
    seconds: Mapping[str, float | None]
    peak_rss_mb: float | None


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of bench.json. What was not measured is None."""

    scene: str
    views: int
    method: str
    seed: int
    checkpoint: int | None  # the iterations at which this row was asked for; None: the end of the run
    final: bool
    iterations: int | None = None
    psnr: float | None = None  # dB, mean over the test views, as are the next four
    psnr_with_rim: float | None = None  # over whole photographs, with the black rims that undistortion left
    ssim: float | None = None
    lpips_alex: float | None = None
    lpips_vgg: float | None = None
    rotation_error_deg: float | None = None
    rotation_pair_error_deg: float | None = None
    centre_error_pct: float | None = None
    focal_error_pct: float | None = None
    ate_instantsplat: float | None = None
    seconds: Mapping[str, float | None]  # None: not measured, or others had a part of its cores
    cores: int | None = None  # that it could use while it was timed
    processor: str | None = None
    others: float | None = None  # the share of the cores' time that others took meanwhile
    peak_rss_mb: float | None
    num_gaussians: int | None = None
    num_cameras: int | None = None  # of the training views, those with an estimated pose
    scene_bytes: int | None = None
    regions: Mapping[str, RegionScore] = field(default_factory=dict)  # by regions.REGIONS; empty: not measured
    verdict: str  # a verdict's code; FAILED where the run ended without a result
    error: str | None = None  # why it did


Show = Callable[[str, Tensor, Tensor], None]  # name of a test view, photograph, render; both (H, W, 3) in [0, 1]
Poses = MutableMapping[str, npt.NDArray[np.float64]]  # T_world_camera (4, 4) by the name of a test view


def ignore_render(name: str, truth: Tensor, image: Tensor) -> None:
    """For a caller that wants no renders."""


def evaluate(
    snapshot: Snapshot,
    scene: EvaluationScene,
    split: Split,
    run: Run,
    *,
    rasterize: Rasterize,
    networks: PerceptualNetworks,
    settings: Settings,
    show: Show = ignore_render,
    found: Poses | None = None,
    shown: Mapping[str, Counts] | None = None,
) -> Row:
    """Scores a snapshot on the scene's test views. The truth is used here and nowhere earlier.

    `show` gets the name of each test view, its photograph and what the scene looks like from there. `found` holds the
    test views' poses that another moment of the same run was given, from which the search then goes on; where it lacks
    one, it gets it. `shown` tells of test views how many training photographs show each pixel (shown.py), at the size
    at which they are scored: then the row has scores by region.

    A snapshot whose verdict forbids publishing it has no scene and is scored on nothing; its cameras are compared all
    the same, which tells whether the refusal was needed.
    """
    estimated = [camera for camera in snapshot.cameras if camera.name in scene.cameras]
    errors = _compare_cameras(estimated, scene)
    appearance = make_appearance(snapshot, rasterize)
    found = {} if found is None else found
    cameras = select_one_lens(snapshot.cameras)
    falloff = snapshot.falloffs.get(cameras[0].name, 0.0) if cameras else 0.0
    seen = appearance, cameras, estimated, falloff
    views = _score_test_views(*seen, scene, split, networks, settings, show, found, shown or {})
    return Row(
        scene=scene.name,
        views=len(split.train),
        method=run.method,
        seed=run.seed,
        checkpoint=run.checkpoint,
        final=run.checkpoint is None,
        iterations=snapshot.iterations,
        psnr=compute_mean([view.psnr for view in views]),
        psnr_with_rim=compute_mean([view.psnr_with_rim for view in views]),
        ssim=compute_mean([view.ssim for view in views]),
        lpips_alex=compute_mean([view.lpips_alex for view in views]),
        lpips_vgg=compute_mean([view.lpips_vgg for view in views]),
        rotation_error_deg=errors.rotation_deg,
        rotation_pair_error_deg=errors.rotation_pair_deg,
        centre_error_pct=errors.centre_pct,
        focal_error_pct=errors.focal_pct,
        ate_instantsplat=errors.ate_instantsplat,
        seconds=run.seconds,
        peak_rss_mb=run.peak_rss_mb,
        num_gaussians=0 if appearance is None else appearance.num_gaussians,
        num_cameras=len(snapshot.cameras),
        scene_bytes=0 if appearance is None else appearance.num_bytes,
        regions=compute_region_scores([view.maps for view in views if view.maps is not None]),
        verdict=snapshot.verdict.code.value,
    )


@dataclass(frozen=True, eq=False)
class _ViewScore:
    psnr: float
    psnr_with_rim: float
    ssim: float
    lpips_alex: float | None
    lpips_vgg: float | None
    maps: ErrorMaps | None  # None: nothing tells which training photographs show the pixels


def _score_test_views(
    appearance: Appearance | None,
    cameras: Sequence[CameraEstimate],
    estimated: Sequence[CameraEstimate],
    falloff: float,
    scene: EvaluationScene,
    split: Split,
    networks: PerceptualNetworks,
    settings: Settings,
    show: Show,
    found: Poses,
    counts: Mapping[str, Counts],
) -> list[_ViewScore]:
    """Renders each test view from the pose that equation 18 finds, with the intrinsics of the training cameras.

    The search starts from the pose that was `found` before, or else from the true one, carried into the estimated world
    by the similarity that aligns the training cameras; or from between its neighbours, if `settings` says so. No view
    can be scored with fewer than two of them. Photographs are compared where they show the scene: a black rim that
    undistortion left is cut off, for the search too, and what a mask hides counts as well rendered in SSIM and LPIPS,
    and not at all in the search, in PSNR and in the scores by region. A distortion that was taken out of the training
    photographs is taken out of these, too. Where their vignetting was taken out, renders get it. A view of which masks
    leave nothing is left out.
    """
    if appearance is None or len(estimated) < 2:
        return []
    true = [scene.cameras[camera.name].T_world_camera for camera in estimated]
    true_to_estimated = align_cameras(np.stack(true), np.stack([camera.T_world_camera for camera in estimated]))
    scores = []
    for view in load_held_out_views(scene, split, cameras[0].lens, settings.longer_side):
        name, whole, used = view.name, view.photograph, view.used
        rows, columns = view.shown
        height, width = whole.shape[:2]
        whole_K = average_intrinsics(cameras, width, height)
        truth = whole[rows, columns]
        light = torch.from_numpy(relative_illumination(falloff, width, height))[..., None]
        K = whole_K - np.array([[0.0, 0.0, columns.start], [0.0, 0.0, rows.start], [0.0, 0.0, 0.0]])
        if name in found:
            start, steps, levels, rate = found[name], settings.continued_steps, 1, _CONTINUED_RATE
        else:
            start = true_to_estimated.camera(scene.cameras[name].T_world_camera)
            if settings.start == "interpolated":
                start = interpolate_pose(name, list(scene.paths), {c.name: c.T_world_camera for c in estimated})
            steps, levels, rate = settings.alignment_steps, settings.alignment_levels, _FIRST_RATE
        target = (truth / light[rows, columns]).clamp(0.0, 1.0)
        if settings.best_gain:
            begun = appearance.render(start, K, truth.shape[1], truth.shape[0])
            target = target / fit_gains(target, begun, used[rows, columns])
        T_world_camera = find_test_pose(
            appearance, target, start, K, steps=steps, levels=levels, learning_rate=rate, used=view.comparison_mask
        ).T_world_camera
        found.setdefault(name, T_world_camera)
        with_rim = light * appearance.render(T_world_camera, whole_K, width, height)
        if settings.best_gain:
            with_rim = with_rim * fit_gains(truth, with_rim[rows, columns], used[rows, columns])
        with_rim = with_rim.clamp(0.0, 1.0)
        show(name, truth, with_rim[rows, columns])
        known = undistort_counts(cameras[0].lens, counts[name]) if name in counts else None
        scores.append(_score_view(with_rim, whole, used, view.shown, networks, known))
    return scores


def _score_view(
    with_rim: Tensor,
    whole: Tensor,
    used: Tensor,
    shown: tuple[slice, slice],
    networks: PerceptualNetworks,
    counts: Counts | None,
) -> _ViewScore:
    """A render against a photograph, both (H, W, 3), where `used` (H, W) says so, within the rows and columns shown."""
    whole = torch.where(used[..., None], whole, with_rim)
    image, truth = with_rim[shown], whole[shown]
    maps = None
    if counts is not None:
        judged = np.where(used.numpy(), counts, np.uint8(UNKNOWN))[shown]
        maps = compute_error_maps(image, truth, judged, networks.alex)
    return _ViewScore(
        psnr=psnr(image, truth, used[shown]),
        psnr_with_rim=psnr(with_rim, whole, used),
        ssim=ssim(image, truth),
        lpips_alex=networks.alex(image, truth) if networks.alex else None,
        lpips_vgg=networks.vgg(image, truth) if networks.vgg else None,
        maps=maps,
    )


def _compare_cameras(estimated: Sequence[CameraEstimate], scene: EvaluationScene) -> CameraErrors:
    true = [scene.cameras[camera.name] for camera in estimated]
    return compare_cameras(
        np.array([camera.T_world_camera for camera in estimated]).reshape(-1, 4, 4),
        np.array([camera.T_world_camera for camera in true]).reshape(-1, 4, 4),
        np.array([camera.K_photographed for camera in estimated]).reshape(-1, 3, 3),
        np.array([t.K_for(camera.width, camera.height) for t, camera in zip(true, estimated, strict=True)]).reshape(
            -1, 3, 3
        ),
    )


def compute_mean(values: Sequence[float | None]) -> float | None:
    """Returns the mean of the values that were measured; None where none was."""
    measured = [value for value in values if value is not None]
    return float(np.mean(measured)) if measured else None
