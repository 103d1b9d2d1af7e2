"""The MASt3R network: two photographs in; for each a point map in the first one's frame, confidences and descriptors.

"Grounding Image Matching in 3D with MASt3R" (Leroy et al. 2024) on "DUSt3R" (Wang et al. 2024) and "CroCo v2"
(Weinzaepfel et al. 2023): a ViT encodes each image, two decoders look at their own and at the other's tokens, and each
image's head gives points, confidence and descriptors. Written from the papers; modules carry the names of the official
checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon.networks import weights
from splatnode.recon.networks.depth_anything import Fusion
from splatnode.recon.networks.vit import (
    Attention,
    Block,
    Mlp,
    PatchEmbedding,
    Rotary,
    attend,
    grid_positions,
    split_heads,
)

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
    return weights.load_network(partial(Mast3r, size), weights.read_weights(path), path, "MASt3R")


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
