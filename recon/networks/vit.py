"""DINOv2's vision transformer (Oquab et al. 2023), which several networks look through.

Written from the paper; modules carry the names of the official checkpoints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

# Rotary position embedding in two dimensions ("RoPE", Su et al. 2021; base 100 for image patches, as CroCo v2).

_BASE = 100.0


@dataclass(frozen=True, eq=False)
class Rotary:
    """The rotations of N positions: the first half of a vector turns with the row, the second with the column."""

    cosine: Tensor  # (N, D)
    sine: Tensor  # (N, D)

    @classmethod
    def create_from_positions(cls, positions: Tensor, dimension: int) -> Rotary:
        """For vectors of `dimension` D, a multiple of 4, at `positions` (N, 2) in patches."""
        quarter = dimension // 4
        frequencies = _BASE ** (-torch.arange(quarter, device=positions.device, dtype=torch.float32) / quarter)
        angles = positions.to(torch.float32)[:, :, None] * frequencies  # (N, 2, D / 4)
        angles = torch.cat([angles, angles], dim=-1).flatten(1)
        return cls(angles.cos(), angles.sin())

    def rotate(self, x: Tensor) -> Tensor:
        """(..., N, D) vectors, each turned by the rotation of its position."""
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)  # pairs lie a quarter of D apart
        across = torch.stack([-second, first], dim=-2).flatten(-3)
        return x * self.cosine + across * self.sine


def grid_positions(rows: int, columns: int) -> Tensor:
    """(rows * columns, 2) row and column of each patch, row by row."""
    return torch.cartesian_prod(torch.arange(rows), torch.arange(columns))


# The parts of vision transformers: attention, MLP and the block of both (Dosovitskiy et al. 2021).
#
# Attributes carry the names that published checkpoints use. Tokens are (..., N, C).


class PatchEmbedding(nn.Module):
    """Cuts images into patches and maps each to a token."""

    def __init__(self, patch: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, patch, stride=patch)

    def forward(self, images: Tensor) -> Tensor:
        """(S, h w, width) tokens, row by row, of images (S, 3, H, W)."""
        return self.proj(images).flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, width: int, heads: int, *, normed: bool = False) -> None:
        """`normed`: queries and keys are normalised, head by head."""
        super().__init__()
        self._heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.q_norm, self.k_norm = (nn.LayerNorm(width // heads) if normed else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor, rotary: Rotary | None) -> Tensor:
        """(..., N, C) from tokens (..., N, C); `rotary` turns queries and keys by their positions."""
        query, key, value = (split_heads(part, self._heads) for part in self.qkv(x).chunk(3, dim=-1))
        query, key = self.q_norm(query), self.k_norm(key)
        if rotary is not None:
            query, key = rotary.rotate(query), rotary.rotate(key)
        return self.proj(attend(query, key, value))


class Mlp(nn.Module):
    """Two linear layers with a GELU between them."""

    def __init__(self, width: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x)))


class _Scale(nn.Module):
    """A learned factor for each channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Block(nn.Module):
    """Attention and MLP, each after a layer norm and added to what came in."""

    def __init__(
        self, width: int, heads: int, *, scaled: bool = False, normed: bool = False, epsilon: float = 1e-6
    ) -> None:
        """`scaled`: what the two parts add has a learned scale; `normed`: see `Attention`; `epsilon` of the norms."""
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=epsilon) for _ in range(2))
        self.attn = Attention(width, heads, normed=normed)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls1, self.ls2 = (_Scale(width) if scaled else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor, rotary: Rotary | None = None) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x), rotary))
        return x + self.ls2(self.mlp(self.norm2(x)))


def split_heads(x: Tensor, heads: int) -> Tensor:
    """(..., heads, N, D) from (..., N, heads * D)."""
    return x.unflatten(-1, (heads, -1)).transpose(-3, -2)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """(..., N, heads * D) softmax attention of (..., heads, N, D) queries to (..., heads, M, D) keys and values."""
    heads = query.shape[-3]  # one dimension before it is what the fast kernels take
    q, k, v = (part.reshape(-1, heads, *part.shape[-2:]) for part in (query, key, value))
    attended = functional.scaled_dot_product_attention(q, k, v).reshape(query.shape)
    return attended.transpose(-3, -2).flatten(-2)


PATCH = 14
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the images that it was trained with


@dataclass(frozen=True)
class Size:
    """The defaults are those of the published ViT-Small."""

    width: int = 384
    depth: int = 12
    heads: int = 6
    grid: int = 37  # patches along a side of the images that its positions were learned with


SMALL = Size()


