"""Scores by region: of the pixels that two training photographs show, or one, or none; and which ones they are.

What no photograph shows can only be guessed, and a mean over whole photographs mixes the guess with what was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera
from splatnode.recon.geometry import project, transform_to_camera
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.networks.lpips import Lpips
from splatnode.recon.optimize import photometric_losses
from splatnode.recon.priors import stereo
from splatnode.recon.priors.stereo import DepthMap
from splatnode.recon.rasterize.reference import Render
from splatnode.recon.result.export import sanitize_gaussians
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot

Counts = npt.NDArray[np.uint8]  # (H, W) how many training photographs show a pixel, at most 2; UNKNOWN
Region = Literal["shown", "two", "one", "none"]

UNKNOWN = 255  # nothing tells where the pixel's surface is
REGIONS: tuple[Region, ...] = ("shown", "two", "one", "none")  # "shown": by one or more
_LEAST_SHARE = 0.02  # of a photograph's pixels: a smaller region of it says more about its border than about itself


@dataclass(frozen=True)
class RegionScore:
    """Means over the held-out photographs that have enough of a region; None where none has."""

    share_pct: float  # of all pixels of all held-out photographs
    psnr: float | None = None  # dB
    ssim: float | None = None
    lpips_alex: float | None = None


@dataclass(frozen=True, eq=False)
class ErrorMaps:
    """How one render differs from its photograph, for each pixel (H, W), and what shows the pixel."""

    squared: Tensor  # mean over the colours
    ssim: Tensor
    lpips: Tensor | None
    counts: Counts


def compute_error_maps(image: Tensor, truth: Tensor, counts: Counts, network: Lpips | None) -> ErrorMaps:
    """Maps the errors of a render, (H, W, 3) in [0, 1]. Raises ValueError if `counts` differs in size."""
    if counts.shape != tuple(truth.shape[:2]):
        raise ValueError(f"counts must be {tuple(truth.shape[:2])} like the photograph, got {counts.shape}")
    planes = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    return ErrorMaps(
        squared=((image.double() - truth.double()) ** 2).mean(2),
        ssim=photometric_losses.ssim(*planes).mean(0),
        lpips=None if network is None else network.map(image, truth),
        counts=counts,
    )


def compute_region_scores(views: Sequence[ErrorMaps]) -> dict[str, RegionScore]:
    """A score a region, over `views`; empty where there are none."""
    return {region: _score_region(views, region) for region in REGIONS} if views else {}


def mask_region(counts: Counts, region: Region) -> npt.NDArray[np.bool_]:
    """(H, W) the pixels of a region."""
    members: Mapping[Region, tuple[int, ...]] = {"shown": (1, 2), "two": (2,), "one": (1,), "none": (0,)}
    return np.isin(counts, members[region])


def _score_region(views: Sequence[ErrorMaps], region: Region) -> RegionScore:
    masks = [mask_region(view.counts, region) for view in views]
    share = 100.0 * sum(int(mask.sum()) for mask in masks) / sum(mask.size for mask in masks)
    enough = [(view, torch.from_numpy(m)) for view, m in zip(views, masks, strict=True) if m.mean() >= _LEAST_SHARE]
    if not enough:
        return RegionScore(share)
    perceptual = [float(view.lpips[mask].mean()) for view, mask in enough if view.lpips is not None]
    return RegionScore(
        share_pct=share,
        psnr=float(np.mean([-10.0 * np.log10(max(float(view.squared[mask].mean()), 1e-10)) for view, mask in enough])),
        ssim=float(np.mean([float(view.ssim[mask].mean()) for view, mask in enough])),
        lpips_alex=float(np.mean(perceptual)) if perceptual else None,
    )


# What a benchmark asks of a scene: how it looks from a camera. Gaussians are one answer, a radiance field another.

Array = npt.NDArray[np.float64]
Rasterize = Callable[..., Render]


class Appearance(Protocol):
    """A finished scene as a function from cameras to images."""

    @property
    def num_gaussians(self) -> int | None:
        """None for a scene that is not made of them."""
        ...

    @property
    def num_bytes(self) -> int:
        """Returns the size of the scene as it would be published."""
        ...

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of what a camera has before it."""
        ...

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        """Mean absolute difference to `image` (H, W, 3), scalar, differentiable with respect to the pose (4, 4).

        Where `used` (H, W) says so, which it does somewhere; None: everywhere.
        """
        ...

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        """(H, W, 3) the image; above 1 where it is brighter than white."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldSnapshot(Snapshot):
    """The snapshot of a method without Gaussians; `appearance` is pickled from process to process."""

    appearance: Appearance


def make_appearance(snapshot: Snapshot, rasterize: Rasterize) -> Appearance | None:
    """How a snapshot's scene looks; None where its verdict forbids publishing it, or it has none."""
    if not snapshot.verdict.publishable:
        return None
    if isinstance(snapshot, FieldSnapshot):
        return snapshot.appearance
    gaussians = sanitize_gaussians(snapshot.gaussians)
    return GaussianAppearance(gaussians, rasterize) if len(gaussians) else None


