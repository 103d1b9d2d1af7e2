"""The cameras of stock COLMAP and GLOMAP (recon/evaluate/rivals/colmap.py) as a snapshot without Gaussians."""

from __future__ import annotations

from collections.abc import Iterable

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.evaluate.rivals.colmap import (
    Mapper,
    RegisteredFrame,
    map_globally,
    map_incrementally,
    reconstruct_sparse_model,
)
from splatnode.recon.evaluate.rivals.outcome import make_verdict
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot


def colmap(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """Incremental mapping."""
    return _reconstruct(frames, config, map_incrementally)


def glomap(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig) -> Snapshot:
    """Global mapping."""
    return _reconstruct(frames, config, map_globally)


def _reconstruct(frames: Iterable[Frame | DroppedFrame], config: ReconstructionConfig, mapping: Mapper) -> Snapshot:
    usable = [frame for frame in frames if isinstance(frame, Frame)]
    model = reconstruct_sparse_model(usable, config.seed, mapping)
    registered = () if model is None else model.registered
    found = make_verdict(usable, {each.frame.name for each in registered})
    return Snapshot(
        sequence=1,
        verdict=found,
        cameras=tuple(map(make_camera_estimate, registered)) if found.publishable else (),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        final=True,
    )


def make_camera_estimate(registered: RegisteredFrame) -> CameraEstimate:
    """The camera of a registered frame, for the frame at full size; nothing is claimed of it."""
    frame = registered.frame
    return CameraEstimate(
        frame.name,
        frame.frame_id,
        registered.T_world_camera,
        registered.intrinsics.K,
        frame.width,
        frame.height,
    )
