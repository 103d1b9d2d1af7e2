"""Photometric losses: L1 + D-SSIM against a fixed photograph, whose part can be computed once, and the perceptual one.

Both compare a render with a TrainingImage, the photograph at the resolution of the render.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn import functional

from splatnode.capture.process.config import Internal
from splatnode.recon import rasterize
from splatnode.recon.core import library
from splatnode.recon.networks.lpips import MIN_SIDE, Lpips, load_lpips
from splatnode.recon.optimize.losses import Schedule
from splatnode.recon.scene import TrainingView

# Perceptual distance of two images: LPIPS where its weights are present, else image gradients over several scales.

_MIN_SIDE = 8  # pixels, of the smallest level of a pyramid
_FLAT = 1e-3  # mean gradient that is added to the truth's: a flat image divides by it

Distance = Callable[[Tensor], Tensor]  # image (H, W, 3) in [0, 1] -> scalar with gradients


class Perceptual(Protocol):
    @property
    def name(self) -> str:
        """Which measure it is, for the report."""
        ...

    def prepare_distance(self, truth: Tensor) -> Distance:
        """The distance from `truth` (H, W, 3) in [0, 1], whose own features are computed once; 0 for equal images."""
        ...


@dataclass(frozen=True, eq=False)
class LpipsDistance:
    network: Lpips
    name: str

    def prepare_distance(self, truth: Tensor) -> Distance:
        with torch.no_grad():
            features = self.network.features(truth)
        return lambda image: self.network.distance(image, features)


@dataclass(frozen=True)
class MultiScaleGradient:
    """Mean difference of image gradients over an octave pyramid, relative to the truth's own gradients.

    Edges must lie where the truth has them and be as strong; colour offsets cost nothing. It needs no weights.
    """

    scales: int = 4
    name: str = "multi-scale gradient"

    def prepare_distance(self, truth: Tensor) -> Distance:
        expected = [_slopes(level) for level in _pyramid(truth, self.scales)]
        strength = [sum(slope.abs().mean() for slope in level) + _FLAT for level in expected]

        def distance(image: Tensor) -> Tensor:
            found = [_slopes(level) for level in _pyramid(image, self.scales)]
            parts = [
                sum((mine - true).abs().mean() for mine, true in zip(level, truths, strict=True)) / total
                for level, truths, total in zip(found, expected, strength, strict=True)
            ]
            return torch.stack([torch.as_tensor(part) for part in parts]).mean()

        return distance


def load_perceptual(weights_dir: Path | None = None) -> Perceptual:
    """LPIPS with AlexNet, or the multi-scale gradient where its weights are not there."""
    return load_alex(weights_dir) or MultiScaleGradient()


def load_alex(weights_dir: Path | None = None) -> LpipsDistance | None:
    """LPIPS with AlexNet; None where its weights are not there."""
    network = load_lpips("alex", weights_dir)
    return None if network is None else LpipsDistance(network, "LPIPS AlexNet")


def _pyramid(image: Tensor, scales: int) -> list[Tensor]:
    """[(3, H, W), (3, H/2, W/2), ...], as long as both sides have at least 8 pixels."""
    levels = [image.permute(2, 0, 1)]
    while len(levels) < scales and min(levels[-1].shape[1:]) >= 2 * _MIN_SIDE:
        levels.append(functional.avg_pool2d(levels[-1], 2))
    return levels


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    return image[:, :, 1:] - image[:, :, :-1], image[:, 1:] - image[:, :-1]


# What the photometric loss is, in PyTorch: the core equals it, and so does what serves on other devices.

WINDOW, _SIGMA = 11, 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2


def photometric_loss(
    rgb: Tensor,  # (H, W, 3)
    target: Tensor,  # (3, H, W)
    ssim_weight: float,
    weights: Tensor | None = None,  # (H, W) of the pixels, in both means; None: all alike
) -> Tensor:
    """(1 - ssim_weight) * mean |rgb - target| + ssim_weight * mean (1 - SSIM), scalar, with gradients.

    Pixels of weight 0 count as the target's in their neighbours' windows. With all weights 0 the loss is 0.
    """
    image = rgb.permute(2, 0, 1)
    if weights is None:
        weights = torch.ones_like(target[0])
    image = torch.where(weights > 0, image, target)
    per_pixel = ((1 - ssim_weight) * (image - target).abs() + ssim_weight * (1 - ssim(image, target))).mean(0)
    total = weights.sum()
    return (weights * per_pixel).sum() / torch.where(total > 0, total, 1)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """(3, H, W) structural similarity (Wang et al. 2004) of images (3, H, W) in [0, 1], as the 3DGS code defines it.

    An 11 x 11 Gaussian window of sigma 1.5 in each colour, zeros beyond the border, biased variances.
    """
    products = torch.stack([image, target, image * image, target * target, image * target])
    mean, target_mean, squared, target_squared, product = _blur_reference(products)
    variance, target_variance = squared - mean**2, target_squared - target_mean**2
    covariance = product - mean * target_mean
    return ((2 * mean * target_mean + C1) * (2 * covariance + C2)) / (
        (mean**2 + target_mean**2 + C1) * (variance + target_variance + C2)
    )


def _blur_reference(images: Tensor) -> Tensor:
    """(M, 3, H, W) under the normalised Gaussian window, which is separable, with zeros beyond the border."""
    weights = window(images.dtype, images.device)
    planes = images.flatten(0, 1)[:, None]
    rows = functional.conv2d(planes, weights.view(1, 1, 1, -1), padding=(0, WINDOW // 2))
    return functional.conv2d(rows, weights.view(1, 1, -1, 1), padding=(WINDOW // 2, 0)).view_as(images)


def window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(11,) the weights of neighbours in a row, which is also those in a column."""
    offsets = torch.arange(WINDOW, dtype=dtype, device=device) - WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    return weights / weights.sum()


