"""MASt3R (Leroy et al. 2024), the paper's prior: matches and depth from a network, for non-commercial use.

The network takes two photographs and gives for each a point map in the first one's frame, confidences and descriptors.
"Grounding Image Matching in 3D with MASt3R" (Leroy et al. 2024) stands on "DUSt3R" (Wang et al. 2024) and "CroCo v2"
(Weinzaepfel et al. 2023): a ViT encodes each image, two decoders look at their own and at the other's tokens, and each
image's head gives points, confidence and descriptors. Written from the papers; modules carry the names of the official
checkpoint.

Matches come by its descriptors, depth by global alignment, which brings the point maps of many pairs into one frame:
cameras, focal lengths and one depth map for each view. Each ordered pair (i, j) gives the points of both images in
camera i's frame, at a scale of its own, and some pairs are wrong. For each view the pairs that it is first in are
joined into one depth map; what a pair says about its second image, held against that image's own depth map, is a
similarity between the two views; the similarities that most others agree with start a robust fit of all views
together. This is the global alignment of DUSt3R (section 3.4) with one similarity a view instead of one free depth a
pixel: few unknowns, so seconds become fractions.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional

from splatnode.capture.process.config import Internal
from splatnode.recon import networks
from splatnode.recon.geometry import Similarity
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks import LruCache, find
from splatnode.recon.networks.depth_anything import Fusion
from splatnode.recon.networks.vit import (
    Attention,
    Block,
    Crop,
    Mlp,
    PatchEmbedding,
    Rotary,
    attend,
    crop,
    crop_image,
    grid_positions,
    split_heads,
)
from splatnode.recon.priors import Pointmap, Prior, make_registered_pointmap
from splatnode.recon.registration.registration import Registration
from splatnode.recon.threads import BACKGROUND, RunContext

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

_SAMPLES = 400  # points of a pair that take part: similarities have seven unknowns
_NUM_TREES = 60  # random spanning trees that are tried as a start
_TREE_SPREAD = 0.7  # standard deviation of the logarithm of the factors that shuffle the pairs between trees
_AGREEMENT = 0.1  # of the depth: a pair and a start agree where the pair's median point is that near
_ROBUST = 0.02  # of the depth: scale of the robust weights
_MIN_DEPTH = 1e-6  # of a point before its camera, in the pair's unit
_MIN_WEIGHT = 1e-3  # of a point of the least confidence, whose logarithm is 0
_FOCAL_ITERATIONS, _MIN_OFFSET_PX = 10, 1e-3  # of Weiszfeld's algorithm; pixels: nearer points weigh no more
_FIT_ITERATIONS = 8  # of a similarity's reweighting
_CONVERGED = 1e-7  # largest step of the joint fit, radians and world units, at which it ends
_MAX_LOG_SCALE_STEP = 0.5  # of one step of the joint fit


@dataclass(frozen=True, eq=False)
class PairPoints:
    """The network's points of an ordered pair, in the frame and at the scale of its own first camera."""

    first: Map  # (H, W, 3) points of the first image
    first_confidence: Map  # (H, W), from 1
    second: Map  # (H', W', 3) points of the second image
    second_confidence: Map


@dataclass(frozen=True, eq=False)
class AlignedView:
    """A view after global alignment."""

    T_world_camera: Array  # (4, 4)
    focal: float  # pixels; the principal point is the image's centre
    depth: Map  # (H, W) z in the camera frame, in units of the world
    confidence: Map  # (H, W), mean over the pairs, from 1
    residual: float  # median distance between what the pairs say and the world, relative to the depth


@dataclass(frozen=True, eq=False)
class _Edge:
    """Samples of the second view as the pair sees them (in the first's frame and unit), and in their own frame."""

    first: int
    second: int
    seen: Array  # (S, 3)
    own: Array  # (S, 3)
    weights: Array  # (S,)


