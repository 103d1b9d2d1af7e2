"""The parts of vision transformers: attention, MLP and the block of both (Dosovitskiy et al. 2021).

Attributes carry the names that published checkpoints use. Tokens are (..., N, C).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.recon.networks.rotary import Rotary


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