# The photometric loss and its gradient in closed form, in PyTorch, for other devices than the processor.
#
# There each operation is a launch, which takes longer than what it computes. So sums and differences are compared:
# with s = image + target, d = image - target, the blur B, S = (B s)^2, D = (B d)^2, and their variances V = B[s^2] -
# S, W = B[d^2] - D, SSIM is (S - D + 2 C1) / (S + D + 2 C1) times (V - W + 2 C2) / (V + W + 2 C2). Both factors are
# one expression of two pairs, and so are their derivatives. The blur is its own transpose.


@dataclass(frozen=True, eq=False)
class LossWeights:
    """The weights of the loss's two parts in each pixel of each colour, (H, W) each."""

    difference: Tensor  # of the absolute difference
    dissimilarity: Tensor  # of 1 - SSIM
    shown: Tensor | None  # False where a pixel is to be taken for the target's; None: nowhere


def make_weights(target: Tensor, ssim_weight: float, weights: Tensor | None) -> LossWeights:
    """Makes the weights of a loss against `target` (3, H, W) with pixel `weights` (H, W); None: all alike."""
    given = torch.ones_like(target[0]) if weights is None else weights.to(target.dtype)
    total = given.sum()
    unit = given / (3 * torch.where(total > 0, total, 1))
    return LossWeights((1 - ssim_weight) * unit, ssim_weight * unit, None if weights is None else given > 0)


