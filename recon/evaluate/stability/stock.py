"""The cameras of stock COLMAP and GLOMAP (recon/evaluate/rivals/colmap.py) as a snapshot without Gaussians."""

from __future__ import annotations

from collections.abc import Iterable

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import Config
from splatnode.recon.evaluate.rivals.colmap import Mapper, RegisteredFrame, global_, incremental, sparse_model
from splatnode.recon.evaluate.rivals.outcome import verdict
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot


def colmap(frames: Iterable[Frame | DroppedFrame], config: Config) -> Snapshot:
    """Incremental mapping."""
    return _reconstructed(frames, config, incremental)


def glomap(frames: Iterable[Frame | DroppedFrame], config: Config) -> Snapshot:
    """Global mapping."""
    return _reconstructed(frames, config, global_)


def _reconstructed(frames: Iterable[Frame | DroppedFrame], config: Config, mapping: Mapper) -> Snapshot:
    usable = [frame for frame in frames if isinstance(frame, Frame)]
    model = sparse_model(usable, config.seed, mapping)
    registered = () if model is None else model.registered
    found = verdict(usable, {each.frame.name for each in registered})
    return Snapshot(
        sequence=1,
        verdict=found,
        cameras=tuple(map(camera_estimate, registered)) if found.publishable else (),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        final=True,
    )


def camera_estimate(registered: RegisteredFrame) -> CameraEstimate:
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