def align_views(pairs: Mapping[tuple[int, int], PairPoints], *, shared_focal: bool = True) -> list[AlignedView]:
    """All views 0 .. N-1 that occur in `pairs`, in the frame of view 0, whose median depth becomes 1.

    Raises ValueError where the pairs do not connect all views, or a view is never first.
    """
    count = 1 + max(itertools.chain.from_iterable(pairs), default=-1)
    for view in range(count):
        if not any(i == view for i, _ in pairs):
            raise ValueError(f"view {view} must be the first of at least one pair: its own points come from there")
    focals = [_focal([pairs[i, j] for i, j in pairs if i == view]) for view in range(count)]
    if shared_focal:
        focals = [float(np.median(focals))] * count
    depths, confidences, units = [], [], {}
    for view in range(count):
        named = {pair: points for pair, points in pairs.items() if pair[0] == view}
        depth, confidence, scales = _merge_own_depth(list(named.values()))
        depths.append(depth)
        confidences.append(confidence)
        units |= dict(zip(named, scales, strict=True))
    edges = [_edge(pair, pairs[pair], units[pair], depths[pair[1]], focals[pair[1]]) for pair in pairs]
    similarities = _refine_similarities(_initialize_similarities(edges, count), edges)
    return _convert_to_first_frame(similarities, edges, focals, depths, confidences)


def _focal(pairs: Sequence[PairPoints]) -> float:
    """The focal length in pixels that best projects a view's own points onto their pixels: a geometric median."""
    ratios, offsets, weights = [], [], []
    for pair in pairs:
        height, width, _ = pair.first.shape
        u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
        good = pair.first[..., 2] > _MIN_DEPTH
        ratios.append(pair.first[good][:, :2] / pair.first[good][:, 2:])
        offsets.append(np.stack([u[good], v[good]], -1))
        weights.append(np.log(pair.first_confidence[good]) + _MIN_WEIGHT)
    ray, pixel, weight = (np.concatenate(parts).astype(np.float64) for parts in (ratios, offsets, weights))
    if not len(ray):
        raise ValueError("a view has no point in front of its camera: its prediction cannot be used")
    focal = float((weight * (ray * pixel).sum(1)).sum() / max((weight * (ray * ray).sum(1)).sum(), 1e-12))
    for _ in range(_FOCAL_ITERATIONS):
        robust = weight / np.maximum(np.linalg.norm(pixel - focal * ray, axis=1), _MIN_OFFSET_PX)
        focal = float((robust * (ray * pixel).sum(1)).sum() / max((robust * (ray * ray).sum(1)).sum(), 1e-12))
    return focal


def _merge_own_depth(pairs: Sequence[PairPoints]) -> tuple[Map, Map, list[float]]:
    """A view's depth map from all pairs that it is first in, its confidence, and each pair's unit in that map's."""
    depths = np.stack([pair.first[..., 2] for pair in pairs])
    confidence = np.stack([pair.first_confidence for pair in pairs])
    best = int(confidence.mean((1, 2)).argmax())
    units = [_unit(depth, depths[best], confidence.mean(0)) for depth in depths]
    scaled = depths / np.array(units, np.float32)[:, None, None]
    return np.median(scaled, axis=0).astype(np.float32), confidence.mean(0).astype(np.float32), units


def _unit(depth: Map, reference: Map, confidence: Map) -> float:
    """Median ratio of two depth maps over the surer half of the pixels in front of both cameras."""
    both = (depth > _MIN_DEPTH) & (reference > _MIN_DEPTH)
    sure = both & (confidence >= np.median(confidence))
    chosen = sure if sure.any() else both
    return float(np.median(depth[chosen] / reference[chosen])) if chosen.any() else 1.0


