"""PatchmatchNet: the depth of a photograph from others with known cameras, searched from coarse to fine.

"PatchmatchNet: Learned Multi-View Patchmatch Stereo" (Wang et al. 2021). Each stage proposes depths for every pixel
(at first all over the range, then around the last estimate and from learned neighbours), warps the sources' features
at these depths, and scores them; three networks learn where to look, which source to believe and how alike features
have to be. Written from the paper; modules carry the names of the published checkpoint. Pixel centres are at whole
numbers in this folder's network, sampling and scoring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon.priors.patchmatchnet.pyramid import FeaturePyramid, Refinement
from splatnode.recon.priors.patchmatchnet.sampling import (
    Source,
    compute_warp,
    make_sampling_grid,
    make_square_steps,
    sample_neighbours,
)
from splatnode.recon.priors.patchmatchnet.scoring import Evaluation, SimilarityNet

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