@torch.no_grad()
def evaluate_loss(
    image: Tensor, target: Tensor, weights: LossWeights, differentiate: bool = True
) -> tuple[Tensor, Tensor]:
    """The loss, scalar, and its gradient (3, H, W), a view of (H, W, 3), of an image and a target (3, H, W).

    Not to be differentiated, the gradient may be anything.
    """
    if weights.shown is not None:
        image = torch.where(weights.shown, image, target)
    both = image.new_empty(4, *image.shape)  # s, d, and their squares
    torch.add(image, target, out=both[0])
    torch.sub(image, target, out=both[1])
    torch.mul(both[:2], both[:2], out=both[2:])
    blurred = _blur(both)
    pairs = image.new_empty(2, 2, *image.shape)  # S and D, V and W
    torch.mul(blurred[:2], blurred[:2], out=pairs[0])
    torch.sub(blurred[2:], pairs[0], out=pairs[1])
    pairs[:, 0].add_(_constants(image.dtype, image.device))
    below = pairs[:, 0] + pairs[:, 1]
    ratios = (pairs[:, 0] - pairs[:, 1]) / below
    dissimilarity = torch.addcmul(weights.dissimilarity, ratios[0], ratios[1] * weights.dissimilarity, value=-1)
    signs = both[1].sgn() * weights.difference
    value = torch.addcmul(dissimilarity, signs, both[1]).sum()
    if not differentiate:
        return value, image
    # By S, D, V and W, halved: of what the other factor is multiplied by.
    others = ratios.flip(0) / below * weights.dissimilarity
    derivatives = pairs
    torch.mul(others, ratios, out=derivatives[:, 0])
    torch.add(others, derivatives[:, 0], out=derivatives[:, 1])
    derivatives[:, 0].sub_(others)
    derivatives[0].sub_(derivatives[1]).mul_(blurred[:2])
    back = _blur(derivatives.flatten(0, 1))
    by_both = torch.addcmul(back[:2], both[:2], back[2:])
    gradient = torch.add(by_both[0], by_both[1])
    if weights.shown is not None:
        gradient.mul_(weights.shown)
    channels_last = torch.empty_like(gradient.permute(1, 2, 0), memory_format=torch.contiguous_format).permute(2, 0, 1)
    return value, torch.add(signs, gradient, alpha=2, out=channels_last)