class GaussianAppearance:
    """Gaussians on black."""

    def __init__(self, gaussians: GaussianArrays, rasterize: Rasterize) -> None:
        self._gaussians, self._rasterize = gaussians, rasterize
        arrays = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
        self._tensors = [torch.from_numpy(array) for array in arrays]

    @property
    def num_gaussians(self) -> int:
        return len(self._gaussians)

    @property
    def num_bytes(self) -> int:
        return compute_ply_bytes(len(self._gaussians), self._gaussians.sh.shape[1])

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of the Gaussians in front of the camera; 1 where there are none."""
        z = (self._gaussians.means - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        ahead = z[z > 0]
        return float(np.median(ahead)) if len(ahead) else 1.0

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        height, width = image.shape[:2]
        rgb = self._rasterize(*self._tensors, T_world_camera, K, width, height, channels=("rgb",)).rgb
        if rgb is None:
            raise ValueError("the rasteriser was asked for the channel rgb and gave none")
        off = (rgb - image).abs()
        return (off if used is None else off[used]).mean()

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        return torch.from_numpy(render_arrays(self._gaussians, T_world_camera, K, width, height).rgb)


# Which pixels of a held-out photograph the training photographs show: by no method that is measured.
#
# The depth of every photograph of the scene, those held out included, is that of stereo with the true cameras. A
# pixel's surface is shown by a training photograph where it lies within it and nothing that this photograph sees
# stands before it. Made once for each scene; it is read by nothing but the scores.

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]

_AGREEING = 1  # further photographs that see a pixel's depth as well
_OFF = 0.1  # of a surface's depth: what is nearer by more stands before it
_REACH_PX = 16.0  # a pixel without depth takes that of the nearest that has one, if it is so near
_NEIGHBOURS = 4  # photographs that each is matched with, to know how far stereo has to search
_RATIO = 0.8  # of a match's distance to the second best (Lowe 2004)
_EPIPOLAR_PX = 2.0
_RANGE_MARGIN = 2.0  # times what matched points reach, nearer and farther, is searched


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that an image sees, by its true camera."""

    T_world_camera: Array  # (4, 4)
    K: Array  # (3, 3), of a photograph of this size
    depth: npt.NDArray[np.float32]  # (h, w) z, 0 where unknown
    used: Mask | None = None  # (h, w) False where a mask hides the photograph; None: nowhere

    def pixels(self, points: Array) -> tuple[Mask, Indices, Indices, Array]:
        """(M,) which points (M, 3) lie within the photograph; the row and column of each, 0 beyond it; its depth z."""
        height, width = self.depth.shape
        in_camera = transform_to_camera(points, self.T_world_camera)
        z = in_camera[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.nan_to_num(project(in_camera, self.K), nan=-1.0, posinf=-1.0, neginf=-1.0).T
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return inside, np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int), z


def compute_surfaces(scene: EvaluationScene, longer_side: int) -> dict[str, Surface]:
    """The surfaces that the photographs with a true camera see, at `longer_side` pixels, by name."""
    given = {name: scene.load_masked_image(name) for name in scene.cameras}
    images = {name: resize_image(image, longer_side) for name, (image, _) in given.items()}
    used = {
        name: None if mask.all() else resize_mask(mask, *images[name].shape[:2]) for name, (_, mask) in given.items()
    }
    ranges = _estimate_depth_ranges(images, scene.cameras)
    views = {
        name: stereo.StereoView(image, _K(scene.cameras[name], image), scene.cameras[name].T_world_camera, ranges[name])
        for name, image in images.items()
        if name in ranges
    }
    maps = stereo.estimate_depth_maps(list(views.values()), stereo.StereoConfig())
    return {
        name: Surface(
            view.T_world_camera, view.K, _fill_small_holes(_select_consistent_depth(each, used[name])), used[name]
        )
        for (name, view), each in zip(views.items(), maps, strict=True)
    }


def _select_consistent_depth(found: DepthMap, used: Mask | None) -> npt.NDArray[np.float32]:
    """(h, w) the depth that another photograph confirms, of what is used; 0 elsewhere."""
    sure = found.num_consistent >= _AGREEING
    return found.depth * (sure if used is None else sure & used)


