"""The protocol: what a reconstruction scores on the views that it has not seen.

Estimated cameras are compared with true ones, whose worlds differ by a similarity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import undistort_frame
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.regions import (
    UNKNOWN,
    Appearance,
    Counts,
    ErrorMaps,
    Rasterize,
    RegionScore,
    compute_error_maps,
    compute_region_scores,
    make_appearance,
)
from splatnode.recon import keyframes
from splatnode.recon.geometry import align_cameras, angles_deg, compute_rms_radius, exp_se3, twist_gradient, umeyama
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.networks.lpips import Lpips, load_lpips
from splatnode.recon.optimize import photometric_losses
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.view_exposure import (
    ViewGains,
    collect_view_gains,
    interpolate_gains,
    relative_illumination,
)
from splatnode.recon.scene.exposure import SATURATED, measure_log_gain

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CameraErrors:
    """Errors of C estimated cameras. None where C, or the true motion, is too small to tell.

    `rotation_deg` is the largest angle of any camera once both sets share the best common rotation;
    `rotation_pair_deg` the largest error of any relative rotation, which needs no alignment. `centre_pct` is the RMS
    distance of the centres after Umeyama's similarity, in percent of the true centres' RMS distance from their mean.
    With C = 3 that similarity has 7 degrees of freedom against 9 numbers: read it with the rotations. `focal_pct` is
    the mean absolute relative error of the focal length.
    """

    rotation_deg: float | None
    rotation_pair_deg: float | None
    centre_pct: float | None
    focal_pct: float | None
    ate_instantsplat: float | None


def compare_cameras(Ts_estimated: Array, Ts_true: Array, Ks_estimated: Array, Ks_true: Array) -> CameraErrors:
    """Compares (C, 4, 4) T_world_camera and (C, 3, 3) K, in the same order and for the same image sizes."""
    if Ts_estimated.shape != Ts_true.shape or Ks_estimated.shape != Ks_true.shape:
        raise ValueError(
            f"cameras must come in pairs, got {Ts_estimated.shape} and {Ts_true.shape}, "
            f"{Ks_estimated.shape} and {Ks_true.shape}"
        )
    if len(Ts_true) == 0:
        return CameraErrors(None, None, None, None, None)
    focal = 100.0 * float(np.abs(_compute_focal(Ks_estimated) / _compute_focal(Ks_true) - 1.0).mean())
    if len(Ts_true) < 2:
        return CameraErrors(None, None, None, focal, None)
    rotations_estimated, rotations_true = Ts_estimated[:, :3, :3], Ts_true[:, :3, :3]
    common = align_cameras(Ts_estimated, Ts_true).rotation
    first, second = np.triu_indices(len(Ts_true), 1)
    return CameraErrors(
        rotation_deg=float(angles_deg(common @ rotations_estimated, rotations_true).max()),
        rotation_pair_deg=float(
            angles_deg(
                rotations_estimated[first].transpose(0, 2, 1) @ rotations_estimated[second],
                rotations_true[first].transpose(0, 2, 1) @ rotations_true[second],
            ).max()
        ),
        centre_pct=compute_centre_error_pct(Ts_estimated[:, :3, 3], Ts_true[:, :3, 3]),
        focal_pct=focal,
        ate_instantsplat=compute_ate_instantsplat(Ts_estimated, Ts_true),
    )


def compute_centre_error_pct(estimated: Array, true: Array) -> float | None:
    """RMS distance of centres (C, 3) after Umeyama's similarity, in percent of the true ones' RMS spread.

    None where the true camera does not move.
    """
    apart = compute_rms_radius(true)
    if apart <= 1e-9 * (1.0 + float(np.abs(true).max())):
        return None
    return 100.0 * _compute_rms_after_umeyama(estimated, true) / apart


def compute_ate_instantsplat(Ts_estimated: Array, Ts_true: Array) -> float | None:
    """The "ATE" of InstantSplat's released evaluation, only for comparison with published figures.

    It aligns the translation columns t = -R C of the world-to-camera matrices, each set centred and divided by its
    Frobenius norm. They do not transform by a similarity when the world moves, so a perfect reconstruction does not
    score 0 (0.008 to 0.02 on typical arcs), and the norm makes the figure shrink with the number of cameras. None where
    either set does not move.
    """
    columns = []
    for Ts in (Ts_estimated, Ts_true):
        t = np.linalg.inv(Ts)[:, :3, 3]
        centred = t - t.mean(0)
        norm = float(np.linalg.norm(centred))
        if norm <= 1e-9 * (1.0 + float(np.abs(t).max())):
            return None
        columns.append(centred / norm)
    return _compute_rms_after_umeyama(*columns)


def _compute_rms_after_umeyama(source: Array, target: Array) -> float:
    moved = umeyama(source, target)(source)
    return math.sqrt(float(((moved - target) ** 2).sum(1).mean()))


def _compute_focal(Ks: Array) -> Array:
    return np.sqrt(Ks[:, 0, 0] * Ks[:, 1, 1])


# Held-out photographs as a scene shows them: without the distortion that was taken out of its own photographs.

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def select_one_lens(cameras: Sequence[CameraEstimate]) -> Sequence[CameraEstimate]:
    """Those whose photographs had a distortion taken out, if they are most; else those whose had none."""
    bent = [camera for camera in cameras if camera.lens is not None]
    return bent if 2 * len(bent) > len(cameras) else [camera for camera in cameras if camera.lens is None]


def undistort_view(lens: Intrinsics | None, image: Image, mask: Mask) -> tuple[Image, Mask]:
    """A photograph (H, W, 3), and where it is used (H, W), without the distortion of `lens`; None: as they are.

    Raises ValueError where `lens` folds its picture over.
    """
    if lens is None:
        return image, mask
    frame = undistort_frame(Frame(0, "photograph", 0, image, lens, mask=mask))
    return frame.image, np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask


def undistort_counts(lens: Intrinsics | None, counts: Counts) -> Counts | None:
    """How many photographs show each pixel (H, W) of a photograph, without the distortion of `lens`.

    UNKNOWN where pixels that differ in it are mixed. None for a fisheye, whose picture gets another shape.
    """
    if lens is None:
        return counts
    if lens.model == "fisheye":
        return None
    blank, straight = np.zeros((*counts.shape, 3), np.uint8), np.full_like(counts, UNKNOWN)
    for count in np.unique(counts):
        straight[undistort_view(lens, blank, counts == count)[1]] = count
    return straight


def average_intrinsics(cameras: Sequence[CameraEstimate], width: int, height: int) -> npt.NDArray[np.float64]:
    """(3, 3) K for an image `width` x `height`: mean focal lengths and principal point, relative to the image sizes."""
    longer = np.array([max(camera.width, camera.height) for camera in cameras])
    Ks = np.stack([camera.K for camera in cameras])
    fx, fy = (float((Ks[:, i, i] / longer).mean()) * max(width, height) for i in (0, 1))
    cx = float((Ks[:, 0, 2] / [camera.width for camera in cameras]).mean()) * width
    cy = float((Ks[:, 1, 2] / [camera.height for camera in cameras]).mean()) * height
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


# Held-out photographs as they are scored: which pixels of them count.


@dataclass(frozen=True, eq=False)
class HeldOutView:
    name: str
    photograph: Tensor  # (H, W, 3) in [0, 1]
    used: Tensor  # (H, W) False where a mask hides it
    shown: tuple[slice, slice]  # rows and columns without a black rim

    @property
    def comparison_mask(self) -> Tensor | None:
        """(h, w) which pixels count of what is shown; None: all."""
        used = self.used[self.shown]
        return None if used.all() else used


def load_held_out_views(
    scene: EvaluationScene, split: Split, lens: Intrinsics | None, longer_side: int
) -> Iterator[HeldOutView]:
    """The test views with a true camera, without the distortion of `lens`; none of which a mask hides all."""
    names = [name for name in split.test if name in scene.cameras]
    given = [undistort_view(lens, *scene.load_masked_image(name)) for name in names]
    photographs = [resize_image(image, longer_side) for image, _ in given]
    rims = keyframes.valid_masks(photographs)
    for name, photograph, valid, (_, mask) in zip(names, photographs, rims, given, strict=True):
        used = torch.from_numpy(resize_mask(mask, *photograph.shape[:2]))
        shown = keyframes.valid_rectangle(valid)
        if used[shown].any():
            yield HeldOutView(name, torch.from_numpy(photograph).float() / 255.0, used, shown)


# How much two images differ. Images are (H, W, 3) in [0, 1].


def psnr(image: Tensor, truth: Tensor, used: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, for a peak of 1; at most 100, which equal images get.

    `used` (H, W) says which pixels count; None: all.
    """
    _check_same_shape(image, truth)
    squares = (image.double() - truth.double()) ** 2
    error = torch.mean(squares if used is None else squares[used])
    return float(-10.0 * torch.log10(error.clamp(min=1e-10)))


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) as the 3DGS code defines it, so that figures compare.

    An 11x11 Gaussian window of sigma 1.5 in each colour channel, zeros beyond the border, biased variances; the mean
    over all pixels and channels, 1 for equal images.
    """
    _check_same_shape(image, truth)
    return float(photometric_losses.ssim(image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)).mean())


def _check_same_shape(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"images must both be (H, W, 3), got {tuple(image.shape)} and {tuple(truth.shape)}")


def fit_gains(truth: Tensor, image: Tensor, used: Tensor) -> Tensor:
    """(3,) by which `image` fits `truth` best, both (H, W, 3), in each channel, where `used` (H, W) says so.

    What is white in `truth` may have been brighter, and does not count; where nothing does, the gain is 1.
    """
    is_usable = used[..., None] & (truth < SATURATED / 255.0)
    seen, known = image * is_usable, truth * is_usable
    squares = (seen * seen).sum((0, 1))
    fitting = (seen * known).sum((0, 1)) / squares.clamp_min(1e-12)
    return torch.where(squares > 0, fitting, 1.0).clamp_min(1e-3)


# The gains of a scene's training views, which tell those of a held-out one: the same for all methods. Those that were
# taken out of the photographs are published; of a method that was trained on photographs as they are, what is left
# between each photograph and the scene from its camera is measured. Photographs are taken to be in the order in which
# they were taken, so that a gain is interpolated in that, too.

MIN_GAIN_SIGMAS = 4.0  # of a measured log gain: where none is above, all are 1


def find_view_gains(
    appearance: Appearance, snapshot: Snapshot, scene: EvaluationScene, falloff: float, longer_side: int
) -> ViewGains:
    """Finds the gains of the training views over the scene: as published, else measured."""
    cameras = [camera for camera in snapshot.cameras if camera.name in scene.paths]
    order = list(scene.paths)
    times = np.array([order.index(camera.name) for camera in cameras], np.float64)
    if snapshot.gains:
        return replace(collect_view_gains(cameras, snapshot.gains, snapshot.gain_sigmas), times_s=times)
    measured = [_measure_view_gain(appearance, camera, scene, falloff, longer_side) for camera in cameras]
    logs, sigmas = (np.array(each).reshape(-1, 3) for each in zip(*measured, strict=True))
    if not (np.abs(logs) > MIN_GAIN_SIGMAS * sigmas).any():
        logs = np.zeros_like(logs)
    return replace(collect_view_gains(cameras, {}, {}), logs=logs, sigmas=sigmas, times_s=times)


def _measure_view_gain(
    appearance: Appearance, camera: CameraEstimate, scene: EvaluationScene, falloff: float, longer_side: int
) -> tuple[Array, Array]:
    """Measures the log gain (3,) of a training photograph over what the scene shows from its camera; and its sigma."""
    image, mask = undistort_view(camera.lens, *scene.load_masked_image(camera.name))
    photograph = resize_image(image, longer_side)
    height, width = photograph.shape[:2]
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    light = relative_illumination(falloff, width, height)[..., None]
    render = 255.0 * light * appearance.render(camera.T_world_camera, K, width, height).detach().cpu().numpy()
    used = resize_mask(mask, height, width) & keyframes.valid_masks([photograph])[0]
    return measure_log_gain(photograph, render, used)


# The networks that tell how alike two images look; without their weights nothing is measured.


@dataclass(frozen=True, eq=False)
class PerceptualNetworks:
    """The perceptual metrics for which there are weights."""

    alex: Lpips | None
    vgg: Lpips | None

    @property
    def quickest(self) -> PerceptualNetworks:
        """Without VGG, which takes twenty times as long as AlexNet, where the other serves."""
        return self if self.alex is None else PerceptualNetworks(self.alex, None)


def load_networks(weights_dir: Path | None = None) -> PerceptualNetworks:
    return PerceptualNetworks(load_lpips("alex", weights_dir), load_lpips("vgg", weights_dir))


def create_empty_networks() -> PerceptualNetworks:
    """For who measures nothing that needs them."""
    return PerceptualNetworks(None, None)


# Where the search for a held-out view's pose starts if its true pose may not be used, as publications do it.


def interpolate_pose(name: str, order: Sequence[str], cameras: Mapping[str, Array]) -> Array:
    """(4, 4) T_world_camera between the estimated cameras of the photographs before and after `name` in `order`.

    The centre moves evenly along the line between the two, and the rotation evenly about one axis, by the place of
    `name` between them; before the first and after the last it is that camera's. Raises ValueError where no photograph
    of `order` has a camera.
    """
    place = order.index(name)
    known = [index for index, each in enumerate(order) if each in cameras and index != place]
    if not known:
        raise ValueError(f"cameras must have at least one of the {len(order)} photographs, has {sorted(cameras)[:3]}")
    before = max((index for index in known if index < place), default=min(known))
    after = min((index for index in known if index > place), default=max(known))
    first, second = cameras[order[before]], cameras[order[after]]
    share = 0.0 if before == after else (place - before) / (after - before)
    turn = cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]
    T = np.eye(4)
    T[:3, :3] = first[:3, :3] @ cv2.Rodrigues(share * turn)[0]
    T[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return T


# Test-pose optimisation: the search for a test image's camera in a finished scene, which stays as it is.


_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-12  # of Adam (Kingma and Ba 2015)


@dataclass(frozen=True, eq=False)
class FoundPose:
    T_world_camera: Array  # (4, 4)
    loss: float  # mean absolute difference to the image


def find_test_pose(
    scene: Appearance,
    image: Tensor,  # (H, W, 3) in [0, 1]
    T_world_camera: Array,  # (4, 4) where the search starts
    K: Array,  # (3, 3) of `image`
    *,
    steps: int,
    levels: int = 1,
    learning_rate: float = 0.003,
    final: float = 0.01,  # the share of it that is left of the learning rate at the end
    used: Tensor | None = None,  # (H, W) where the image is compared; None: everywhere
) -> FoundPose:
    """Equation 18: the pose from which the frozen scene looks most like the image, in mean absolute difference.

    Adam moves a twist at the current pose, with a learning rate that falls exponentially (on a view of fountain_p11,
    120 steps of it found what 500 steps of InstantSplat's cosine found). The best pose seen is returned, never one
    worse than the start. `learning_rate` is in radians, and for the translation in parts of the scene's depth, so that
    both move the image by similar amounts in a world without scale. With `levels` > 1 the steps are shared between
    resolutions that double up to the image's own, which widens the basin and needs more of them. Raises ValueError for
    steps or levels below 1.
    """
    if steps < 1 or levels < 1:
        raise ValueError(f"steps and levels must be at least 1, got {steps} and {levels}")
    start = torch.from_numpy(np.ascontiguousarray(T_world_camera, np.float64))
    units = torch.ones(6, dtype=torch.float64)
    units[:3] = scene.depth(T_world_camera)
    first, second = torch.zeros(6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)  # Adam's moments

    T, best_T, best_loss = start, start, math.inf
    for step in range(steps):
        level = step * levels // steps
        reduced = _downsample_inputs(image, K, used, 2 ** (levels - 1 - level))
        loss, gradient = _loss_and_gradient(scene, T, *reduced)
        if level == levels - 1 and loss < best_loss:
            best_T, best_loss = T, loss
        slope = twist_gradient(T, gradient) * units
        first = _BETA1 * first + (1 - _BETA1) * slope
        second = _BETA2 * second + (1 - _BETA2) * slope**2
        unbiased = first / (1 - _BETA1 ** (step + 1)), second / (1 - _BETA2 ** (step + 1))
        rate = learning_rate * final ** (step / steps)
        # The moments live in the camera's own frame, which turns with it: each step is a twist at the current pose.
        T = T @ exp_se3(-rate * unbiased[0] / (unbiased[1].sqrt() + _EPSILON) * units)
    for candidate in (T, start):
        loss, _ = _loss_and_gradient(scene, candidate, image, torch.from_numpy(K), used)
        if loss < best_loss:
            best_T, best_loss = candidate, loss
    return FoundPose(best_T.numpy(), best_loss)


def _loss_and_gradient(
    scene: Appearance, T_world_camera: Tensor, image: Tensor, K: Tensor, used: Tensor | None
) -> tuple[float, Tensor]:
    """The mean absolute difference, and its gradient (4, 4) with respect to the pose alone."""
    T = T_world_camera.to(image).requires_grad_()
    loss = scene.difference(image, T, K.to(image), used)
    (gradient,) = torch.autograd.grad(loss, T)
    return float(loss.detach()), gradient.double()


def _downsample_inputs(
    image: Tensor, K: Array, used: Tensor | None, factor: int
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The image area-resampled by 1 / `factor`, its K, and where it is compared."""
    height, width = image.shape[:2]
    size = max(1, round(height / factor)), max(1, round(width / factor))
    ratios = torch.tensor([size[1] / width, size[0] / height, 1.0], dtype=torch.float64)
    if size != (height, width):
        image = functional.interpolate(image.permute(2, 0, 1)[None], size=size, mode="area")[0].permute(1, 2, 0)
        used = None if used is None else _downsample_mask(used, size)
    return image, torch.from_numpy(K) * ratios[:, None], used


def _downsample_mask(used: Tensor, size: tuple[int, int]) -> Tensor:
    """Pixels of which all is used; where there are none, those of which anything is."""
    share = functional.interpolate(used.float()[None, None], size=size, mode="area")[0, 0]
    whole = share > 0.999
    return whole if whole.any() else share > 0


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
    start: Literal["true", "interpolated"] = "true"  # of the search
    # A render gets, a channel, the gain that fits the photograph best: how that was exposed is nobody's to know
    best_gain: bool = False


INTERPOLATED_START = Settings(alignment_steps=500, alignment_levels=3, start="interpolated")


@dataclass(frozen=True)
class Run:
    """Which reconstruction a row is about, and what it cost. `seconds` has STAGES and "total"; None: not measured."""

    method: str
    seed: int
    checkpoint: int | None  # the iterations at which this row was asked for; None: the end of the run
    seconds: Mapping[str, float | None]
    peak_rss_mb: float | None


EXPOSURES = "raw", "interpolated", "best_gain"  # of renders: the scene's, that of the training views around, and best


@dataclass(frozen=True)
class ExposureScore:
    """Scores of renders with gains: none, those that the training views imply, or that fit each photograph best."""

    psnr: float  # dB, mean over the test views, as are the next
    ssim: float
    lpips_alex: float | None
    gain_error_pct: float  # root mean square of the gains' difference from the best, over views and channels


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
    # dB, mean over the test views, as are the next four: of renders as users get them, with the gains that the training
    # views imply, or with the best ones, where the settings say so
    psnr: float | None = None
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
    exposures: Mapping[str, ExposureScore] = field(default_factory=dict)  # by EXPOSURES; empty: not measured
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
    one, it gets it. `shown` tells of test views how many training photographs show each pixel (regions.py), at the size
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
    gains = None
    if appearance is not None and len(estimated) >= 2:
        gains = find_view_gains(appearance, snapshot, scene, falloff, settings.longer_side)
    seen = appearance, cameras, estimated, falloff, gains
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
        exposures={kind: _average_exposures([view.exposures[kind] for view in views]) for kind in EXPOSURES if views},
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
    exposures: Mapping[str, ExposureScore] = field(default_factory=dict)


def _score_test_views(
    appearance: Appearance | None,
    cameras: Sequence[CameraEstimate],
    estimated: Sequence[CameraEstimate],
    falloff: float,
    gains: ViewGains | None,
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
    if appearance is None or gains is None or len(estimated) < 2:
        return []
    true = [scene.cameras[camera.name].T_world_camera for camera in estimated]
    true_to_estimated = align_cameras(np.stack(true), np.stack([camera.T_world_camera for camera in estimated]))
    scores, order = [], list(scene.paths)
    lens = None if cameras[0].lens is None else replace(cameras[0].lens, skew=0.0)  # a skew is of one image alone
    for view in load_held_out_views(scene, split, lens, settings.longer_side):
        name, whole, used, place = view.name, view.photograph, view.used, float(order.index(view.name))
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
        elif gains.logs.any():  # what is darker in the photograph is so in the render
            target = target / torch.from_numpy(interpolate_gains(gains, start, place).gains).float()
        T_world_camera = find_test_pose(
            appearance, target, start, K, steps=steps, levels=levels, learning_rate=rate, used=view.comparison_mask
        ).T_world_camera
        found.setdefault(name, T_world_camera)
        with_rim = light * appearance.render(T_world_camera, whole_K, width, height)
        implied = torch.from_numpy(interpolate_gains(gains, T_world_camera, place).gains).float()
        best = fit_gains(truth, with_rim[rows, columns], used[rows, columns])
        gains_of = dict(zip(EXPOSURES, (torch.ones(3), implied, best), strict=True))
        main = "best_gain" if settings.best_gain else "interpolated"
        shown = (with_rim * gains_of[main]).clamp(0.0, 1.0)
        show(name, truth, shown[rows, columns])
        known = undistort_counts(lens, counts[name]) if name in counts else None
        own = _score_view(shown, whole, used, view.shown, networks, known)
        exposures = {main: _describe_exposure(own, gains_of[main], best)}
        for kind in EXPOSURES:
            if kind != main:
                other = (with_rim * gains_of[kind]).clamp(0.0, 1.0)
                scored = _score_view(other, whole, used, view.shown, PerceptualNetworks(networks.alex, None), None)
                exposures[kind] = _describe_exposure(scored, gains_of[kind], best)
        scores.append(replace(own, exposures=exposures))
    return scores


def _describe_exposure(score: _ViewScore, gains: Tensor, best: Tensor) -> ExposureScore:
    """The score of a render with `gains` (3,), beside those that fit the photograph best."""
    error = 100.0 * float((gains / best - 1.0).square().mean().sqrt())
    return ExposureScore(score.psnr, score.ssim, score.lpips_alex, error)


def _average_exposures(scores: Sequence[ExposureScore]) -> ExposureScore:
    perceptual = compute_mean([score.lpips_alex for score in scores])
    error = math.sqrt(float(np.mean([score.gain_error_pct**2 for score in scores])))
    psnrs, ssims = ([getattr(score, name) for score in scores] for name in ("psnr", "ssim"))
    return ExposureScore(float(np.mean(psnrs)), float(np.mean(ssims)), perceptual, error)


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