def _edge(pair: tuple[int, int], points: PairPoints, unit: float, depth: Map, focal: float) -> _Edge:
    """Samples of the surer half of the second image's points, and of its own `depth` map at the same pixels."""
    height, width = depth.shape
    surest = np.argsort(-points.second_confidence, axis=None, kind="stable")[: height * width // 2]
    surest = surest[depth.ravel()[surest] > _MIN_DEPTH]
    chosen = surest[:: max(1, len(surest) // _SAMPLES)]
    row, column = np.divmod(chosen, width)
    z = depth.ravel()[chosen].astype(np.float64)
    own = np.stack([(column + 0.5 - width / 2) * z / focal, (row + 0.5 - height / 2) * z / focal, z], -1)
    seen = points.second.reshape(-1, 3)[chosen].astype(np.float64) / unit
    return _Edge(*pair, seen, own, np.log(points.second_confidence.ravel()[chosen]).astype(np.float64) + _MIN_WEIGHT)


_IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def _procrustes(source: Array, target: Array, weights: Array) -> Similarity:
    """The similarity that carries `source` (S, 3) onto `target`: weighted, and robust by reweighting."""
    fit, robust = _IDENTITY, weights
    for _ in range(_FIT_ITERATIONS):
        share = robust / robust.sum()
        mean_source, mean_target = share @ source, share @ target
        centred_source, centred_target = source - mean_source, target - mean_target
        u, singular, vt = np.linalg.svd((share[:, None] * centred_target).T @ centred_source)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ np.diag(signs) @ vt
        spread = float(share @ (centred_source**2).sum(1))
        scale = float((singular * signs).sum()) / max(spread, 1e-12)
        fit = Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)
        relative = np.linalg.norm(fit(source) - target, axis=1) / np.maximum(np.linalg.norm(target, axis=1), 1e-9)
        robust = weights / (1.0 + (relative / _ROBUST) ** 2)
    return fit


def _initialize_similarities(edges: Sequence[_Edge], count: int) -> list[Similarity]:
    """View-to-world similarities by the spanning tree of pairs that most other pairs agree with."""
    relative = [_procrustes(edge.own, edge.seen, edge.weights) for edge in edges]  # second's frame to first's
    errors = np.array([_error(edge, _IDENTITY, fit) for edge, fit in zip(edges, relative, strict=True)])
    rng = np.random.default_rng(0)
    best: tuple[float, list[Similarity]] | None = None
    for _ in range(_NUM_TREES):
        order = np.argsort(errors * rng.lognormal(0.0, _TREE_SPREAD, len(edges)), kind="stable")
        placed = _place_along_tree(order.tolist(), edges, relative, count)
        agreeing = sum(_error(edge, placed[edge.first], placed[edge.second]) < _AGREEMENT for edge in edges)
        spread = sum(min(_error(edge, placed[edge.first], placed[edge.second]), _AGREEMENT) for edge in edges)
        score = agreeing - spread / _AGREEMENT
        if best is None or score > best[0]:
            best = score, placed
    assert best is not None
    return best[1]


def _place_along_tree(
    order: Sequence[int], edges: Sequence[_Edge], relative: Sequence[Similarity], count: int
) -> list[Similarity]:
    """Every view placed from view 0 along the first edges in `order` that reach a new view."""
    placed: dict[int, Similarity] = {0: _IDENTITY}
    while len(placed) < count:
        for index in order:
            first, second = edges[index].first, edges[index].second
            if first in placed and second not in placed:
                placed[second] = placed[first].after(relative[index])
                break
            if second in placed and first not in placed:
                placed[first] = placed[second].after(relative[index].inverse())
                break
        else:
            raise ValueError(f"the pairs must connect all {count} views; views {sorted(placed)} stand alone")
    return [placed[view] for view in range(count)]


def _error(edge: _Edge, first: Similarity, second: Similarity) -> float:
    """Median distance of the pair's points from the second view's own, relative to their depth."""
    gap = np.linalg.norm(first(edge.seen) - second(edge.own), axis=1)
    return float(np.median(gap / np.maximum(second.scale * np.linalg.norm(edge.own, axis=1), 1e-12)))


def _refine_similarities(
    similarities: list[Similarity], edges: Sequence[_Edge], iterations: int = 15
) -> list[Similarity]:
    """All views together, by Gauss-Newton on the reweighted gaps of all pairs; view 0 stays.

    Geman-McClure weights: a wrong pair has hundreds of gaps far out, and Cauchy's would add up their pull to most of
    the error.
    """
    count = len(similarities)
    for _ in range(iterations):
        normal, gradient = np.zeros((7 * count, 7 * count)), np.zeros(7 * count)
        for edge in edges:
            first, second = similarities[edge.first], similarities[edge.second]
            there, here = first(edge.seen), second(edge.own)
            length = np.maximum(second.scale * np.linalg.norm(edge.own, axis=1), 1e-12)
            gap = (there - here) / length[:, None]
            weights = edge.weights / (1.0 + (gap**2).sum(1) / _ROBUST**2) ** 2 / edge.weights.sum()
            jacobian = (
                np.concatenate([_compute_jacobian(there, first), -_compute_jacobian(here, second)], axis=2)
                / length[:, None, None]
            )
            index = np.concatenate([7 * edge.first + np.arange(7), 7 * edge.second + np.arange(7)])
            weighted = weights[:, None, None] * jacobian
            normal[np.ix_(index, index)] += np.einsum("sri,srj->ij", weighted, jacobian)
            gradient[index] += np.einsum("sri,sr->i", weighted, gap)
        free = np.arange(7, 7 * count)
        damped = normal[np.ix_(free, free)] + 1e-9 * np.diag(np.diag(normal)[free]) + 1e-12 * np.eye(len(free))
        step = -np.linalg.solve(damped, gradient[free]).reshape(-1, 7)
        similarities = [similarities[0], *(_apply_step(s, d) for s, d in zip(similarities[1:], step, strict=True))]
        if np.abs(step).max() < _CONVERGED:
            break
    return similarities


def _compute_jacobian(points: Array, similarity: Similarity) -> Array:
    """(S, 3, 7) change of world points (S, 3) with rotation about, translation and log scale from their camera."""
    arm = points - similarity.translation
    change = np.zeros((len(points), 3, 7))
    change[:, 0, 1], change[:, 0, 2] = arm[:, 2], -arm[:, 1]
    change[:, 1, 0], change[:, 1, 2] = -arm[:, 2], arm[:, 0]
    change[:, 2, 0], change[:, 2, 1] = arm[:, 1], -arm[:, 0]
    change[:, :, 3:6] = np.eye(3)
    change[:, :, 6] = arm
    return change


def _apply_step(similarity: Similarity, step: npt.NDArray[np.floating]) -> Similarity:
    """The similarity after a `step` (7,) of the joint fit, in the order of `_compute_jacobian`."""
    rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ similarity.rotation
    growth = float(np.exp(np.clip(step[6], -_MAX_LOG_SCALE_STEP, _MAX_LOG_SCALE_STEP)))
    return Similarity(similarity.scale * growth, rotation, similarity.translation + step[3:6])


def _convert_to_first_frame(
    similarities: Sequence[Similarity],
    edges: Sequence[_Edge],
    focals: Sequence[float],
    depths: Sequence[Map],
    confidences: Sequence[Map],
) -> list[AlignedView]:
    """The views in the frame of view 0, whose median depth becomes 1."""
    ahead = depths[0][depths[0] > _MIN_DEPTH]
    unit = float(np.median(ahead)) if len(ahead) else 1.0
    views = []
    for view, similarity in enumerate(similarities):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = similarity.rotation
        T_world_camera[:3, 3] = similarity.translation / unit
        gaps = [_error(e, similarities[e.first], similarities[e.second]) for e in edges if view in (e.first, e.second)]
        depth = np.maximum(depths[view] * np.float32(similarity.scale / unit), 0)
        views.append(AlignedView(T_world_camera, focals[view], depth, confidences[view], float(np.median(gaps))))
    return views


# The dense prediction transformer's decoder: tokens of four layers, fused from coarse to fine into an image.
#
# "Vision Transformers for Dense Prediction" (Ranftl et al. 2021). Attributes carry the checkpoint's names.

_WIDTH = 256  # of the fused features
_LAYER_WIDTHS = (96, 192, 384, 768)


class DensePrediction(nn.Module):
    """From tokens of four layers to an image of `channels` at the size of the photograph."""

    def __init__(self, encoder_width: int, decoder_width: int, decoder_depth: int, channels: int) -> None:
        super().__init__()
        self._hooks = (0, decoder_depth // 2, decoder_depth * 3 // 4, decoder_depth)
        w1, w2, w3, w4 = _LAYER_WIDTHS
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(encoder_width, w1, 1), nn.ConvTranspose2d(w1, w1, 4, stride=4)),
                nn.Sequential(nn.Conv2d(decoder_width, w2, 1), nn.ConvTranspose2d(w2, w2, 2, stride=2)),
                nn.Sequential(nn.Conv2d(decoder_width, w3, 1)),
                nn.Sequential(nn.Conv2d(decoder_width, w4, 1), nn.Conv2d(w4, w4, 3, stride=2, padding=1)),
            ]
        )
        self.scratch = _Scratch()
        self.head = nn.Sequential(
            nn.Conv2d(_WIDTH, _WIDTH // 2, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(_WIDTH // 2, _WIDTH // 2, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(_WIDTH // 2, channels, 1),
        )

    def forward(self, layers: Sequence[Tensor], rows: int, columns: int) -> Tensor:
        """(channels, 16 rows, 16 columns) from the tokens (rows * columns, C) of every decoder layer.

        `layers` starts with the encoder's tokens.
        """
        images = [layers[hook].T.unflatten(1, (rows, columns))[None] for hook in self._hooks]
        images = [adapt(image) for adapt, image in zip(self.act_postprocess, images, strict=True)]
        images = [reduce(image) for reduce, image in zip(self.scratch.layer_rn, images, strict=True)]
        fused = self.scratch.refinenet4(images[3])[:, :, : images[2].shape[2], : images[2].shape[3]]
        fused = self.scratch.refinenet3(fused, images[2])
        fused = self.scratch.refinenet2(fused, images[1])
        fused = self.scratch.refinenet1(fused, images[0])
        return self.head(fused)[0]


class _Scratch(nn.Module):
    """Layers that fuse four feature maps at one width. The checkpoint names each `layer_rn` twice."""

    def __init__(self) -> None:
        super().__init__()
        reduce = [nn.Conv2d(width, _WIDTH, 3, padding=1, bias=False) for width in _LAYER_WIDTHS]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = reduce
        self.layer_rn = nn.ModuleList(reduce)
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (Fusion(_WIDTH) for _ in range(4))


@dataclass(frozen=True)
class Size:
    """Widths and depths. The defaults are those of the published ViT-Large."""

    encoder_width: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    decoder_width: int = 768
    decoder_depth: int = 12
    decoder_heads: int = 12
    patch: int = 16
    descriptor: int = 24


PUBLISHED = Size()


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image after the encoder. It serves every pair that the image is part of."""

    tokens: Tensor  # (h w, encoder_width) for h x w patches
    positions: Tensor  # (h w, 2) row and column of each patch
    height: int  # of the image, pixels
    width: int


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prediction for one image of a pair. Points are in the frame of the pair's first camera."""

    points: Tensor  # (H, W, 3), up to one scale for the pair
    confidence: Tensor  # (H, W), from 1
    descriptors: Tensor  # (H, W, D) of unit length
    descriptor_confidence: Tensor  # (H, W), from 0


class Mast3r(nn.Module):
    """Siamese encoder, two decoders that attend to each other, and a head for each image of a pair."""

    def __init__(self, size: Size = PUBLISHED) -> None:
        super().__init__()
        self.size = size
        encoder, decoder = size.encoder_width, size.decoder_width
        self.mask_token = nn.Parameter(torch.zeros(1, 1, decoder))  # of the pre-training; the checkpoint holds it
        self.patch_embed = PatchEmbedding(size.patch, encoder)
        self.enc_blocks = nn.ModuleList(Block(encoder, size.encoder_heads) for _ in range(size.encoder_depth))
        self.enc_norm = _norm(encoder)
        self.decoder_embed = nn.Linear(encoder, decoder)
        self.dec_blocks = nn.ModuleList(_DecoderBlock(decoder, size.decoder_heads) for _ in range(size.decoder_depth))
        self.dec_blocks2 = nn.ModuleList(_DecoderBlock(decoder, size.decoder_heads) for _ in range(size.decoder_depth))
        self.dec_norm = _norm(decoder)
        self.downstream_head1 = _Head(size)
        self.downstream_head2 = _Head(size)

    def encode(self, image: Tensor) -> EncodedImage:
        """`image` (3, H, W) in [-1, 1], its sides multiples of the patch."""
        _, height, width = image.shape
        patch = self.size.patch
        if image.shape[0] != 3 or height % patch or width % patch or not height * width:
            raise ValueError(f"image must be (3, H, W) with H and W multiples of {patch}, got {tuple(image.shape)}")
        positions = grid_positions(height // patch, width // patch).to(image.device)
        tokens = self.patch_embed(image[None])[0]
        rotary = Rotary.create_from_positions(positions, self.size.encoder_width // self.size.encoder_heads)
        for block in self.enc_blocks:
            tokens = block(tokens, rotary)
        return EncodedImage(self.enc_norm(tokens), positions, height, width)

    def decode(self, first: EncodedImage, second: EncodedImage) -> tuple[Prediction, Prediction]:
        """Predicts the first and the second image, both in the first camera's frame."""
        dimension = self.size.decoder_width // self.size.decoder_heads
        rotary1, rotary2 = (
            Rotary.create_from_positions(first.positions, dimension),
            Rotary.create_from_positions(second.positions, dimension),
        )
        tokens1, tokens2 = self.decoder_embed(first.tokens), self.decoder_embed(second.tokens)
        layers1, layers2 = [first.tokens], [second.tokens]
        for block1, block2 in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            # Both look at the other's tokens of the layer before.
            tokens1, tokens2 = (
                block1(tokens1, tokens2, rotary1, rotary2),
                block2(tokens2, tokens1, rotary2, rotary1),
            )
            layers1.append(tokens1)
            layers2.append(tokens2)
        layers1[-1], layers2[-1] = self.dec_norm(tokens1), self.dec_norm(tokens2)
        return (
            self.downstream_head1(layers1, first.height, first.width),
            self.downstream_head2(layers2, second.height, second.width),
        )


def load_network(path: Path, size: Size = PUBLISHED) -> Mast3r:
    """The network with the weights of `path`: the official file, a dict with `model` and `args`, or a safetensors file.

    Raises ValueError where the file is damaged, holds another model or anything but data, and FileNotFoundError.
    """
    return networks.load_network(partial(Mast3r, size), networks.read_weights(path), path, "MASt3R")


class _CrossAttention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self._heads = heads
        self.projq, self.projk, self.projv = (nn.Linear(width, width) for _ in range(3))
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, other: Tensor, rotary: Rotary, rotary_other: Rotary) -> Tensor:
        query = split_heads(self.projq(x), self._heads)
        key, value = split_heads(self.projk(other), self._heads), split_heads(self.projv(other), self._heads)
        return self.proj(attend(rotary.rotate(query), rotary_other.rotate(key), value))


class _DecoderBlock(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm3, self.norm_y = (_norm(width) for _ in range(4))
        self.attn = Attention(width, heads)
        self.cross_attn = _CrossAttention(width, heads)
        self.mlp = Mlp(width, 4 * width, width)

    def forward(self, x: Tensor, other: Tensor, rotary: Rotary, rotary_other: Rotary) -> Tensor:
        x = x + self.attn(self.norm1(x), rotary)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), rotary, rotary_other)
        return x + self.mlp(self.norm3(x))


class _Head(nn.Module):
    """Points and confidence from a dense prediction transformer, descriptors from an MLP on each patch."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        self._patch, self._descriptor = size.patch, size.descriptor
        self.dpt = DensePrediction(size.encoder_width, size.decoder_width, size.decoder_depth, channels=4)
        width = size.encoder_width + size.decoder_width
        self.head_local_features = Mlp(width, 4 * width, (size.descriptor + 1) * size.patch**2)

    def forward(self, layers: list[Tensor], height: int, width: int) -> Prediction:
        rows, columns = height // self._patch, width // self._patch
        dense = self.dpt(layers, rows, columns)
        local = self.head_local_features(torch.cat([layers[0], layers[-1]], dim=-1))
        local = functional.pixel_shuffle(local.T.unflatten(1, (rows, columns)), self._patch)
        return Prediction(
            points=_exponential_points(dense[:3].permute(1, 2, 0)),
            confidence=1.0 + dense[3].exp(),
            descriptors=functional.normalize(local[: self._descriptor].permute(1, 2, 0), dim=-1),
            descriptor_confidence=local[self._descriptor].exp(),
        )


def _exponential_points(raw: Tensor) -> Tensor:
    """(H, W, 3) points in the direction of `raw` (H, W, 3), at distance exp(|raw|) - 1."""
    length = raw.norm(dim=-1, keepdim=True)
    return raw / length.clamp_min(1e-8) * torch.expm1(length)


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=1e-6)


# Photographs through the network: every image is encoded once, every ordered pair decoded once.

PATCH = 16
_KEPT_IMAGES = 32  # in tokens: 100 MB
_KEPT_PAIRS = 160  # with their points, up to 1 GB: 13 frames have 156 ordered pairs


class Network(Protocol):
    """The interface of the prior's network; `Mast3r` implements it."""

    def encode(self, image: Tensor) -> EncodedImage:
        """An image as `prepare_image` gives it, after the encoder."""
        ...

    def decode(self, first: EncodedImage, second: EncodedImage) -> tuple[Prediction, Prediction]:
        """Predicts both images of the ordered pair, in the first camera's frame."""
        ...


class NetworkCache:
    """A cache of the network's predictions for images and pairs of them.

    An image in tokens takes 3 MB and the points of a pair 6 MB at full size; what was asked for lately is kept.
    """

    def __init__(self, network: Network, longer_side: int) -> None:
        self._network, self._longer_side = network, longer_side
        self._encoded: LruCache[str, EncodedImage] = LruCache(_KEPT_IMAGES)
        self._points: LruCache[tuple[str, str], PairPoints] = LruCache(_KEPT_PAIRS)

    def make_crop(self, keyframe: Keyframe) -> Crop:
        """How the keyframe's photograph is scaled and cut for the network."""
        return crop(keyframe.frame.width, keyframe.frame.height, self._longer_side, PATCH)

    @torch.inference_mode()
    def predict_pair(self, first: Keyframe, second: Keyframe) -> tuple[Prediction, Prediction]:
        """Predicts the first and the second image of the ordered pair, in the first camera's frame."""
        predictions = self._network.decode(self._encode(first), self._encode(second))
        self._points.get((first.name, second.name), lambda: _make_pair_points(*predictions))
        return predictions

    def predict_points(self, keyframes: Sequence[Keyframe], max_neighbours: int) -> dict[tuple[int, int], PairPoints]:
        """Predicts points of all ordered pairs at most `max_neighbours` places apart in a circle, by position."""
        count = len(keyframes)
        found = {}
        for i, j in itertools.permutations(range(count), 2):
            if min((i - j) % count, (j - i) % count) <= max_neighbours:
                first, second = keyframes[i], keyframes[j]
                asked = partial(self.predict_pair, first, second)
                found[i, j] = self._points.get(
                    (first.name, second.name), lambda asked=asked: _make_pair_points(*asked())
                )
        return found

    def _encode(self, keyframe: Keyframe) -> EncodedImage:
        def encode_image() -> EncodedImage:
            return self._network.encode(prepare_image(keyframe.frame.image, self.make_crop(keyframe)))

        return self._encoded.get(keyframe.name, encode_image)


def prepare_image(image: npt.NDArray[np.uint8], to: Crop) -> Tensor:
    """(3, H, W) in [-1, 1]: what the network sees of a photograph (h, w, 3)."""
    return crop_image(image, to).permute(2, 0, 1) * 2.0 - 1.0


def _make_pair_points(first: Prediction, second: Prediction) -> PairPoints:
    return PairPoints(*(part.numpy() for view in (first, second) for part in (view.points, view.confidence)))


log = logging.getLogger(__name__)

WEIGHTS = ("mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",)
LICENCE = (
    "MASt3R's weights are licensed CC BY-NC-SA 4.0 (with the terms of its training sets, mapfree among them): "
    "for non-commercial use only."
)


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """MASt3R as a prior: matches by its descriptors, depth by global alignment of its point maps."""

    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 512  # of the network's images, pixels: what it was trained with
    max_neighbours: Internal[int] = 6  # places in the circle of frames: of up to 13 frames every pair is asked about
    seed: Internal[int] = 0  # every prior has one; global alignment has a fixed one


class Mast3rPrior(Prior):
    """Matches between detected features by the network's descriptors, depth by global alignment.

    A match counts only where it is an inlier of its pair's epipolar geometry: matches that the network invents between
    unrelated photographs agree with none.
    """

    def __init__(self, network: Network, config: Config) -> None:
        self._config = config
        self._asked = NetworkCache(network, config.longer_side)
        self.matcher = DescriptorMatcher(self._asked)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, run: RunContext = BACKGROUND
    ) -> tuple[Pointmap, ...]:
        """The aligned depth maps, each brought to the scale of the registered points that its camera sees."""
        keyframes = [graph.keyframes[camera.index] for camera in registration.cameras]
        views = align_views(self._asked.predict_points(keyframes, self._config.max_neighbours))
        run.pause()
        crops = [self._asked.make_crop(keyframe) for keyframe in keyframes]
        return tuple(
            make_registered_pointmap(graph, registration, camera, to, view.depth, view.confidence)
            for camera, view, to in zip(registration.cameras, views, crops, strict=True)
        )


