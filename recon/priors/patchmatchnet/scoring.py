"""PatchmatchNet's scores: how well the sources' features, warped at a depth, agree with the reference's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from splatnode.recon.priors.patchmatchnet.sampling import sample_neighbours, warp_features

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
