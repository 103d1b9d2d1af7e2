"""ALIKED: maps of features and of keypoint scores, then descriptors of the best keypoints, and their matches.

"ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation" (Zhao et al. 2023),
section III. Parameters are called as in the authors' checkpoints. Its keypoints are added to a keyframe's points, which
its matches then name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from splatnode.capture.frame import Frame
from splatnode.capture.process.config import Internal
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.networks import find, load_network, read_weights
from splatnode.recon.networks.vit import crop, crop_image
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

# Deformable sampling: a convolution and a descriptor whose samples are shifted by what they see.


def sample_maps(maps: Tensor, positions: Tensor) -> Tensor:
    """(C, ...): maps (C, H, W) at positions (..., 2), x and y in pixels from the first one's centre; 0 outside."""
    size = positions.new_tensor([maps.shape[2], maps.shape[1]])
    grid = ((2.0 * positions + 1.0) / size - 1.0).reshape(1, 1, -1, 2)
    found = F.grid_sample(maps[None], grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return found.reshape(len(maps), *positions.shape[:-1])


def make_window(size: int) -> Tensor:
    """(size * size, 2): x and y of a window's pixels from its middle, row by row."""
    steps = torch.arange(size) - size // 2
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def _clamp_shifts(shifts: Tensor, height: int, width: int) -> Tensor:
    """Shifts that reach over at most a quarter of the longer side, as in training."""
    most = max(height, width) / 4.0
    return shifts.clamp(-most, most)


class DeformableConv(nn.Module):
    """A 3 x 3 convolution, each of whose nine samples is shifted (Dai et al. 2017, equation 2). Zero outside."""

    SIZE = 3

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(channels, 2 * self.SIZE**2, self.SIZE, padding=1)
        self.regular_conv = nn.Conv2d(channels, out_channels, self.SIZE, padding=1, bias=False)

    def forward(self, maps: Tensor) -> Tensor:
        """(1, C, H, W) to (1, C', H, W)."""
        height, width = maps.shape[2:]
        shifts = _clamp_shifts(self.offset_conv(maps)[0], height, width)
        shifts = shifts.reshape(-1, 2, height, width).permute(0, 2, 3, 1).flip(-1)  # y comes first
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        unshifted = torch.stack([x, y], -1) + make_window(self.SIZE)[:, None, None]  # (9, H, W, 2)
        samples = sample_maps(maps[0], unshifted + shifts)
        weight = self.regular_conv.weight
        return torch.einsum("ocs,cshw->ohw", weight.flatten(2), samples)[None]


class DeformableDescriptor(nn.Module):
    """The sparse deformable descriptor head (section III-C): sixteen samples around a keypoint, placed by its patch."""

    SIZE, SAMPLES = 3, 16

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.offset_conv = nn.Sequential(
            nn.Conv2d(channels, 2 * self.SAMPLES, self.SIZE),
            nn.SELU(),
            nn.Conv2d(2 * self.SAMPLES, 2 * self.SAMPLES, 1),
        )
        self.sf_conv = nn.Conv2d(channels, channels, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.empty(self.SAMPLES, channels, channels))

    def forward(self, features: Tensor, positions: Tensor) -> Tensor:
        """(M, C) descriptors of unit length: features (C, H, W) at positions (M, 2) in pixels from the first one's."""
        height, width = features.shape[1:]
        patches = sample_maps(features, positions.floor()[:, None] + make_window(self.SIZE).to(positions))
        patches = patches.permute(1, 0, 2).reshape(len(positions), -1, self.SIZE, self.SIZE)
        shifts = _clamp_shifts(self.offset_conv(patches), height, width).reshape(
            -1, 2, self.SAMPLES
        )  # all x, then all y
        samples = sample_maps(features, positions[:, None] + shifts.transpose(1, 2))
        seen = F.selu(self.sf_conv(samples[None])[0])
        return F.normalize(torch.einsum("cms,scd->md", seen, self.agg_weights), dim=1)


# Keypoints of a map of scores, between its pixels (Zhao et al. 2022, ALIKE, section III-B).

_REACH = 2  # pixels: no two keypoints are as close, and the place of one is measured within it
_MIN_SCORE = 0.2  # of a keypoint, in [0, 1], as published
_TEMPERATURE = 0.1  # of scores, as in training


def detect_keypoints(scores: Tensor, count: int) -> Tensor:
    """(M, 2) x and y of the `count` best maxima of scores (H, W), from the first pixel's centre, the best first.

    A maximum lies at the mean place of the pixels around it, weighed by their scores.
    """
    size = 2 * _REACH + 1
    highest = F.max_pool2d(scores[None, None], size, stride=1, padding=_REACH)[0, 0]
    inner = (slice(_REACH, -_REACH),) * 2  # where all of the window is in the image
    row, column = ((scores == highest) & (scores > _MIN_SCORE))[inner].nonzero(as_tuple=True)
    best = scores[inner][row, column].argsort(descending=True, stable=True)[:count]
    peaks = torch.stack([column[best], row[best]], -1) + _REACH
    around = make_window(size)
    x, y = (peaks[:, None] + around).unbind(-1)
    weights = torch.softmax(scores[y, x] / _TEMPERATURE, dim=1)
    return peaks + weights @ around.to(weights)


STRIDE = 32  # of the coarsest features: an image has sides that this divides
_STRIDES = (1, 2, 8, STRIDE)
_N16 = 16  # width of the N16 network


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The best keypoints of an image, the best first."""

    points: Tensor  # (M, 2) pixels, top-left pixel centre at (0.5, 0.5)
    descriptors: Tensor  # (M, C) of unit length


class Aliked(nn.Module):
    """N16 has `width` 16, T16 8: channels at full size, which double at each coarser size."""

    def __init__(self, width: int = _N16) -> None:
        super().__init__()
        widths = [width << level for level in range(4)]
        channels = widths[-1]  # of descriptors
        self.block1 = _Block(3, widths[0], deformable=False)
        self.block2 = _ResidualBlock(widths[0], widths[1], deformable=False)
        self.block3 = _ResidualBlock(widths[1], widths[2], deformable=True)
        self.block4 = _ResidualBlock(widths[2], widths[3], deformable=True)
        self.conv1, self.conv2, self.conv3, self.conv4 = (_conv(each, channels // 4, 1) for each in widths)
        self.score_head = nn.Sequential(
            _conv(channels, 8, 1), nn.SELU(), _conv(8, 4, 3), nn.SELU(), _conv(4, 4, 3), nn.SELU(), _conv(4, 1, 3)
        )
        self.desc_head = DeformableDescriptor(channels)

    def compute_maps(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Features (C, H, W) of unit length, and scores (H, W) from 0 to 1, of an RGB image (3, H, W) in [0, 1].

        Raises ValueError where the image's sides are no multiples of STRIDE.
        """
        if image.ndim != 3 or len(image) != 3 or image.shape[1] % STRIDE or image.shape[2] % STRIDE:
            raise ValueError(f"image must be (3, H, W) with sides that {STRIDE} divides, got {tuple(image.shape)}")
        size = image.shape[1:]
        levels = [self.block1(image[None])]
        for block, finer, coarser in zip((self.block2, self.block3, self.block4), _STRIDES, _STRIDES[1:], strict=False):
            levels.append(block(F.avg_pool2d(levels[-1], coarser // finer)))
        reduced = [
            F.selu(conv(level))
            for conv, level in zip((self.conv1, self.conv2, self.conv3, self.conv4), levels, strict=True)
        ]
        together = torch.cat(
            [reduced[0], *(F.interpolate(each, size, mode="bilinear", align_corners=True) for each in reduced[1:])], 1
        )
        scores = torch.sigmoid(self.score_head(together))
        return F.normalize(together, dim=1)[0], scores[0, 0]

    def forward(self, image: Tensor, count: int) -> Keypoints:
        """At most `count` keypoints of an image as `compute_maps` takes it."""
        features, scores = self.compute_maps(image)
        positions = detect_keypoints(scores, count)
        return Keypoints(positions + 0.5, self.desc_head(features, positions))


class _Block(nn.Module):
    """Two convolutions of 3 x 3, each with its normalisation."""

    def __init__(self, channels: int, out_channels: int, deformable: bool) -> None:
        super().__init__()
        conv = DeformableConv if deformable else _conv
        self.conv1, self.bn1 = conv(channels, out_channels), nn.BatchNorm2d(out_channels)
        self.conv2, self.bn2 = conv(out_channels, out_channels), nn.BatchNorm2d(out_channels)

    def forward(self, maps: Tensor) -> Tensor:
        return F.selu(self._convolve(maps))

    def _convolve(self, maps: Tensor) -> Tensor:
        return self.bn2(self.conv2(F.selu(self.bn1(self.conv1(maps)))))


class _ResidualBlock(_Block):
    """They are added to what came in, brought to their width."""

    def __init__(self, channels: int, out_channels: int, deformable: bool) -> None:
        super().__init__(channels, out_channels, deformable)
        self.downsample = nn.Conv2d(channels, out_channels, 1)

    def forward(self, maps: Tensor) -> Tensor:
        return F.selu(self._convolve(maps) + self.downsample(maps))


def _conv(channels: int, out_channels: int, size: int = 3) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, size, padding=size // 2, bias=False)


def load_aliked(path: Path) -> Aliked:
    """Raises FileNotFoundError, or ValueError where the file is damaged or not the checkpoint of N16 or T16."""
    weights = read_weights(path)
    first = weights.get("block1.conv1.weight")
    small = first is not None and len(first) == _N16 // 2
    width, name = (_N16 // 2, "ALIKED T16") if small else (_N16, "ALIKED N16")
    return load_network(lambda: Aliked(width), weights, path, name)


class AlikedMatcher:
    """A `recon.matching.view_graph.Matcher`. The keypoints of a keyframe are its last points."""

    def __init__(self, network: Aliked, longer_side: int, num_keypoints: int) -> None:
        self._network, self._longer_side, self._count = network, longer_side, num_keypoints
        self._found: WeakKeyDictionary[Frame, Keypoints] = WeakKeyDictionary()

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        features, mine = keyframe.features, self._find_keypoints(keyframe).points.numpy()
        if len(mine) == 0 or np.array_equal(features.points[-len(mine) :], mine):
            return keyframe
        return replace(keyframe, features=replace(features, points=np.concatenate([features.points, mine])))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self._find_keypoints(keyframe1), self._find_keypoints(keyframe2)
        added = [
            len(keyframe.features.points) - len(found.points)
            for keyframe, found in ((keyframe1, first), (keyframe2, second))
        ]
        return match_mutual(first.descriptors, second.descriptors).numpy() + np.array(added)

    def _find_keypoints(self, keyframe: Keyframe) -> Keypoints:
        frame = keyframe.frame
        if frame not in self._found:
            self._found[frame] = self._extract_keypoints(frame.image)
        return self._found[frame]

    @torch.inference_mode()
    def _extract_keypoints(self, image: npt.NDArray[np.uint8]) -> Keypoints:
        """In pixels of an image (H, W, 3)."""
        height, width = image.shape[:2]
        to = crop(width, height, min(self._longer_side, max(width, height)), STRIDE)
        found = self._network(crop_image(image, to).permute(2, 0, 1), self._count)
        return replace(found, points=torch.from_numpy(to.map_to_image(found.points.double().numpy())))


def match_mutual(descriptors1: Tensor, descriptors2: Tensor) -> Tensor:
    """(M, 2) indices of descriptors (*, C) of unit length that are each other's nearest, the most distinct first.

    A match is the more distinct the nearer it is compared with the second-nearest.
    """
    if min(len(descriptors1), len(descriptors2)) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    alike = descriptors1 @ descriptors2.T
    best, nearest = alike.topk(2, dim=1)
    forth, back = nearest[:, 0], alike.argmax(0)
    (chosen,) = (back[forth] == torch.arange(len(forth))).nonzero(as_tuple=True)
    squared = (1.0 - best[chosen]).clamp_min(1e-12)
    order = (squared[:, 0] / squared[:, 1]).argsort(stable=True)
    return torch.stack([chosen, forth[chosen]], 1)[order]


WEIGHTS = ("aliked/aliked-n16.pth",)


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of N16 or T16; None: N16's, where `splatnode weights` puts them
    longer_side: Internal[int] = 800  # of the network's images, pixels; none is enlarged
    num_keypoints: Internal[int] = 2000  # of an image, at most


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not ALIKED N16's or T16's."""
    network = load_aliked(config.weights or find(*WEIGHTS))
    return ClassicalPrior(config, matcher=AlikedMatcher(network, config.longer_side, config.num_keypoints))
