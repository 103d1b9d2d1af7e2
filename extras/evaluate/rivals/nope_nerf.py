"""NoPe-NeRF (Bian et al. 2023): as NeRF--, held by depth maps whose scale and offset are learnt view by view.

As published: the weights of the losses (depth 0.04; point clouds 1 and surface colours 1 between consecutive frames,
until the relative poses stand), and a focal length that is known. Compact as nerfmm is. A monocular network's place
takes known depth (methods.py), each map divided by its median so that its scale has to be found; it also gives the
focal length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.methods import FrameWithDepth
from splatnode.extras.evaluate.rivals import nerfmm
from splatnode.extras.evaluate.rivals.nerfmm import OPTIMIZE, SIZE, Focal, make_field_snapshot, sample_pixels
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.result.snapshot import Snapshot

_DEPTH, _CLOUD, _SURFACE = 0.04, 1.0, 1.0  # weights
_PAIRS_UNTIL = 0.6  # of the run
_POINTS = 384  # of each view's cloud


def reconstruct(frames: Sequence[Frame], seed: int, config: nerfmm.FitConfig = OPTIMIZE) -> Iterator[Snapshot]:
    """Snapshots of the field while it is learnt; one refusal where fewer than three frames have a depth."""
    return methods.optimize_with_depth(frames, seed, lambda known, _clock: _fit_with_depth(frames, known, seed, config))


def _fit_with_depth(
    frames: Sequence[Frame], known: Sequence[FrameWithDepth], seed: int, config: nerfmm.FitConfig
) -> Iterator[Snapshot]:
    by_name = {frame.name: frame for frame in frames}
    registered = [by_name[frame.name] for frame in known]
    views = [_make_view_with_depth(frame) for frame in known]
    focal = Focal(float(np.mean([frame.K[0, 0] / max(frame.image.shape) for frame in known]))).requires_grad_(False)
    terms = ExtraLosses(views, focal)
    learnt = nerfmm.fit_field(
        [view.image for view in views],
        [view.used for view in views],
        focal,
        config,
        seed=seed,
        further=terms,
        beside=(terms.scales, terms.offsets),
    )
    yield from (make_field_snapshot(frames, registered, each) for each in learnt)


@dataclass(frozen=True, eq=False)
class ViewWithDepth:
    image: Tensor  # (h, w, 3)
    depth: Tensor  # (h, w), whose median is 1
    used: Tensor | None = None  # (h, w) where its colours count; None: everywhere


def _make_view_with_depth(frame: FrameWithDepth) -> ViewWithDepth:
    image = resize_image(frame.image, SIZE)
    depth = cv2.resize(frame.depth, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_NEAREST)
    used = None if frame.mask is None else torch.from_numpy(resize_mask(frame.mask, *image.shape[:2]))
    depth = torch.from_numpy(depth / np.float32(np.median(depth))).float()
    return ViewWithDepth(torch.from_numpy(image).float() / 255.0, depth, used)


class ExtraLosses:
    """The losses beside the colours', with the scale and offset of each view's depth; the first one's is the unit."""

    def __init__(self, views: Sequence[ViewWithDepth], focal: Focal) -> None:
        self._views, self._focal = views, focal
        self.scales = nn.Parameter(torch.ones(len(views) - 1))
        self.offsets = nn.Parameter(torch.zeros(len(views) - 1))

    def __call__(self, step: nerfmm.FitStep) -> Tensor:
        columns, rows = step.pixels.long().unbind(1)
        loss = _DEPTH * (step.rays.depth - self._depth(step.view)[rows, columns]).abs().mean()
        if step.progress >= _PAIRS_UNTIL:
            return loss
        first = min(step.view, len(self._views) - 2)
        Ts = [step.cameras.T_world_camera(index) for index in (first, first + 1)]
        T_second_first = torch.linalg.inv(Ts[1]) @ Ts[0]
        cloud = self.compute_cloud(first) @ T_second_first[:3, :3].T + T_second_first[:3, 3]
        return (
            loss
            + _CLOUD * compute_chamfer_distance(cloud, self.compute_cloud(first + 1))
            + _SURFACE * self.compute_surface_loss(first, cloud)
        )

    def compute_surface_loss(self, first: int, cloud: Tensor) -> Tensor:
        """Mean difference between a view's colours and the next one's where that sees them, `cloud` (M, 3)."""
        view, other = self._views[first], self._views[first + 1]
        pixels = (cloud @ self._K(other).T)[:, :2] / cloud[:, 2:].clamp_min(1e-3)
        size = torch.tensor([other.image.shape[1], other.image.shape[0]])
        inside = (cloud[:, 2] > 1e-3) & (pixels > 0).all(1) & (pixels < size).all(1)
        grid = (2 * pixels / size - 1)[None, None]
        colours = other.image.permute(2, 0, 1)[None]
        shown = functional.grid_sample(colours, grid, padding_mode="border", align_corners=False)[0, :, 0].T
        columns, rows = _sample_pixels(view).long().unbind(1)
        difference = (shown - view.image[rows, columns]).abs().mean(1)
        return (difference * inside).sum() / inside.sum().clamp_min(1)

    def compute_cloud(self, index: int) -> Tensor:
        """(M, 3) points of a view in its camera's frame."""
        view = self._views[index]
        pixels, K = _sample_pixels(view), self._K(view)
        columns, rows = pixels.long().unbind(1)
        rays = torch.cat([(pixels - K[:2, 2]) / torch.diagonal(K)[:2], torch.ones_like(pixels[:, :1])], 1)
        return rays * self._depth(index)[rows, columns][:, None]

    def _depth(self, index: int) -> Tensor:
        depth = self._views[index].depth
        return depth if index == 0 else self.scales[index - 1] * depth + self.offsets[index - 1]

    def _K(self, view: ViewWithDepth) -> Tensor:
        return self._focal.K(view.image.shape[1], view.image.shape[0])


def compute_chamfer_distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean distance of points (M, 3) to the nearest of the others (N, 3), and the other way round."""
    distances = torch.cdist(a, b)
    return distances.amin(1).mean() + distances.amin(0).mean()


def _sample_pixels(view: ViewWithDepth) -> Tensor:
    return sample_pixels(view.image.shape[1], view.image.shape[0], _POINTS)
