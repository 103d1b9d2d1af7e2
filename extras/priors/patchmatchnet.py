"""PatchmatchNet: the depth of a photograph from others with known cameras, searched from coarse to fine.

"PatchmatchNet: Learned Multi-View Patchmatch Stereo" (Wang et al. 2021). Each stage proposes depths for every pixel
(at first all over the range, then around the last estimate and from learned neighbours), warps the sources' features
at these depths, and scores them; three networks learn where to look, which source to believe and how alike features
have to be. Written from the paper; modules carry the names of the published checkpoint. Pixel centres are at whole
numbers in the network, its sampling and scoring. Depth maps are checked against each other like those of our own
stereo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon import networks
from splatnode.recon.networks import find
from splatnode.recon.priors import classical, stereo
from splatnode.recon.priors.classical import ClassicalPrior
from splatnode.recon.priors.stereo import DepthMap, Planes, SparsePoints, StereoView, make_level
from splatnode.recon.threads import BACKGROUND, RunContext

# PatchmatchNet's image networks: a pyramid of features, and depth made twice as fine along a photograph's edges.


class _ConvNormRelu(nn.Module):
    """Convolution, batch norm and ReLU."""

    def __init__(self, channels: int, out: int, size: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, size, stride, size // 2, bias=False)
        self.bn = nn.BatchNorm2d(out)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(x)))


class FeaturePyramid(nn.Module):
    """A feature pyramid: channels 64, 32 and 16 at 1/8, 1/4 and 1/2 of the image's size."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1 = _ConvNormRelu(3, 8), _ConvNormRelu(8, 8)
        self.conv2, self.conv3, self.conv4 = _make_halving_layers(8, 16)
        self.conv5, self.conv6, self.conv7 = _make_halving_layers(16, 32)
        self.conv8, self.conv9, self.conv10 = _make_halving_layers(32, 64)
        self.output1 = nn.Conv2d(64, 64, 1, bias=False)
        self.inner1, self.inner2 = nn.Conv2d(32, 64, 1), nn.Conv2d(16, 64, 1)
        self.output2, self.output3 = nn.Conv2d(64, 32, 1, bias=False), nn.Conv2d(64, 16, 1, bias=False)

    def forward(self, image: Tensor) -> dict[int, Tensor]:
        """(C, H / 2^level, W / 2^level) by level, of an image (3, H, W)."""
        half = self.conv4(self.conv3(self.conv2(self.conv1(self.conv0(image[None])))))
        quarter = self.conv7(self.conv6(self.conv5(half)))
        eighth = self.conv10(self.conv9(self.conv8(quarter)))
        quarter = _upsample(eighth) + self.inner1(quarter)
        half = _upsample(quarter) + self.inner2(half)
        return {3: self.output1(eighth)[0], 2: self.output2(quarter)[0], 1: self.output3(half)[0]}


def _make_halving_layers(channels: int, out: int) -> tuple[_ConvNormRelu, _ConvNormRelu, _ConvNormRelu]:
    return _ConvNormRelu(channels, out, size=5, stride=2), _ConvNormRelu(out, out), _ConvNormRelu(out, out)


