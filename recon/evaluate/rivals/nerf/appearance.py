"""How a radiance field looks, and what is published of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.capture.frame import Frame
from splatnode.recon.evaluate.appearance import FieldSnapshot
from splatnode.recon.evaluate.rivals import outcome
from splatnode.recon.evaluate.rivals.nerf.field import Field
from splatnode.recon.evaluate.rivals.nerf.fit import FieldCheckpoint
from splatnode.recon.evaluate.rivals.nerf.volume_rendering import render_rays
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

Array = npt.NDArray[np.float64]
COMPARED_PIXELS = 128  # pixels on which an image is compared
_CHUNK = 1024  # rays that are rendered at a time


class FieldAppearance:
    """`recon.evaluate.appearance.Appearance` of a field, whose parameters are constants here."""

    num_gaussians = None

    def __init__(self, field: Field) -> None:
        self._field = field.requires_grad_(False)

    @property
    def num_bytes(self) -> int:
        return sum(parameter.nbytes for parameter in self._field.parameters())

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of an image with an angle of view of 53 degrees."""
        K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        with torch.no_grad():
            return float(
                render_rays(
                    self._field, torch.from_numpy(T_world_camera).float(), K, sample_pixels(100, 100)
                ).depth.median()
            )

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        """On the same pixels whenever it is asked, evenly spread over the image, or over what is `used` of it."""
        pixels = sample_pixels(image.shape[1], image.shape[0]) if used is None else _sample_used_pixels(used)
        columns, rows = pixels.long().unbind(1)
        return (render_rays(self._field, T_world_camera, K, pixels).rgb - image[rows, columns]).abs().mean()

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        T, intrinsics = torch.from_numpy(T_world_camera).float(), torch.from_numpy(K).float()
        with torch.no_grad():
            parts = torch.stack([u, v], -1).view(-1, 2).split(_CHUNK)
            rgb = torch.cat([render_rays(self._field, T, intrinsics, part).rgb for part in parts])
        return rgb.view(height, width, 3)


def sample_pixels(width: int, height: int, count: int = COMPARED_PIXELS) -> Tensor:
    """(M, 2) centres of pixels that cover an image evenly: the additive sequence of the plastic number."""
    plastic = 1.32471795724474602596
    shares = torch.arange(1, count + 1)[:, None] * torch.tensor([1 / plastic, 1 / plastic**2]) % 1.0
    return (shares * torch.tensor([width, height])).floor() + 0.5


def _sample_used_pixels(used: Tensor) -> Tensor:
    """(M, 2) centres of pixels among those of `used` (H, W): the additive sequence of the golden ratio."""
    rows, columns = torch.nonzero(used, as_tuple=True)
    shares = torch.arange(1, COMPARED_PIXELS + 1) * 0.61803398874989484820 % 1.0
    chosen = (shares * len(rows)).long()
    return torch.stack([columns[chosen], rows[chosen]], 1) + 0.5


def make_field_snapshot(frames: Sequence[Frame], registered: Sequence[Frame], learnt: FieldCheckpoint) -> FieldSnapshot:
    """A field and the cameras that were learnt with it, those of the frames `registered`."""
    return FieldSnapshot(
        sequence=0,
        verdict=outcome.make_verdict(frames, {frame.name for frame in registered}),
        cameras=tuple(
            _make_camera_estimate(frame, T, learnt.focal)
            for frame, T in zip(registered, learnt.Ts_world_camera, strict=True)
        ),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=learnt.iterations,
        appearance=FieldAppearance(learnt.field),
    )


def _make_camera_estimate(frame: Frame, T_world_camera: Tensor, focal: float) -> CameraEstimate:
    width, height = frame.width, frame.height
    pixels = focal * max(width, height)
    K = np.array([[pixels, 0, width / 2], [0, pixels, height / 2], [0, 0, 1.0]])
    T = T_world_camera.double().numpy()
    return CameraEstimate(frame.name, frame.frame_id, T, K, width, height)