class Dinov2(nn.Module):
    """The vision transformer: photographs in, tokens of their patches after chosen blocks out."""

    def __init__(self, size: Size = SMALL, *, masks: bool = True, normed_from: int | None = None) -> None:
        """`masks`: whether the checkpoint holds the pre-training's token. Blocks from `normed_from` on are normed."""
        super().__init__()
        self.size = size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        if masks:
            self.mask_token = nn.Parameter(torch.zeros(1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + size.grid**2, size.width))
        self.patch_embed = PatchEmbedding(PATCH, size.width)
        first_normed = size.depth if normed_from is None else normed_from
        self.blocks = nn.ModuleList(
            Block(size.width, size.heads, scaled=True, normed=index >= first_normed) for index in range(size.depth)
        )
        self.norm = nn.LayerNorm(size.width, eps=1e-6)

    def embed_patches(self, images: Tensor) -> Tensor:
        """(S, 1 + h w, width): the class token and those of the patches, with their positions."""
        _, channels, height, width = images.shape
        if channels != 3 or height % PATCH or width % PATCH or not height * width:
            raise ValueError(f"images must be (S, 3, H, W), H and W multiples of {PATCH}, got {tuple(images.shape)}")
        patches = self.patch_embed(images)
        tokens = torch.cat([self.cls_token.expand(len(images), -1, -1), patches], 1)
        return tokens + self._positions(height // PATCH, width // PATCH)

    def forward(self, images: Tensor, layers: tuple[int, ...]) -> list[Tensor]:
        """(S, 1 + h w, width) after each of the blocks `layers`, normed, of `normalised` images (S, 3, H, W)."""
        tokens, found = self.embed_patches(images), []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in layers:
                found.append(self.norm(tokens))
        return found

    def _positions(self, rows: int, columns: int) -> Tensor:
        """(1, 1 + rows * columns, width)."""
        grid = self.size.grid
        if rows == columns == grid:
            return self.pos_embed
        learned = self.pos_embed[:, 1:].unflatten(1, (grid, grid)).permute(0, 3, 1, 2)
        # A tenth of a patch more, as in its training: where samples lie follows from the factor and not from the size.
        factor = ((rows + 0.1) / grid, (columns + 0.1) / grid)
        resized = functional.interpolate(learned, scale_factor=factor, mode="bicubic")
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], 1)


def normalize_image(image: Tensor) -> Tensor:
    """(3, H, W) as the network wants it, of an image (H, W, 3) in [0, 1]."""
    return ((image - image.new_tensor(MEAN)) / image.new_tensor(STD)).permute(2, 0, 1)


# Photographs at the size that a network wants: scaled, then cut evenly to whole patches.


@dataclass(frozen=True)
class Crop:
    """How a photograph became the network's image."""

    scale: float  # network pixels per pixel of the photograph
    left: int  # network pixels that were cut
    top: int
    width: int  # of the network's image
    height: int

    def map_to_network(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(M, 2) pixels of the photograph as pixels of the network's image."""
        return pixels * self.scale - [self.left, self.top]

    def map_to_image(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(M, 2) pixels of the network's image as pixels of the photograph."""
        return (pixels + [self.left, self.top]) / self.scale

    def crop_centre(self, width: int, height: int) -> Crop:
        """The middle of it, of at most `width` x `height`."""
        width, height = min(width, self.width), min(height, self.height)
        left, top = self.left + (self.width - width) // 2, self.top + (self.height - height) // 2
        return replace(self, left=left, top=top, width=width, height=height)


def crop(width: int, height: int, longer_side: int, patch: int) -> Crop:
    """The crop of a photograph of `width` x `height`. Raises ValueError where a side would be below one patch."""
    scale = longer_side / max(width, height)
    scaled_width, scaled_height = round(width * scale), round(height * scale)
    cut_width, cut_height = (side // patch * patch for side in (scaled_width, scaled_height))
    if not cut_width * cut_height:
        raise ValueError(
            f"an image of {width}x{height} is too thin for the network: "
            f"no side may be below 1/{longer_side // patch} of the other"
        )
    left, top = (scaled_width - cut_width) // 2, (scaled_height - cut_height) // 2
    return Crop(scale, left, top, cut_width, cut_height)


def crop_image(image: npt.NDArray[np.uint8], to: Crop) -> Tensor:
    """(H, W, 3) in [0, 1]: what the network sees of a photograph (h, w, 3)."""
    size = (round(image.shape[1] * to.scale), round(image.shape[0] * to.scale))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if to.scale < 1 else cv2.INTER_CUBIC)
    cut = resized[to.top : to.top + to.height, to.left : to.left + to.width]
    return torch.from_numpy(np.ascontiguousarray(cut)).float() / 255.0
