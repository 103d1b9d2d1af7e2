"""Depth Anything 3 (Lin et al. 2025): any number of photographs in; depth, confidence and cameras out.

Written from the paper; modules carry the names of the published checkpoint. Where cameras are known it takes them in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from splatnode.recon.networks import vit as networks_vit
from splatnode.recon.networks import weights as networks_weights
from splatnode.recon.networks.depth_anything import Scratch, resizers, upsample
from splatnode.recon.networks.vit import PATCH, Block, Dinov2, Mlp, Rotary, grid_positions

# Depth Anything 3's transformer: DINOv2, of which every second block of the later ones looks at all views at once.

_MIN_VIEWS_TO_CHOOSE = 3  # with fewer, the first view is the reference


@dataclass(frozen=True)
class Size:
    """The defaults are those of the published Small."""

    vit: networks_vit.Size = networks_vit.SMALL
    joint_from: int = 4  # the first of the later blocks
    layers: tuple[int, int, int, int] = (5, 7, 9, 11)  # whose tokens the heads get
    head_width: int = 64
    head_layer_widths: tuple[int, int, int, int] = (48, 96, 192, 384)
    camera_heads: int = 16


SMALL = Size()


@dataclass(frozen=True, eq=False)
class Features:
    """Each layer's tokens within the views beside those across them."""

    patches: list[Tensor]  # (S, h w, 2 width) of each layer, the second half normed
    cameras: Tensor  # (S, 2 width) of the last layer, not normed


