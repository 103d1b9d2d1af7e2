"""Depth Anything 3 as a prior: it proposes matches, and gives depth once it was told the verified cameras.

The network (Lin et al. 2025) takes any number of photographs, and cameras where they are known; it gives depth,
confidence and cameras. Written from the paper; modules carry the names of the published checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from splatnode.capture.process.config import Internal
from splatnode.recon import networks
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features
from splatnode.recon.matching.features import describe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks import find
from splatnode.recon.networks import vit as networks_vit
from splatnode.recon.networks.depth_anything import Scratch, resizers, upsample
from splatnode.recon.networks.vit import (
    PATCH,
    Block,
    Crop,
    Dinov2,
    Mlp,
    Rotary,
    crop,
    crop_image,
    grid_positions,
    normalize_image,
)
from splatnode.recon.priors import Pointmap, Prior, make_registered_pointmap
from splatnode.recon.registration.registration import Registration
from splatnode.recon.threads import BACKGROUND, RunContext

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
    weights = {name.removeprefix("model."): tensor for name, tensor in networks.read_weights(path).items()}
    needed = {name: tensor for name, tensor in weights.items() if not name.startswith(_UNUSED)}
    return networks.load_network(partial(DepthAnything3, size), needed, path, "Depth Anything 3 Small")


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


# Keyframes through the network together, all at one size.


class Network(Protocol):
    """The interface of the prior's network; `DepthAnything3` implements it."""

    def __call__(self, images: Tensor, cameras: Sequence[PlacedCamera] | None = None) -> list[DepthEstimate]: ...


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera of a photograph at full size."""

    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    focal: float  # pixels


@dataclass(frozen=True, eq=False)
class CroppedEstimate:
    """The network's estimate for a keyframe, and the crop that it was made for."""

    estimate: DepthEstimate
    crop: Crop


def estimate_keyframes(
    network: Network, keyframes: Sequence[Keyframe], longer_side: int, cameras: Sequence[KnownCamera] | None = None
) -> list[CroppedEstimate]:
    """Runs the network on these keyframes together; images are cropped to a common size."""
    crops = [crop(keyframe.frame.width, keyframe.frame.height, longer_side, PATCH) for keyframe in keyframes]
    width, height = min(each.width for each in crops), min(each.height for each in crops)
    crops = [each.crop_centre(width, height) for each in crops]
    images = [
        normalize_image(crop_image(keyframe.frame.image, to)) for keyframe, to in zip(keyframes, crops, strict=True)
    ]
    placed = None if cameras is None else [_place_camera(camera, to) for camera, to in zip(cameras, crops, strict=True)]
    estimates = network(torch.stack(images), placed)
    return [CroppedEstimate(estimate, to) for estimate, to in zip(estimates, crops, strict=True)]


def _place_camera(camera: KnownCamera, to: Crop) -> PlacedCamera:
    """Makes the cropped image's camera, with a central principal point, as the network assumes."""
    focal = camera.focal * to.scale
    K = np.array([[focal, 0.0, to.width / 2], [0.0, focal, to.height / 2], [0.0, 0.0, 1.0]])
    return PlacedCamera(camera.T_world_camera, K)


# Wide-baseline matches: a photograph is warped into the other's view by the network's depth and cameras, then matched.
#
# Descriptors alone decide, anywhere in the two pictures: where the network is right, both look the same from one
# viewpoint; where it is wrong, the warped one shows something else, and matches are lost, but none are made up.


_KEYPOINT_PX = 6.0  # size of a keypoint, network pixels: its descriptor looks at 6 times as much
_MAX_DISTANCE_PX = 1.0  # from a feature to the origin of the warped pixel that shows it, network pixels
_NOWHERE = -1e4  # the origin of pixels that the first photograph does not show: far outside of it
_MIN_DEPTH = 1e-6  # of a point before the first camera, in the network's unit


