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

from splatnode.recon.networks import weight_loading
from splatnode.recon.priors.da3.backbone import SMALL, Backbone, Size
from splatnode.recon.priors.da3.head import CameraEncoder, CameraHead, DepthHead

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
    weights = {name.removeprefix("model."): tensor for name, tensor in weight_loading.read_weights(path).items()}
    needed = {name: tensor for name, tensor in weights.items() if not name.startswith(_UNUSED)}
    return weight_loading.load_network(partial(DepthAnything3, size), needed, path, "Depth Anything 3 Small")


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