class Backbone(Dinov2):
    """DINOv2 with a token for each view's camera, and attention across views in every second later block."""

    def __init__(self, size: Size) -> None:
        super().__init__(size.vit, masks=False, normed_from=size.joint_from)
        self.camera_token = nn.Parameter(torch.zeros(1, 2, size.vit.width))  # of the reference, and of other views
        self.norm = nn.LayerNorm(size.vit.width)
        self._joint_from, self._layers = size.joint_from, size.layers

    def encode_views(self, images: Tensor, cameras: Tensor | None) -> Features:
        """Encodes images (S, 3, H, W) of `normalize_image`; `cameras` (S, width) are tokens of known ones."""
        tokens = self.embed_patches(images)
        rows, columns = (side // networks_vit.PATCH for side in images.shape[2:])
        within, across = self._rotaries(rows, columns, len(images))
        order = torch.arange(len(images))
        own = tokens
        patches, last = [], tokens
        for index, block in enumerate(self.blocks):
            if index == self._joint_from - 1 and cameras is None and len(images) >= _MIN_VIEWS_TO_CHOOSE:
                order = _order_reference_first(tokens[:, 0])
                tokens, own = tokens[order], own[order]
            if index == self._joint_from:
                tokens = torch.cat([self._camera_tokens(cameras, len(images))[:, None], tokens[:, 1:]], 1)
            if index >= self._joint_from and index % 2:
                tokens = block(tokens.flatten(0, 1)[None], across)[0].unflatten(0, (len(images), -1))
            else:
                tokens = own = block(tokens, within if index >= self._joint_from else None)
            if index in self._layers:
                last = torch.cat([own, tokens], -1)[order.argsort()]
                own_half, joint_half = last.chunk(2, dim=-1)
                patches.append(torch.cat([own_half, self.norm(joint_half)], -1)[:, 1:])
        return Features(patches, last[:, 0])

    def _camera_tokens(self, cameras: Tensor | None, count: int) -> Tensor:
        if cameras is not None:
            return cameras
        reference, other = self.camera_token[0]
        return torch.stack([reference, *[other] * (count - 1)])

    def _rotaries(self, rows: int, columns: int, count: int) -> tuple[Rotary, Rotary]:
        """Within a view patches are at their places from 1 and the camera's token at 0; across views all are at 1."""
        dimension = self.size.width // self.size.heads
        places = torch.cat([torch.zeros(1, 2), 1.0 + grid_positions(rows, columns)])
        return Rotary.create_from_positions(places, dimension), Rotary.create_from_positions(
            places.clamp(max=1.0).repeat(count, 1), dimension
        )


def _order_reference_first(tokens: Tensor) -> Tensor:
    """The order of views (S,) by their class tokens (S, C): first the most usual one, then the others as they came.

    It is the one whose likeness to the others, length and variance lie nearest to the middle of their ranges.
    """
    unit = tokens / tokens.norm(dim=-1, keepdim=True)
    likeness = (unit @ unit.T).sum(-1) - 1.0
    offset = torch.zeros(len(tokens))
    for measure in (likeness / (len(tokens) - 1), tokens.norm(dim=-1), unit.var(dim=-1)):
        least, most = measure.min(), measure.max()
        offset += ((measure - least) / (most - least + 1e-8) - 0.5).abs()
    reference = int(offset.argmin())
    return torch.tensor([reference, *(view for view in range(len(tokens)) if view != reference)])


# Depth Anything 3's heads: depth with its confidence for every pixel, and a camera for every view.

_DETAIL = 32  # channels at full resolution
_POSITION_BASE, _POSITION_WEIGHT = 100.0, 0.1  # of the waves of a pixel's place, as published


class DepthHead(nn.Module):
    """A dense prediction transformer; the checkpoint holds a second one, for rays, that is not needed."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width, widths = size.head_width, size.head_layer_widths
        self.norm = nn.LayerNorm(2 * size.vit.width)
        self.projects = nn.ModuleList(nn.Conv2d(2 * size.vit.width, each, 1) for each in widths)
        self.resize_layers = resizers(widths)
        self.scratch = _DepthScratch(widths, width)

    def forward(self, layers: Sequence[Tensor], height: int, width: int) -> tuple[Tensor, Tensor]:
        """(S, H, W) depth, and confidence from 1, from four layers' tokens (S, h w, C)."""
        grid, aspect = (height // PATCH, width // PATCH), width / height
        images = []
        for tokens, project, resize in zip(layers, self.projects, self.resize_layers, strict=True):
            image = project(self.norm(tokens).transpose(1, 2).unflatten(2, grid))
            images.append(resize(_add_position_waves(image, aspect)))
        fused = self.scratch.output_conv1(self.scratch.fuse(images))
        raw = self.scratch.output_conv2(_add_position_waves(upsample(fused, (height, width)), aspect))
        return raw[:, 0].exp(), 1.0 + raw[:, 1].exp()


class _DepthScratch(Scratch):
    def __init__(self, widths: Sequence[int], width: int) -> None:
        super().__init__(widths, width, whole_last=False)
        self.output_conv1 = nn.Conv2d(width, width // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(width // 2, _DETAIL, 3, padding=1), nn.ReLU(), nn.Conv2d(_DETAIL, 2, 1)
        )


class CameraHead(nn.Module):
    """Position, rotation and fields of view from a view's camera token."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width = 2 * size.vit.width
        self.backbone = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t, self.fc_qvec = nn.Linear(width, 3), nn.Linear(width, 4)
        self.fc_fov = nn.Sequential(nn.Linear(width, 2), nn.ReLU())

    def forward(self, tokens: Tensor) -> Tensor:
        """(S, 9) position (3) and rotation (quaternion xyzw) of the camera in the world, field of view (y, x)."""
        x = self.backbone(tokens)
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], -1)


class CameraEncoder(nn.Module):
    """Tokens of known cameras, in place of those that ask for them."""

    def __init__(self, size: Size, depth: int = 4) -> None:
        super().__init__()
        width = size.vit.width
        self.pose_branch = Mlp(9, width // 2, width)
        self.token_norm, self.trunk_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.trunk = nn.ModuleList(Block(width, size.camera_heads, scaled=True, epsilon=1e-5) for _ in range(depth))

    def forward(self, cameras: Tensor) -> Tensor:
        """(S, width) of (S, 9) cameras as `CameraHead` gives them."""
        tokens = self.token_norm(self.pose_branch(cameras))
        for block in self.trunk:
            tokens = block(tokens)
        return self.trunk_norm(tokens)


def _add_position_waves(image: Tensor, aspect: float) -> Tensor:
    """(S, C, h, w) with sines and cosines of each pixel's place added; `aspect` is the photograph's width by height."""
    _, channels, height, width = image.shape
    diagonal = (1.0 + aspect**2) ** 0.5
    quarter = channels // 4
    frequencies = _POSITION_BASE ** (-torch.arange(quarter, dtype=torch.float32) / quarter)

    def waves(extent: float, count: int) -> Tensor:
        """(C / 2, count) along a side that reaches from -extent to extent."""
        edge = extent * (count - 1) / count
        angles = frequencies[:, None] * torch.linspace(-edge, edge, count)
        return torch.cat([angles.sin(), angles.cos()])

    across, down = waves(aspect / diagonal, width), waves(1.0 / diagonal, height)
    waved = torch.cat([across[:, None].expand(-1, height, -1), down[:, :, None].expand(-1, -1, width)])
    return image + _POSITION_WEIGHT * waved


Array = npt.NDArray[np.float64]

_UNUSED = ("head.scratch.refinenet1_aux", "head.scratch.refinenet2_aux", "head.scratch.refinenet3_aux")
_UNUSED += ("head.scratch.refinenet4_aux", "head.scratch.output_conv1_aux", "head.scratch.output_conv2_aux")


_MIN_UNIT = 0.1  # of lengths: cameras that stand together are not blown up
_MIN_TANGENT = 1e-6  # of half a field of view, which the network gives from 0 up


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera of the network's image."""

    T_world_camera: Array  # (4, 4)
    K: Array  # (3, 3) of the network's image


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """The network's estimate for one of its images."""

    depth: npt.NDArray[np.float32]  # (H, W) z in the camera frame, in the unit of the cameras' positions
    confidence: npt.NDArray[np.float32]  # (H, W), from 1
    camera: PlacedCamera


class DepthAnything3(nn.Module):
    """A backbone, a head for depth, one for cameras, and an encoder of cameras that are known."""

    def __init__(self, size: Size = SMALL) -> None:
        super().__init__()
        self.backbone = nn.ModuleDict({"pretrained": Backbone(size)})
        self.head = DepthHead(size)
        self.cam_dec = CameraHead(size)
        self.cam_enc = CameraEncoder(size)

    @torch.inference_mode()
    def forward(self, images: Tensor, cameras: Sequence[PlacedCamera] | None = None) -> list[DepthEstimate]:
        """Estimates depth of images (S, 3, H, W) of `normalize_image`, with their `cameras` where known.

        The world's frame and unit are the network's own.
        """
        height, width = images.shape[2:]
        backbone = self.backbone["pretrained"]
        assert isinstance(backbone, Backbone)
        known = None if cameras is None else self.cam_enc(_encode_cameras(_normalize_cameras(cameras), height, width))
        features = backbone.encode_views(images, known)
        depth, confidence = self.head(features.patches, height, width)
        placed = _decode_cameras(self.cam_dec(features.cameras), height, width)
        return [DepthEstimate(*view) for view in zip(depth.numpy(), confidence.numpy(), placed, strict=True)]


def load_network(path: Path, size: Size = SMALL) -> DepthAnything3:
    """Raises ValueError where the file is damaged, holds another model or anything but data, and FileNotFoundError."""
    weights = {name.removeprefix("model."): tensor for name, tensor in networks_weights.read_weights(path).items()}
    needed = {name: tensor for name, tensor in weights.items() if not name.startswith(_UNUSED)}
    return networks_weights.load_network(partial(DepthAnything3, size), needed, path, "Depth Anything 3 Small")


def _normalize_cameras(cameras: Sequence[PlacedCamera]) -> list[PlacedCamera]:
    """In the first camera's frame, at a median distance from it of 1, as the network was trained with."""
    to_first = np.linalg.inv(cameras[0].T_world_camera)
    Ts_first_camera = [to_first @ camera.T_world_camera for camera in cameras]
    # The lower of two middle ones, as in its training.
    unit = max(_MIN_UNIT, float(np.sort([np.linalg.norm(T[:3, 3]) for T in Ts_first_camera])[(len(cameras) - 1) // 2]))
    for T_first_camera in Ts_first_camera:
        T_first_camera[:3, 3] /= unit
    return [PlacedCamera(T, camera.K) for T, camera in zip(Ts_first_camera, cameras, strict=True)]


def _encode_cameras(cameras: Sequence[PlacedCamera], height: int, width: int) -> Tensor:
    """(S, 9) as the network's heads write cameras."""
    rows = []
    for camera in cameras:
        quaternion = Rotation.from_matrix(camera.T_world_camera[:3, :3]).as_quat(canonical=True)
        fields = 2.0 * np.arctan([height / 2 / camera.K[1, 1], width / 2 / camera.K[0, 0]])
        rows.append(np.concatenate([camera.T_world_camera[:3, 3], quaternion, fields]))
    return torch.from_numpy(np.stack(rows).astype(np.float32))


def _decode_cameras(encoded: Tensor, height: int, width: int) -> list[PlacedCamera]:
    """The cameras of images (height, width) from (S, 9) as `CameraHead` gives them; principal points are central."""
    cameras = []
    for row in encoded.numpy().astype(np.float64):
        T_world_camera = np.eye(4)
        T_world_camera[:3, 3] = row[:3]
        T_world_camera[:3, :3] = Rotation.from_quat(row[3:7]).as_matrix()
        tangents = np.maximum(np.tan(row[7:9] / 2.0), _MIN_TANGENT)
        K = np.array([[width / 2 / tangents[1], 0, width / 2], [0, height / 2 / tangents[0], height / 2], [0, 0, 1.0]])
        cameras.append(PlacedCamera(T_world_camera, K))
    return cameras