def count_visibility(view: Surface, training: Sequence[Surface]) -> Counts:
    """(h, w) how many of the training photographs show each pixel of `view`: 0, 1, 2 for more; UNKNOWN."""
    rows, columns = np.nonzero(view.depth > 0)
    z = np.asarray(view.depth[rows, columns], np.float64)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1) @ np.linalg.inv(view.K).T
    points = (rays * z[:, None]) @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    shown = np.zeros(len(points), int)
    for each in training:
        shown += _compute_visibility(each, points)
    counts = np.full(view.depth.shape, UNKNOWN, np.uint8)
    counts[rows, columns] = np.minimum(shown, 2)
    return counts


def count_visibility_by_name(
    names: Iterable[str], views: Mapping[str, Surface], training: Sequence[Surface]
) -> dict[str, Counts]:
    """`count_visibility` of those photographs whose surface is known, by name."""
    return {name: count_visibility(views[name], training) for name in names if name in views}


def _compute_visibility(camera: Surface, points: Array) -> Mask:
    """(M,) which points (M, 3) lie within a photograph and are not hidden there, by what stands before or by a mask."""
    inside, row, column, z = camera.pixels(points)
    before = camera.depth[row, column]
    shows = inside & ((before == 0) | (z <= (1 + _OFF) * before))
    return shows if camera.used is None else shows & camera.used[row, column]


def _fill_small_holes(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Fills small holes with the nearest depth."""
    known = depth > 0
    if not known.any():
        return depth.astype(np.float32)
    away, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(labels, np.int64)
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[known]] = depth[known]
    return np.where(away <= _REACH_PX, by_label[nearest], 0).astype(np.float32)


def _estimate_depth_ranges(
    images: Mapping[str, Image], cameras: Mapping[str, TrueCamera]
) -> dict[str, tuple[float, float]]:
    """Nearest and farthest depth to search in each photograph that shares enough points with others."""
    sift, matcher = cv2.SIFT.create(4000), cv2.BFMatcher(cv2.NORM_L2)
    found = {name: sift.detectAndCompute(image, None) for name, image in images.items()}
    depths: dict[str, list[Array]] = {name: [] for name in images}
    for first, second in _select_pairs(cameras, list(images)):
        (points, codes), (others, other_codes) = found[first], found[second]
        if min(len(points), len(others)) < 2:
            continue
        pairs = [best for best, next_best in matcher.knnMatch(codes, other_codes, k=2)
                 if best.distance < _RATIO * next_best.distance]  # fmt: skip
        a = np.array([points[match.queryIdx].pt for match in pairs]).reshape(-1, 2) + 0.5
        b = np.array([others[match.trainIdx].pt for match in pairs]).reshape(-1, 2) + 0.5
        world = _triangulate(a, b, *(_compute_projection(cameras[name], images[name]) for name in (first, second)))
        fits = np.ones(len(world), bool)
        for name, pixels in ((first, a), (second, b)):
            in_camera = transform_to_camera(world, cameras[name].T_world_camera)
            with np.errstate(divide="ignore", invalid="ignore"):
                off = np.linalg.norm(project(in_camera, _K(cameras[name], images[name])) - pixels, axis=1)
            fits &= (in_camera[:, 2] > 0) & (off < _EPIPOLAR_PX)
        for name in (first, second):
            depths[name].append(transform_to_camera(world[fits], cameras[name].T_world_camera)[:, 2])
    known = {name: np.concatenate(each) for name, each in depths.items() if each}
    return {name: stereo.estimate_depth_range(z, _RANGE_MARGIN) for name, z in known.items() if len(z) >= 20}


def _select_pairs(cameras: Mapping[str, TrueCamera], names: Sequence[str]) -> list[tuple[str, str]]:
    """Each photograph with those that look most alike in direction, of which the nearest."""
    axes = np.stack([cameras[name].T_world_camera[:3, 2] for name in names])
    centres = np.stack([cameras[name].T_world_camera[:3, 3] for name in names])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    cost = apart / max(float(np.median(apart)), 1e-12) + 2.0 * (1.0 - axes @ axes.T)
    np.fill_diagonal(cost, np.inf)
    chosen = {frozenset((i, int(j))) for i in range(len(names)) for j in np.argsort(cost[i])[:_NEIGHBOURS]}
    return [(names[i], names[j]) for i, j in combinations(range(len(names)), 2) if frozenset((i, j)) in chosen]


def _triangulate(a: Array, b: Array, P: Array, Q: Array) -> Array:
    """(M, 3) the points of pixels (M, 2) in two photographs with projections (3, 4)."""
    if not len(a):
        return np.zeros((0, 3))
    homogeneous = cv2.triangulatePoints(P, Q, a.T, b.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num((homogeneous[:3] / homogeneous[3]).T)


def _compute_projection(camera: TrueCamera, image: Image) -> Array:
    return _K(camera, image) @ np.linalg.inv(camera.T_world_camera)[:3]


def _K(camera: TrueCamera, image: Image) -> Array:
    return camera.K_for(image.shape[1], image.shape[0])
