"""CF-3DGS (Fu et al. 2024): frame by frame, without known poses.

For each frame Gaussians are made from its depth and fitted to it alone; the rigid motion under which they look like the
next frame, with all else frozen, is its pose. The scene starts from the first frame and is refined with all frames so
far after each new one, with adaptive density control.

As published: this order, the losses, and the step sizes of 3DGS. Compact: photographs of 512 pixels; a Gaussian for
every ninth pixel; and, but for `PUBLISHED`, 60 iterations for a frame alone, 200 for a motion, 60 after each frame. The
500 at the end are ours. A monocular network's place takes known depth (methods.py), which also gives the focal length.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import torch
from torch import Tensor

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.methods import FrameWithDepth
from splatnode.extras.evaluate.protocol import find_test_pose
from splatnode.extras.evaluate.regions import GaussianAppearance
from splatnode.extras.evaluate.rivals import colmap_3dgs
from splatnode.recon.optimize import training
from splatnode.recon.optimize.control import ControlChoice, adaptive
from splatnode.recon.priors import compute_world_points
from splatnode.recon.rasterize import rasterize
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from splatnode.recon.scene.initialization import gaussians_at
from splatnode.recon.threads import Clock


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    alone: int = 60  # iterations of a frame's own Gaussians
    motion: int = 200  # steps to the next frame's pose
    motion_rate: float = 0.01  # their size at the start, in radians and in parts of the depth
    growing: int = 60  # iterations with all frames so far
    final: int = 500  # with all frames
    stride: int = 3  # between the pixels that get a Gaussian
    opacity: float = 0.5  # of a Gaussian that starts from a pixel


PUBLISHED = Config(alone=1000, motion=300, growing=1000)  # as the authors' program has it for a short film
_MOTION_FINAL = 0.1  # part of the steps' size at their end: the next frame may be far away
_ALONE = msgspec.structs.replace(colmap_3dgs.OPTIMIZE, checkpoints=(), control=None)
_TOGETHER = msgspec.structs.replace(
    _ALONE,
    control=ControlChoice("adaptive", adaptive.Config(start=0.0, end=0.8, reset_every=adaptive.NEVER)),
)


def reconstruct(frames: Sequence[Frame], seed: int, config: Config | None = None) -> Iterator[Snapshot]:
    """Snapshots of the scene while all frames refine it; one refusal where fewer than three have a depth."""
    settings = config or Config()
    return methods.optimize_with_depth(
        frames, seed, lambda known, clock: _reconstruct_frame_by_frame(frames, known, seed, settings, clock)
    )


def _reconstruct_frame_by_frame(
    frames: Sequence[Frame], known: Sequence[FrameWithDepth], seed: int, config: Config, clock: Clock
) -> Iterator[Snapshot]:
    scene = Scene((_make_training_view(known[0], np.eye(4)),), _initialize_from_depth(known[0], np.eye(4), config))
    for frame, following in pairwise(known):
        T_world_camera = _estimate_next_pose(frame, scene.views[-1], following, seed, config)
        scene = replace(scene, views=(*scene.views, _make_training_view(following, T_world_camera)))
        scene = _refine_scene(scene, _TOGETHER, config.growing, seed)
    clock.lap("poses")
    together = msgspec.structs.replace(_TOGETHER, iterations=config.final, checkpoints=(config.final // 3,))
    refined = training.refine(scene, colmap_3dgs.scale_rates_to_extent(together, scene), seed=seed)
    yield from (methods.make_snapshot(frames, each) for each in refined)


def _estimate_next_pose(
    frame: FrameWithDepth, view: TrainingView, following: FrameWithDepth, seed: int, config: Config
) -> np.ndarray:
    """(4, 4) T_world_camera from which the Gaussians of `frame` alone look like the following frame."""
    T_world_camera = view.T_world_camera.double().numpy()
    alone = Scene((view,), _initialize_from_depth(frame, T_world_camera, config))
    fitted = _refine_scene(alone, _ALONE, config.alone, seed)
    image = torch.from_numpy(following.image).float() / 255.0
    look = _SingleFrameAppearance(fitted.arrays(), rasterize)
    aligned = find_test_pose(
        look,
        image,
        T_world_camera,
        following.K,
        steps=config.motion,
        levels=3,
        learning_rate=config.motion_rate,
        final=_MOTION_FINAL,
        used=None if following.mask is None else torch.from_numpy(following.mask),
    )
    return aligned.T_world_camera


class _SingleFrameAppearance(GaussianAppearance):
    """Gaussians of a single frame: another one is compared with them where they are, and not beside its border."""

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        height, width = image.shape[:2]
        render = self._rasterize(*self._tensors, T_world_camera, K, width, height, channels=("rgb", "alpha"))
        assert render.rgb is not None and render.alpha is not None  # they were asked for
        covered = (render.alpha.detach() > 0.5)[..., None]
        covered = covered if used is None else covered & used[..., None]
        return ((render.rgb - image).abs() * covered).sum() / (3 * covered.sum().clamp_min(1))


def _refine_scene(scene: Scene, config: training.RefinementConfig, iterations: int, seed: int) -> Scene:
    """One view has no extent: lengths are then in parts of its depth, which is about 1."""
    config = msgspec.structs.replace(config, iterations=iterations)
    if len(scene.views) > 1:
        config = colmap_3dgs.scale_rates_to_extent(config, scene)
    (last,) = deque(training.refine(scene, config, seed=seed), maxlen=1)
    return last


def _make_training_view(frame: FrameWithDepth, T_world_camera: np.ndarray) -> TrainingView:
    T, K = torch.from_numpy(T_world_camera).float(), torch.from_numpy(frame.K).float()
    return TrainingView(frame.name, frame.frame_id, frame.image, T, K, mask=frame.mask)


def _initialize_from_depth(frame: FrameWithDepth, T_world_camera: np.ndarray, config: Config) -> Gaussians:
    """A Gaussian for every `stride`-th pixel of every such row that is used."""
    chosen = slice(config.stride // 2, None, config.stride), slice(config.stride // 2, None, config.stride)
    points = compute_world_points(frame.depth, T_world_camera, frame.K)[chosen].reshape(-1, 3)
    rgb = (frame.image[chosen].reshape(-1, 3) / 255.0).astype(np.float32)
    if frame.mask is not None:
        used = frame.mask[chosen].reshape(-1)
        points, rgb = points[used], rgb[used]
    source_frame = np.full(len(points), frame.frame_id, np.int32)
    return gaussians_at(np.ascontiguousarray(points), rgb, source_frame, config.opacity)