def _upsample(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


class Refinement(nn.Module):
    """Depth at twice its size, sharpened along the photograph's edges."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1, self.conv2 = _ConvNormRelu(3, 8), _ConvNormRelu(1, 8), _ConvNormRelu(8, 8)
        self.deconv = nn.ConvTranspose2d(8, 8, 3, stride=2, padding=1, output_padding=1, bias=False)
        self.bn = nn.BatchNorm2d(8)
        self.conv3 = _ConvNormRelu(16, 8)
        self.res = nn.Conv2d(8, 1, 3, padding=1, bias=False)

    def forward(self, image: Tensor, depth: Tensor, near_far: tuple[float, float]) -> Tensor:
        """(H, W) depth from `depth` (H / 2, W / 2) and the photograph `image` (3, H, W)."""
        near, far = near_far
        place = ((depth - near) / (far - near))[None, None]
        detail = torch.relu(self.bn(self.deconv(self.conv2(self.conv1(place)))))
        detail = self.res(self.conv3(torch.cat([detail, self.conv0(image[None])], 1)))
        place = functional.interpolate(place, scale_factor=2.0, mode="nearest") + detail
        return place[0, 0] * (far - near) + near


# Where features are looked up: at a pixel's neighbours, and where a depth puts it in another photograph.
#
# Pixel centres are at whole numbers.


@dataclass(frozen=True, eq=False)
class Source:
    """A photograph with its camera."""

    image: Tensor  # (3, H, W) in [0, 1], sides multiples of 8
    K: Tensor  # (3, 3), the centre of the first pixel at (0, 0)
    T_camera_world: Tensor  # (4, 4)


def make_square_steps(reach: int, centre: bool = False) -> list[tuple[int, int]]:
    """(down, right) steps to the eight neighbours `reach` pixels away, row by row, with the middle or without."""
    steps = [(down, right) for down in (-reach, 0, reach) for right in (-reach, 0, reach)]
    return [step for step in steps if centre or step != (0, 0)]


def make_sampling_grid(learnt: Tensor, steps: Sequence[tuple[int, int]]) -> Tensor:
    """(M, h, w, 2) where to sample for M neighbours: a fixed step and a `learnt` one (2 M, h, w; x then y)."""
    height, width = learnt.shape[1:]
    rows, columns = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    x = torch.stack([columns + right for _, right in steps]) + learnt[0::2]
    y = torch.stack([rows + down for down, _ in steps]) + learnt[1::2]
    return torch.stack([x / ((width - 1) / 2) - 1, y / ((height - 1) / 2) - 1], -1)


def sample_neighbours(images: Tensor, grid: Tensor) -> Tensor:
    """(C, M, h, w) of images (C, h, w) at the M neighbours of every pixel."""
    count, height, width, _ = grid.shape
    flat = grid.reshape(1, count * height, width, 2)
    sampled = functional.grid_sample(images[None], flat, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].unflatten(1, (count, height))


def compute_warp(reference: Source, source: Source, level: int) -> tuple[Tensor, Tensor]:
    """Rotation-like (3, 3) and translation (3,) that carry (x, y, 1) * depth of the reference into the source."""
    scale = torch.diag(torch.tensor([0.5**level, 0.5**level, 1.0], dtype=torch.float64))
    K_reference, K_source = scale @ reference.K.double(), scale @ source.K.double()
    motion = source.T_camera_world.double() @ torch.linalg.inv(reference.T_camera_world.double())
    return (
        (K_source @ motion[:3, :3] @ torch.linalg.inv(K_reference)).float(),
        (K_source @ motion[:3, 3]).float(),
    )


def warp_features(features: Tensor, warp: tuple[Tensor, Tensor], depths: Tensor) -> Tensor:
    """(C, D, h, w): the source's features (C, h', w') where the reference's pixels lie at `depths` (D, h, w)."""
    count, height, width = depths.shape
    rows, columns = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)])
    rays = torch.einsum("ij,jhw->ihw", warp[0], pixels)
    projected = rays[:, None] * depths[None] + warp[1].view(3, 1, 1, 1)
    behind = projected[2] <= 1e-3
    z = torch.where(behind, 1.0, projected[2])
    x = torch.where(behind, float(width), projected[0]) / z
    y = torch.where(behind, float(height), projected[1]) / z
    there_height, there_width = features.shape[1:]
    grid = torch.stack([x / ((there_width - 1) / 2) - 1, y / ((there_height - 1) / 2) - 1], -1)
    flat = grid.reshape(1, count * height, width, 2)
    sampled = functional.grid_sample(features[None], flat, mode="bilinear", padding_mode="zeros", align_corners=True)
    return sampled[0].unflatten(1, (count, height))


# PatchmatchNet's scores: how well the sources' features, warped at a depth, agree with the reference's.

_MIN_WEIGHT = 1e-5  # of all sources together: a pixel that none is believed at is divided by it


class Evaluation(nn.Module):
    """Scores depths by the group-wise correlation of features, averaged over sources and neighbours."""

    def __init__(self, groups: int) -> None:
        super().__init__()
        self._groups = groups
        self.pixel_wise_net = _ViewWeight(groups)
        self.similarity_net = SimilarityNet(groups)

    def forward(
        self,
        own: Tensor,
        others: Sequence[Tensor],
        warps: Sequence[tuple[Tensor, Tensor]],
        samples: Tensor,
        around: Tensor,
        support: Tensor,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Scores (D, h, w) of the depths `samples` (D, h, w), and the sources' weights (S, h, w).

        `own` (C, h, w) are the reference's features, `others` the sources', each with its warp; `around` (9, h, w, 2)
        are the neighbours whose scores support a pixel's, by `support` (D, 9, h, w). `weights` are those of an earlier
        call, None at first: they are found once, then kept.
        """
        groups = self._groups
        total = samples.new_full((1, 1, *samples.shape[1:]), _MIN_WEIGHT)
        summed = samples.new_zeros((groups, *samples.shape))
        reference = own.unflatten(0, (groups, -1))[:, :, None]
        found = []
        for index, (other, warp) in enumerate(zip(others, warps, strict=True)):
            warped = warp_features(other, warp, samples).unflatten(0, (groups, -1))
            similarity = (warped * reference).mean(1)  # (G, D, h, w)
            weight = self.pixel_wise_net(similarity) if weights is None else weights[index]
            found.append(weight)
            summed = summed + similarity * weight
            total = total + weight
        scores = self.similarity_net(summed / total)
        scores = (sample_neighbours(scores, around) * support).sum(1)
        return scores, torch.stack(found)


class SimilarityNet(nn.Module):
    """A score from the correlations of each group of channels."""

    def __init__(self, groups: int) -> None:
        super().__init__()
        self.conv0, self.conv1 = _PointwiseNormRelu(groups, 16), _PointwiseNormRelu(16, 8)
        self.similarity = nn.Conv3d(8, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.similarity(self.conv1(self.conv0(x[None])))[0, 0]


class _ViewWeight(nn.Module):
    """How far a source is to be believed at a pixel: as far as its best sample is."""

    def __init__(self, groups: int) -> None:
        super().__init__()
        self.conv0, self.conv1 = _PointwiseNormRelu(groups, 16), _PointwiseNormRelu(16, 8)
        self.conv2 = nn.Conv3d(8, 1, 1)

    def forward(self, similarity: Tensor) -> Tensor:
        return self.conv2(self.conv1(self.conv0(similarity[None])))[0, 0].sigmoid().amax(0)


class _PointwiseNormRelu(nn.Module):
    """Convolution, batch norm and ReLU of every sample and pixel by itself."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(channels, out, 1, bias=False)
        self.bn = nn.BatchNorm3d(out)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(x)))


_FIRST_SAMPLES = 48  # depths over the whole range, before there is an estimate


@dataclass(frozen=True)
class PatchmatchStage:
    """The settings that the checkpoint was trained with, for features at 2^-level of the image."""

    level: int
    channels: int
    groups: int  # of channels whose correlation is kept apart
    iterations: int
    samples: int  # depths around the last estimate
    neighbours: int  # whose estimates are tried too
    dilation: int  # distance of neighbours, pixels
    interval: float  # between samples, in parts of the range of inverse depth


STAGES = (
    PatchmatchStage(3, 64, 8, 2, 16, 16, 2, 0.025),
    PatchmatchStage(2, 32, 8, 2, 8, 8, 4, 0.0125),
    PatchmatchStage(1, 16, 4, 1, 8, 0, 6, 0.005),
)


class PatchmatchNet(nn.Module):
    """The whole network: features, three stages of PatchMatch from coarse to fine, and a refinement."""

    def __init__(self) -> None:
        super().__init__()
        self.feature = FeaturePyramid()
        self.patchmatch_3, self.patchmatch_2, self.patchmatch_1 = (_Patchmatch(stage) for stage in STAGES)
        self.upsample_net = Refinement()

    def forward(
        self, reference: Source, sources: Sequence[Source], near_far: tuple[float, float], generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """(H, W) depth in the reference's camera, and (H, W) confidence in [0, 1], for depths in `near_far`.

        The first depths are drawn from `generator`.
        """
        features = [self.feature(view.image) for view in (reference, *sources)]
        estimate: _Estimate | None = None
        for patchmatch in (self.patchmatch_3, self.patchmatch_2, self.patchmatch_1):
            level = patchmatch.stage.level
            warps = [compute_warp(reference, source, level) for source in sources]
            own, *others = (layers[level] for layers in features)
            finer = None if estimate is None else estimate.upsample()
            estimate = patchmatch(own, others, warps, near_far, finer, generator)
        assert estimate is not None
        depth = self.upsample_net(reference.image, estimate.depth, near_far)
        confidence = _confidence(estimate.probability)
        return depth, functional.interpolate(confidence[None, None], size=depth.shape, mode="nearest")[0, 0]


@dataclass(frozen=True, eq=False)
class _Estimate:
    """A stage's estimate for every pixel of the reference, at the stage's size."""

    depth: Tensor  # (h, w)
    probability: Tensor  # (D, h, w) of the samples that the depth was made of
    weights: Tensor  # (S, h, w) how far each source is to be believed

    def upsample(self) -> _Estimate:
        """Depth and weights at twice the size, for the next stage."""
        depth = functional.interpolate(self.depth[None, None], scale_factor=2.0, mode="nearest")[0, 0]
        weights = functional.interpolate(self.weights[None], scale_factor=2.0, mode="nearest")[0]
        return _Estimate(depth, self.probability, weights)


class _Patchmatch(nn.Module):
    """One stage: proposes depths around the last estimate, scores them, and takes their mean by score."""

    def __init__(self, stage: PatchmatchStage) -> None:
        super().__init__()
        self.stage = stage
        # The finest stage proposes nothing from neighbours; the checkpoint holds a convolution for one all the same.
        self.propa_conv = _make_offset_conv(stage, max(2 * stage.neighbours, 1))
        self.eval_conv = _make_offset_conv(stage, 2 * 9)
        self.feature_weight_net = SimilarityNet(stage.groups)
        self.evaluation = Evaluation(stage.groups)

    def forward(
        self,
        own: Tensor,
        others: Sequence[Tensor],
        warps: Sequence[tuple[Tensor, Tensor]],
        near_far: tuple[float, float],
        estimate: _Estimate | None,
        generator: torch.Generator,
    ) -> _Estimate:
        """The estimate from the reference's features `own` (C, h, w), the sources' `others`, and the last estimate."""
        stage = self.stage
        around = make_sampling_grid(self.eval_conv(own[None])[0], make_square_steps(stage.dilation - 1, centre=True))
        ring = make_square_steps(stage.dilation)
        ring = ring + [(2 * down, 2 * right) for down, right in ring] if stage.neighbours == 16 else ring
        propagated = make_sampling_grid(self.propa_conv(own[None])[0], ring) if stage.neighbours else None
        alike = self._compute_similarity(own, around)
        for iteration in range(stage.iterations):
            samples = self._propose_depths(
                None if estimate is None else estimate.depth, own.shape[1:], near_far, generator
            )
            if propagated is not None:
                middle = samples[samples.shape[0] // 2]
                samples = torch.cat([samples, sample_neighbours(middle[None], propagated)[0]]).sort(0).values
            support = self._compute_nearness(samples, around, near_far) * alike
            support = support / support.sum(1, keepdim=True)
            known = None if estimate is None else estimate.weights
            scores, weights = self.evaluation(own, others, warps, samples, around, support, known)
            probability = scores.softmax(0)
            last_of_all = stage.level == 1 and iteration == stage.iterations - 1
            depth = _compute_expected_depth(samples, probability) if last_of_all else (samples * probability).sum(0)
            estimate = _Estimate(depth, probability, weights)
        assert estimate is not None  # every stage has an iteration
        return estimate

    def _propose_depths(
        self, depth: Tensor | None, size: torch.Size, near_far: tuple[float, float], generator: torch.Generator
    ) -> Tensor:
        """(D, h, w) depths: evenly in inverse depth, over the range or around the last estimate."""
        farthest, nearest = 1.0 / near_far[1], 1.0 / near_far[0]
        if depth is None:
            jitter = torch.rand((1, _FIRST_SAMPLES, *size), generator=generator)[0]
            steps = jitter + torch.arange(_FIRST_SAMPLES).view(-1, 1, 1)
            return 1.0 / (farthest + steps / _FIRST_SAMPLES * (nearest - farthest))
        half = self.stage.samples // 2
        steps = torch.arange(-half, half, dtype=depth.dtype).view(-1, 1, 1)
        around = 1.0 / depth[None] + (nearest - farthest) * self.stage.interval * steps
        return 1.0 / around.clamp(farthest, nearest)

    def _compute_similarity(self, own: Tensor, around: Tensor) -> Tensor:
        """(9, h, w) how much each neighbour looks like the pixel itself: one that does lies on the same surface."""
        groups = self.stage.groups
        neighbours = sample_neighbours(own, around).unflatten(0, (groups, -1))  # (G, C / G, 9, h, w)
        product = (neighbours * own.unflatten(0, (groups, -1))[:, :, None]).mean(1)
        return self.feature_weight_net(product).sigmoid()

    def _compute_nearness(self, samples: Tensor, around: Tensor, near_far: tuple[float, float]) -> Tensor:
        """(D, 9, h, w) how near each neighbour's depths are to the pixel's own."""
        farthest, nearest = 1.0 / near_far[1], 1.0 / near_far[0]
        place = (1.0 / samples - farthest) / (nearest - farthest)
        gap = (sample_neighbours(place, around) - place[:, None]).abs() / self.stage.interval
        return torch.sigmoid(4.0 - 2.0 * gap.clamp(0, 4))


def _make_offset_conv(stage: PatchmatchStage, out: int) -> nn.Conv2d:
    return nn.Conv2d(stage.channels, out, 3, padding=stage.dilation, dilation=stage.dilation)


def _compute_expected_depth(samples: Tensor, probability: Tensor) -> Tensor:
    """(h, w) depth at the expected place among samples (D, h, w) that are even in inverse depth."""
    last = samples.shape[0] - 1
    place = (torch.arange(last + 1.0).view(-1, 1, 1) * probability).sum(0) / last
    first, end = 1.0 / samples[0], 1.0 / samples[-1]
    return 1.0 / (first + place * (end - first))


def _confidence(probability: Tensor) -> Tensor:
    """(h, w): the probability (D, h, w) of the expected sample and its neighbours, one before and two after."""
    count = probability.shape[0]
    four = functional.avg_pool1d(functional.pad(probability.permute(1, 2, 0), (1, 2)), 4, stride=1) * 4
    index = (torch.arange(float(count)).view(-1, 1, 1) * probability).sum(0).long().clamp(0, count - 1)
    return four.gather(2, index[..., None])[..., 0]


Float32 = npt.NDArray[np.float32]

_STRIDE = 8  # sides of the network's images are multiples of it
_STEP = 0.05  # relative change of inverse depth from pixel to pixel from which on two surfaces meet


@dataclass(frozen=True, eq=False)
class NetworkStereo:
    """`stereo.depth_maps` with a network in place of the search for planes."""

    network: PatchmatchNet

    @torch.inference_mode()
    def estimate_depth_maps(
        self,
        views: Sequence[StereoView],
        config: stereo.StereoConfig,
        *,
        seed: int = 0,
        sparse: Sequence[SparsePoints | None] | None = None,
        run: RunContext = BACKGROUND,
    ) -> list[DepthMap]:
        """A depth map for every view, in order. A view that overlaps with no other comes back without any depth.

        The cross-check gives confidence and normals, and leaves out what no other view confirms.
        """
        levels = [make_level(view.image, view.K, view.T_world_camera, view.depth_range, 0) for view in views]
        images = [_make_source(view) for view in views]
        planes, checked = [], []
        for index, view in enumerate(views):
            run.pause()
            points = None if sparse is None else sparse[index]
            partners = stereo.rank_partners(views, index, config, points)
            checked.append(stereo.select_check_views(partners, config))
            chosen = stereo.select_sources(partners, config)
            inverse_depth = np.zeros(view.image.shape[:2], np.float32)
            if chosen:
                generator = torch.Generator().manual_seed(seed)
                others = [images[other] for other in chosen]
                depth, _ = self.network(images[index], others, view.depth_range, generator)
                found = _resize_depth(depth.clamp(*view.depth_range).numpy(), view.image)
                inverse_depth = np.reciprocal(found, dtype=np.float32)
            planes.append(_make_planes(inverse_depth))
        return stereo.cross_check(levels, planes, checked, config.matching, config.consistency)


def _make_source(view: StereoView) -> Source:
    """The view at a size that fits the network, pixel centres at whole numbers."""
    height, width = (max(1, round(side / _STRIDE)) * _STRIDE for side in view.image.shape[:2])
    image = view.image
    if (height, width) != image.shape[:2]:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    K = np.diag([width / view.image.shape[1], height / view.image.shape[0], 1.0]) @ view.K
    K[:2, 2] -= 0.5
    return Source(
        torch.from_numpy(image).permute(2, 0, 1).float() / 255.0,
        torch.from_numpy(K),
        torch.from_numpy(np.linalg.inv(view.T_world_camera)),
    )


def _resize_depth(depth: Float32, image: npt.NDArray[np.uint8]) -> Float32:
    height, width = image.shape[:2]
    if depth.shape == (height, width):
        return depth
    return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def _make_planes(inverse_depth: Float32) -> Planes:
    """The depth map as planes: each pixel's slope is that to its nearer neighbour on either side."""
    slopes = [_slope(inverse_depth, axis) for axis in (1, 0)]
    return Planes(np.stack([inverse_depth, *slopes], -1), np.zeros_like(inverse_depth))


def _slope(inverse_depth: Float32, axis: int) -> Float32:
    """Change per pixel along `axis`: of the changes to both sides the mean of those that are no steps, or 0."""
    along = np.moveaxis(inverse_depth, axis, -1)
    change = np.diff(along)
    smooth = np.abs(change) < _STEP * np.minimum(along[:, 1:], along[:, :-1])
    change = np.where(smooth, change, 0)
    total = np.pad(change, ((0, 0), (1, 0))) + np.pad(change, ((0, 0), (0, 1)))
    count = np.pad(smooth, ((0, 0), (1, 0))) * 1 + np.pad(smooth, ((0, 0), (0, 1)))
    return np.moveaxis(total / np.maximum(count, 1), -1, axis).astype(np.float32)


WEIGHTS = ("patchmatchnet/patchmatchnet_dtu.pth",)


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not PatchmatchNet's."""
    return ClassicalPrior(config, NetworkStereo(load_network(config.weights or find(*WEIGHTS))).estimate_depth_maps)


def load_network(path: Path) -> PatchmatchNet:
    """Raises ValueError where the file is damaged or another network's, and FileNotFoundError."""
    return networks.load_network(PatchmatchNet, networks.read_weights(path), path, "PatchmatchNet")