def _blur(images: Tensor) -> Tensor:
    """(M, 3, H, W) under the window, with zeros beyond the border.

    Each plane is a channel of its own: torch has kernels for that, which compute in full precision.
    """
    planes = images.flatten(0, 1)[None]
    count = planes.shape[1]
    across, down = _windows(count, images.dtype, images.device)
    rows = functional.conv2d(planes, across, padding=(0, WINDOW // 2), groups=count)
    return functional.conv2d(rows, down, padding=(WINDOW // 2, 0), groups=count).view_as(images)


@lru_cache(maxsize=8)
def _windows(count: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    weights = window(dtype, device).expand(count, 1, -1)
    return weights[:, :, None, :].contiguous(), weights[:, :, :, None].contiguous()


@lru_cache(maxsize=8)
def _constants(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor([2 * C1, 2 * C2], dtype=dtype, device=device).view(2, 1, 1, 1)


class PhotometricLoss:
    """(1 - w) * mean |rgb - target| + w * mean (1 - SSIM), w = `ssim_weight`: the loss of 3DGS.

    SSIM has the 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the border. Value and gradient are computed
    together, in float32: in the compiled core, or by torch where the target is on another device than the processor.
    """

    def __init__(
        self, target: Tensor, ssim_weight: float = 0.2, weights: Tensor | None = None, keep_moments: bool = True
    ):
        """`target`: (H, W, 3) in [0, 1]; `weights`: (H, W) >= 0 weigh the pixels of both means, None: all alike.

        The target's moments take twice its memory. Where they are not kept they are computed each time.
        A pixel of weight 0 is ignored: it has no gradient, and in its neighbours' windows it counts as the target's.
        With all weights 0 the loss is 0. Raises ValueError for other shapes and for targets that are not finite.
        """
        if target.dim() != 3 or target.shape[2] != 3 or 0 in target.shape or not target.is_floating_point():
            raise ValueError(f"target must be (H, W, 3) floats, got {tuple(target.shape)} {target.dtype}")
        if not 0 <= ssim_weight <= 1:
            raise ValueError(f"ssim_weight must be from 0 to 1, got {ssim_weight}")
        if weights is not None and weights.shape != target.shape[:2]:
            raise ValueError(f"weights must be {tuple(target.shape[:2])}, got {tuple(weights.shape)}")
        self.ssim_weight = ssim_weight
        self._weights = None if weights is None else weights.detach().to(torch.float32).contiguous()
        self.target = _planar(target.detach())
        if not bool(torch.isfinite(self.target).all()):
            raise ValueError("target must be finite")
        self._on_device: LossWeights | None = None  # where torch computes
        if not rasterize.is_on_cpu(self.target):
            self._on_device = make_weights(self.target, ssim_weight, self._weights)
            return
        pixels = float(target.shape[0] * target.shape[1])
        self._total_weight = pixels if self._weights is None else float(self._weights.sum(dtype=torch.float64))
        self._moments = self._compute_moments() if keep_moments else None

    def __call__(self, rgb: Tensor) -> Tensor:
        """The loss of `rgb` (H, W, 3), scalar."""
        _, height, width = self.target.shape
        if tuple(rgb.shape) != (height, width, 3) or not rgb.is_floating_point():
            raise ValueError(
                f"rgb must be ({height}, {width}, 3) floats as the target, got {tuple(rgb.shape)} {rgb.dtype}"
            )
        return _Photometric.apply(rgb, self)

    def _compute_moments(self) -> tuple[Tensor, Tensor]:
        """Mean and variance of the target in the window of each pixel, both (3, H, W)."""
        mean, variance = torch.empty_like(self.target), torch.empty_like(self.target)
        _, height, width = self.target.shape
        library().core_photometric_moments(_address(self.target), width, height, _address(mean), _address(variance))
        return mean, variance

    def evaluate(self, rgb: Tensor, differentiate: bool) -> tuple[Tensor, Tensor | None]:
        """The loss of `rgb` (H, W, 3), scalar, and its gradient (3, H, W) where it is asked for."""
        if self._on_device is not None:
            image = rgb.to(torch.float32).permute(2, 0, 1)
            value, gradient = evaluate_loss(image, self.target, self._on_device, differentiate)
            return value.to(rgb.dtype), gradient
        planar = _planar(rgb)
        gradient = torch.empty_like(planar) if differentiate else None
        return rgb.new_tensor(self._evaluate_by_core(planar, gradient)), gradient

    def _evaluate_by_core(self, planar: Tensor, gradient: Tensor | None) -> float:
        """The loss of a planar (3, H, W) image; fills `gradient`, of the same shape, where given."""
        _, height, width = self.target.shape
        mean, variance = self._moments or self._compute_moments()
        evaluate = library().core_photometric
        evaluate.restype = ctypes.c_double
        return evaluate(
            _address(planar), _address(self.target), _address(mean), _address(variance),
            _address(self._weights), ctypes.c_double(self._total_weight), ctypes.c_double(self.ssim_weight),
            width, height, _address(gradient),
        )  # fmt: skip


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, loss: PhotometricLoss) -> Tensor:
        value, ctx.gradient = loss.evaluate(rgb, ctx.needs_input_grad[0])
        ctx.dtype = rgb.dtype
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        if upstream.device.type != "cpu":  # whose value would have to be waited for
            gradient = ctx.gradient * upstream
        else:
            factor = float(upstream)
            gradient = ctx.gradient if factor == 1 else ctx.gradient * factor
        return gradient.permute(1, 2, 0).to(ctx.dtype), None


def _planar(image: Tensor) -> Tensor:
    return image.to(torch.float32).permute(2, 0, 1).contiguous()


def _address(tensor: Tensor | None) -> ctypes.c_void_p | None:
    return None if tensor is None else ctypes.c_void_p(tensor.data_ptr())


# Perceptual loss on photographs: the render of a training view must have its photograph's texture.
#
# L1 and D-SSIM leave faint grain out, since a render without it is nearer to the photograph, pixel by pixel, than one
# with other grain. LPIPS tells them apart. It takes as long as several steps, so it counts in every few steps alone,
# with so many times its weight. Its weights are the user's (`splatnode weights`): without them it does not count.


class PerceptualLossConfig(Schedule, frozen=True, forbid_unknown_fields=True):
    """None by default. The weight is of each step, in the mean."""

    start: Internal[float] = 0.5  # share of the iterations after which it counts
    every: Internal[Annotated[int, Meta(ge=1)]] = 5  # steps from one in which it counts to the next one

    def weight_in_step(self, step: int, progress: float) -> float:
        """The weight in step `step`, counted from 0, at `progress` in [0, 1]; 0 where the loss is not computed."""
        return 0.0 if step % self.every else self.every * self.weight_at(progress)


@dataclass(frozen=True, eq=False)
class PerceptualLoss:
    """LPIPS of a render against a photograph, where that shows the scene."""

    distance: Distance  # from the photograph
    target: Tensor  # (H, W, 3) the photograph
    shown: Tensor | None  # (H, W, 1) bool: False where it is not compared; None: all of it is

    def __call__(self, rgb: Tensor) -> Tensor:
        """The distance of a render (H, W, 3), scalar, with gradients."""
        return self.distance(rgb if self.shown is None else torch.where(self.shown, rgb, self.target))


def load(config: PerceptualLossConfig, device: torch.device) -> LpipsDistance | None:
    """The measure, on `device`; None where the weight is 0, or no weights of the network are there."""
    found = load_alex() if config.weight else None
    return None if found is None else replace(found, network=found.network.move_to_device(device))


def perceptual_loss(
    measure: LpipsDistance | None, target: Tensor, weights: Tensor | None, keep_features: bool
) -> Callable[[Tensor], Tensor] | None:
    """The loss against `target` (H, W, 3), where `weights` (H, W) are not 0; None where nothing can be computed.

    What the network sees in a photograph takes about 40 bytes a pixel while it is kept.
    """
    if measure is None or min(target.shape[:2]) < MIN_SIDE:
        return None
    distance = measure.prepare_distance(target) if keep_features else lambda rgb: measure.prepare_distance(target)(rgb)
    return PerceptualLoss(distance, target, None if weights is None else (weights > 0)[..., None])


# TrainingImage: the photograph of a view at the resolution at which its render is compared with it.

_PROCESSOR = torch.device("cpu")
# Weight of a gain of 1 against what a render and its photograph say, of what is left of an exposure by a factor of 2
# that was taken out. What is left is much the same share of any exposure, so the weight is its square's reciprocal. Of
# a small one nothing is: a gain that was free there would only follow what the render lacks, and takes time.
_PRIOR = 0.1
_MIN_TONED = math.log(1.3)  # logarithm of an exposure from which on something is left
_WHOLLY_SHOWN = 1e-3  # tolerance on the share of a pixel that shows the scene, above the rounding of the resize


@dataclass(frozen=True, eq=False)
class TrainingImage:
    K: Tensor  # (3, 3) intrinsics at this size, pixels
    width: int  # pixels
    height: int
    # Of a render (height, width, 3), against the photograph where that shows the scene
    loss: Callable[[Tensor], Tensor]  # photometric
    perceptual: Callable[[Tensor], Tensor] | None = None  # None: there is no network for it


@dataclass(frozen=True, eq=False)
class _ExposureCompensatedLoss:
    """A loss against a photograph whose exposure was taken out.

    A tone curve is no gain, so a part of the exposure is left in it: a gain a channel, the one that fits the render
    best, under the prior that it is 1. Where the photograph is saturated, a render that is brighter is right.
    """

    loss: Callable[[Tensor], Tensor]
    target: Tensor  # (height, width, 3) the photograph
    is_usable: Tensor  # (height, width, 3) bool: False where it is saturated, or does not show the scene
    # (height, width, 3) of the render: the photograph where it is saturated, else infinite. None: nothing is saturated
    cap: Tensor | None
    prior: Tensor | None  # (3,) as much as the weight of a gain of 1 of the photograph, squared; None: nothing is left

    def __call__(self, rgb: Tensor) -> Tensor:
        if self.prior is not None:
            rgb = rgb * self._gains(rgb.detach(), self.prior)
        return self.loss(rgb if self.cap is None else rgb.clamp(max=self.cap))

    def _gains(self, rgb: Tensor, prior: Tensor) -> Tensor:
        """(3,) in closed form; 1 for a channel of which the photograph tells nothing but black."""
        seen = rgb * self.is_usable
        known = (seen * self.target).sum((0, 1)) + prior
        gains = known / ((seen * seen).sum((0, 1)) + prior).clamp_min(1e-12)
        return torch.where(prior > 0, gains, 1.0)


def make_training_image(
    view: TrainingView,
    shown: npt.NDArray[np.bool_],
    scale: float,
    dssim: float,
    device: torch.device = _PROCESSOR,
    keep: bool = True,
    measure: LpipsDistance | None = None,
    headroom: float = 1.0,
) -> TrainingImage:
    """The photograph of `view` at `scale` of its size, with `dssim` the weight of D-SSIM in its photometric loss.

    The photograph lies, and the losses are computed, on `device`: that of the Gaussians which are rendered, where the
    network of `measure`, for the perceptual loss, has to be, too. `keep`: whether what the losses compute of the
    photograph is kept. `headroom` is the part of the exposure that all views of the scene have in common.

    `shown` (h, w), at the photograph's own size, is False on the black border that undistortion leaves. A pixel of the
    smaller image is compared only if all pixels that it covers are shown.
    """
    K, width, height = scale_intrinsics(view.K, view.width, view.height, scale)
    image, weights = view.image, None
    if (width, height) != (view.width, view.height):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    if not shown.all():
        share = cv2.resize(shown.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        weights = torch.from_numpy(np.floor(share + np.float32(_WHOLLY_SHOWN))).to(device)
    target = torch.tensor(image, device=device).float() / 255.0  # a copy: what is read from a file is read-only
    loss = PhotometricLoss(target, dssim, weights, keep)
    perceptual = perceptual_loss(measure, target, weights, keep)
    if view.exposure is None:
        return TrainingImage(K, width, height, loss, perceptual)
    is_usable = (
        torch.ones_like(target, dtype=torch.bool) if weights is None else (weights > 0)[..., None].expand_as(target)
    )
    cap = None
    if view.exposure.saturated is not None:
        share = cv2.resize(view.exposure.saturated.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        is_usable = is_usable & torch.from_numpy(share == 0).to(device)
        cap = torch.where(is_usable, torch.inf, target)
    taken_out = max(view.exposure.falloff / 2.0, *(abs(math.log(gain / headroom)) for gain in view.exposure.gains))
    if taken_out < _MIN_TONED and view.exposure.saturated is None:
        return TrainingImage(K, width, height, loss, perceptual)
    prior = None
    if taken_out >= _MIN_TONED:
        known = target * is_usable
        prior = _PRIOR * (math.log(2.0) / taken_out) ** 2 * (known * known).sum((0, 1))
    exposed = partial(_ExposureCompensatedLoss, target=target, is_usable=is_usable, cap=cap, prior=prior)
    return TrainingImage(K, width, height, exposed(loss), perceptual and exposed(perceptual))


def scale_intrinsics(K: Tensor, width: int, height: int, scale: float) -> tuple[Tensor, int, int]:
    """Intrinsics, width and height of the same view at `scale` of its resolution."""
    scaled_width, scaled_height = max(1, round(width * scale)), max(1, round(height * scale))
    factors = torch.tensor([[scaled_width / width], [scaled_height / height], [1.0]])
    return K.float() * factors, scaled_width, scaled_height
