"""COLMAP's cameras and points, then FSGS (Zhu et al. 2024): Gaussians are grown into the gaps between few points.

As published: the weight of the correlation with a known depth, on training and on pseudo views, the threshold of
adaptive density control, three neighbours, and Gaussians added from a twentieth of the run on until shortly before its
end. Compact: no resets of opacities, at most 100 000 Gaussians; and, but for `PUBLISHED`, 1500 iterations for 10 000.
Where FSGS asks a monocular network, our multi-view depth serves, with COLMAP's cameras; a pseudo view's is that of its
points. How far apart points must be is given without units, so that ours is in parts of the scene's extent.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import msgspec

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.rivals import colmap_3dgs
from splatnode.extras.evaluate.rivals.colmap import SparseModel
from splatnode.recon.optimize import regularizers, training
from splatnode.recon.optimize.control import ControlChoice, adaptive, proximity
from splatnode.recon.optimize.losses import LossChoice, depth
from splatnode.recon.priors import Pointmap, classical, stereo
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.scene import Scene

_WHOLE = 1_000_000  # pixels of a patch: all of an image is one, as FSGS correlates it
_DEPTH = regularizers.RegularizerConfig(
    {"depth": LossChoice("depth", depth.Config(0.05, 0.2, 0.95, patch=_WHOLE, share=1.0))}, min_confidence=0.1
)
_ADAPTIVE = adaptive.Config(min_gradient=5e-4, start=0.05, end=0.95, reset_every=adaptive.NEVER)
OPTIMIZE = msgspec.structs.replace(
    colmap_3dgs.OPTIMIZE, regularizers=_DEPTH, control=ControlChoice("proximity", proximity.Config(_ADAPTIVE))
)
_EVERY_100 = msgspec.structs.replace(_ADAPTIVE, every=100)
PUBLISHED = msgspec.structs.replace(  # as long as in the publication
    OPTIMIZE, iterations=10_000, checkpoints=(), control=ControlChoice("proximity", proximity.Config(_EVERY_100))
)


def reconstruct(frames: Sequence[Frame], seed: int, config: training.RefinementConfig = OPTIMIZE) -> Iterator[Snapshot]:
    """Snapshots of the scene while it is optimised; one refusal where COLMAP places fewer than three frames."""
    yield from colmap_3dgs.optimize_sparse_model(frames, seed, config, initialize_scene_with_depth)


def initialize_scene_with_depth(model: SparseModel, seed: int) -> Scene:
    """The scene that 3DGS starts from, with a depth for every view.

    Where a view observes too few points, all of the model tell the range of its depth.
    """
    scene = colmap_3dgs.initialize_scene(model, seed)
    Ts, Ks = ([getattr(view, name).double().numpy() for view in scene.views] for name in ("T_world_camera", "K"))
    views, sparse = [], []
    for view, T, K, seen in zip(scene.views, Ts, Ks, model.observed, strict=True):
        points = (model.points[seen] - T[:3, 3]) @ T[:3, :3]
        points = points[points[:, 2] > 0]
        pixels = points @ K.T
        range_points = points if len(points) >= stereo.MIN_SPARSE_POINTS else (model.points - T[:3, 3]) @ T[:3, :3]
        near, far = stereo.estimate_depth_range(range_points[:, 2])
        views.append(stereo.StereoView(view.image, K, T, (near, classical.Config().far_margin * far)))
        sparse.append(stereo.SparsePoints(pixels[:, :2] / pixels[:, 2:], points[:, 2]))
    maps = stereo.estimate_depth_maps(views, stereo.StereoConfig(), seed=seed, sparse=sparse)
    known = [
        replace(view, pointmap=Pointmap(view.name, view.frame_id, found.depth, found.confidence, found.normal, T, K))
        for view, found, T, K in zip(scene.views, maps, Ts, Ks, strict=True)
    ]
    return replace(scene, views=tuple(known))