@dataclass(frozen=True, eq=False)
class DescriptorMatcher:
    """A `recon.matching.match.Matcher` by the network's descriptors at the features that keyframes have."""

    asked: NetworkCache

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self.asked.predict_pair(keyframe1, keyframe2)
        found1, inside1 = _sample_descriptors(first, self.asked.make_crop(keyframe1), keyframe1)
        found2, inside2 = _sample_descriptors(second, self.asked.make_crop(keyframe2), keyframe2)
        matches = _match_mutual(found1, found2)
        return np.stack([inside1[matches[:, 0]], inside2[matches[:, 1]]], 1)


def load(config: Config) -> Mast3rPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not MASt3R's."""
    network = load_network(config.weights or find(*WEIGHTS))
    log.info("%s", LICENCE)
    return Mast3rPrior(network, config)


def _sample_descriptors(
    prediction: Prediction, crop: Crop, keyframe: Keyframe
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """(F, D) descriptors at those features that the crop shows, and which they are (F,)."""
    pixels = np.floor(crop.map_to_network(keyframe.features.points)).astype(np.int64)
    (inside,) = np.nonzero(((pixels >= 0) & (pixels < [crop.width, crop.height])).all(1))
    descriptors = prediction.descriptors.numpy()[pixels[inside, 1], pixels[inside, 0]]
    return descriptors, inside


def _match_mutual(
    descriptors1: npt.NDArray[np.float32], descriptors2: npt.NDArray[np.float32]
) -> npt.NDArray[np.int64]:
    """(M, 2) mutual nearest neighbours, the most alike first."""
    if not len(descriptors1) or not len(descriptors2):
        return np.zeros((0, 2), np.int64)
    alike = torch.from_numpy(descriptors1) @ torch.from_numpy(descriptors2).T
    score, nearest = alike.max(1)
    (chosen,) = torch.nonzero(alike.argmax(0)[nearest] == torch.arange(len(nearest)), as_tuple=True)
    chosen = chosen[score[chosen].argsort(descending=True, stable=True)]
    return torch.stack([chosen, nearest[chosen]], 1).numpy()
