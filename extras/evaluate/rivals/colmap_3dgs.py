"""COLMAP's cameras and points, then 3D Gaussian splatting (Kerbl et al. 2023) with adaptive density control.

As published: initial sizes and opacities, step sizes and their fall, loss, thresholds, and the share of the run in
which Gaussians are added and taken away. Compact: photographs of 512 pixels, and colours that do not depend on the
direction; and, but for `PUBLISHED`, 1500 iterations for 7000 or 30 000, two resets of the opacities for four, at most
100 000 Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import msgspec
import numpy as np
import torch

from splatnode.capture.frame import Frame
from splatnode.capture.lenses import undistort_frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.rivals.colmap import RegisteredFrame, SparseModel, reconstruct_sparse_model
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.optimize import ensemble, training
from splatnode.recon.optimize.control import ControlChoice, adaptive
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Scene, TrainingView
from splatnode.recon.scene.initialization import gaussians_at
from splatnode.recon.threads import Clock

SIZE = 512  # longer side of the photographs, pixels
_OPACITY = 0.1  # of a Gaussian that starts from a point

RATES = training.LearningRates(
    means=1.6e-4,  # times the extent of the scene
    means_unit="depth",
    quats=1e-3,
    log_scales=5e-3,
    logit_opacities=5e-2,
    sh=2.5e-3,
    final_means=0.01,
    final=1.0,
)
OPTIMIZE = training.RefinementConfig(
    iterations=1500,
    checkpoints=(250, 900),
    ssim_lambda=0.2,
    dropout=ensemble.DropoutConfig(share=0.0),
    refine_poses=False,
    lr=RATES,
    control=ControlChoice("adaptive", adaptive.Config()),
)
# The shorter one of the publication's two runs: what the longer one of 30 000 iterations has after 7000
_SHORTER = 7_000 / 30_000
PUBLISHED = msgspec.structs.replace(
    OPTIMIZE,
    iterations=7_000,
    checkpoints=(),
    lr=msgspec.structs.replace(RATES, final_means=RATES.final_means**_SHORTER),
    control=ControlChoice(
        "adaptive",
        adaptive.Config(every=100, start=500 / 7_000, end=1.0, reset_every=3_000 / 7_000, max_gaussians=10_000_000),
    ),
)


def reconstruct(frames: Sequence[Frame], seed: int, config: training.RefinementConfig = OPTIMIZE) -> Iterator[Snapshot]:
    """Snapshots of the scene while it is optimised; one refusal where COLMAP places fewer than three frames."""
    yield from optimize_sparse_model(frames, seed, config, initialize_scene)


def optimize_sparse_model(
    frames: Sequence[Frame],
    seed: int,
    config: training.RefinementConfig,
    beginning: Callable[[SparseModel, int], Scene],
) -> Iterator[Snapshot]:
    """The same from what `beginning` makes of COLMAP's model and the seed."""
    clock = Clock()
    model = reconstruct_sparse_model(frames, seed)
    clock.lap("poses")
    if model is None or len(model.registered) < methods.MIN_CAMERAS:
        yield methods.make_refusal(frames, clock)
        return
    yield from refine_sparse_model(frames, model, seed, config, beginning, clock)


def refine_sparse_model(
    frames: Sequence[Frame],
    model: SparseModel,
    seed: int,
    config: training.RefinementConfig,
    beginning: Callable[[SparseModel, int], Scene],
    clock: Clock,
) -> Iterator[Snapshot]:
    """The same from a model of the frames that is there, whoever made it."""
    scene = beginning(model, seed)
    clock.lap("points")
    refined = training.refine(scene, scale_rates_to_extent(config, scene), seed=seed)
    yield from methods.number_snapshots((methods.make_snapshot(frames, each) for each in refined), clock)


def initialize_scene(model: SparseModel, _seed: int) -> Scene:
    """The model's cameras, and a Gaussian for each of its points."""
    rgb = (model.colours / 255.0).astype(np.float32)
    first_seen = np.zeros(len(model.points), np.int32)
    for registered, seen in reversed(list(zip(model.registered, model.observed, strict=True))):
        first_seen[seen] = registered.frame.frame_id
    gaussians = gaussians_at(model.points.astype(np.float32), rgb, first_seen, _OPACITY)
    return Scene(tuple(map(make_training_view, model.registered)), gaussians)


def make_training_view(registered: RegisteredFrame) -> TrainingView:
    """A registered frame without its lens' distortion, at modelled size; what its mask hides is not fitted."""
    frame = undistort_frame(replace(registered.frame, intrinsics=registered.intrinsics))
    assert frame.intrinsics is not None  # COLMAP's
    image = resize_image(frame.image, SIZE)
    K = frame.intrinsics.resized(image.shape[1], image.shape[0]).K
    T_world_camera = torch.from_numpy(registered.T_world_camera).float()
    mask = None if registered.frame.mask is None or frame.mask is None else resize_mask(frame.mask, *image.shape[:2])
    return TrainingView(
        frame.name,
        frame.frame_id,
        image,
        T_world_camera,
        torch.from_numpy(K).float(),
        mask=mask,
        lens=registered.intrinsics if any(registered.intrinsics.distortion) else None,
    )


def scale_rates_to_extent(config: training.RefinementConfig, scene: Scene) -> training.RefinementConfig:
    """The configuration with the means' step size in parts of the extent of the scene."""
    means = config.lr.means * adaptive.extent([view.T_world_camera for view in scene.views])
    return msgspec.structs.replace(config, lr=msgspec.structs.replace(config.lr, means=means))
