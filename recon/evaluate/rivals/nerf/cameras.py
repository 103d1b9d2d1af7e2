"""Cameras that are learnt: a rotation vector and a translation each, and one focal length (Wang et al. 2021)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Cameras(nn.Module):
    """C cameras that all start at the world's origin. `T_world_camera` and `K` carry gradients.

    The first camera stays where it is: it is the world.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(count, 3))
        self.centres = nn.Parameter(torch.zeros(count, 3))

    def T_world_camera(self, index: int) -> Tensor:  # (4, 4)
        if index == 0:
            return torch.eye(4)
        x, y, z = self.turns[index]
        zero = torch.zeros(())
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
        upper = torch.cat([torch.linalg.matrix_exp(cross), self.centres[index][:, None]], 1)
        return torch.cat([upper, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])


class Focal(nn.Module):
    """One focal length for all, in parts of the longer side: the square of what is learnt, so that it is positive."""

    def __init__(self, start: float) -> None:
        super().__init__()
        self.root = nn.Parameter(torch.tensor(start**0.5))

    def K(self, width: int, height: int) -> Tensor:  # (3, 3)
        focal = self.root**2 * max(width, height)
        zero, one = torch.zeros(()), torch.ones(())
        middle = torch.tensor([width / 2, height / 2])
        return torch.stack([focal, zero, middle[0], zero, focal, middle[1], zero, zero, one]).view(3, 3)