@dataclass(frozen=True, eq=False)
class WarpMatcher:
    """A `recon.matching.view_graph.Matcher` of the points that keyframes have."""

    network: Network
    longer_side: int

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        return keyframe

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = estimate_keyframes(self.network, [keyframe1, keyframe2], self.longer_side)
        origin = _compute_origins(first, second)
        grey1, grey2 = (
            (crop_image(keyframe.frame.image, answer.crop).mean(-1) * 255).byte().numpy()
            for keyframe, answer in ((keyframe1, first), (keyframe2, second))
        )
        from_u, from_v = np.moveaxis((origin - 0.5).astype(np.float32), -1, 0)
        warped = np.asarray(cv2.remap(grey1, from_u, from_v, cv2.INTER_LINEAR), np.uint8)
        where1, chosen1 = _find_warped_pixels(first.crop.map_to_network(keyframe1.features.points), origin)
        where2 = second.crop.map_to_network(keyframe2.features.points)
        (chosen2,) = np.nonzero(((where2 >= 0) & (where2 < [second.crop.width, second.crop.height])).all(1))
        # Upright and of one size: both pictures are from one viewpoint.
        described1 = describe(warped, where1, _KEYPOINT_PX)
        described2 = describe(grey2, where2[chosen2], _KEYPOINT_PX)
        found = features.match(described1, described2, features.NearestNeighbourConfig())
        return np.stack([chosen1[found[:, 0]], chosen2[found[:, 1]]], 1)


def _compute_origins(first: CroppedEstimate, second: CroppedEstimate) -> Array:
    """(H, W, 2): the pixel of the first photograph that shows what each pixel of the second shows; else _NOWHERE."""
    depth, camera2, camera1 = second.estimate.depth, second.estimate.camera, first.estimate.camera
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera2.K).T
    T_first_second = np.linalg.inv(camera1.T_world_camera) @ camera2.T_world_camera
    points = (rays * depth[..., None]) @ T_first_second[:3, :3].T + T_first_second[:3, 3]
    ahead = points[..., 2] > _MIN_DEPTH
    projected = (points @ camera1.K.T)[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None]
    inside = ahead & (np.abs(projected) < -_NOWHERE).all(-1)
    return np.where(inside[..., None], projected, _NOWHERE)


def _find_warped_pixels(points: Array, origin: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """(M, 2) pixels of the warped picture that show features `points` (F, 2) of the first photograph; (M,) which."""
    inside = (origin > _NOWHERE).all(-1)
    rows, columns = np.nonzero(inside)
    if not len(rows) or not len(points):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    distance, nearest = (np.asarray(found) for found in KDTree(origin[inside]).query(points))
    (chosen,) = np.nonzero(distance < _MAX_DISTANCE_PX)
    pixels = np.stack([columns, rows], 1)[nearest[chosen].astype(np.int64)]
    return pixels.astype(np.float64) + 0.5, chosen


WEIGHTS = ("da3/da3-small.safetensors",)
PACKAGE = "safetensors"  # reads them


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Depth Anything 3 as a prior: it proposes matches, and gives depth once it was told the verified cameras."""

    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 504  # of the network's images, pixels: what it was published with
    views_at_once: Internal[int] = 12  # photographs that look at each other: memory and time grow with their square
    seed: Internal[int] = 0  # every prior has one; this one draws no random numbers


class Da3Prior(Prior):
    """Matches by warping one photograph into another's view, depth from the network given registered cameras.

    The network's own cameras serve the warping alone; matches are verified as plain ones are. Depth maps are brought
    to the scale of the registered points that each camera sees.
    """

    def __init__(self, network: Network, config: Config) -> None:
        self._network, self._config = network, config
        self.matcher = WarpMatcher(network, config.longer_side)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, run: RunContext = BACKGROUND
    ) -> tuple[Pointmap, ...]:
        found = []
        cameras, at_once = registration.cameras, self._config.views_at_once
        for start in range(0, len(cameras), at_once):
            some = cameras[start : start + at_once]
            keyframes = [graph.keyframes[camera.index] for camera in some]
            known = [KnownCamera(camera.T_world_camera, camera.focal) for camera in some]
            for camera, answer in zip(
                some, estimate_keyframes(self._network, keyframes, self._config.longer_side, known), strict=True
            ):
                depth, sure = answer.estimate.depth, answer.estimate.confidence
                found.append(make_registered_pointmap(graph, registration, camera, answer.crop, depth, sure))
            run.pause()
        return tuple(found)


def load(config: Config) -> Da3Prior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are another network's."""
    return Da3Prior(load_network(config.weights or find(*WEIGHTS)), config)
