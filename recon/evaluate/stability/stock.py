"""The cameras of stock COLMAP and GLOMAP (recon/evaluate/rivals/colmap.py) as a snapshot without Gaussians."""

from __future__ import annotations

from collections.abc import Iterable

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.config import Config
from splatnode.recon.evaluate.rivals.colmap import Mapper, Placed, global_, incremental, mapped
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
    model = mapped(usable, config.seed, mapping)
    placed = () if model is None else model.placed
    told = verdict(usable, {each.frame.name for each in placed})
    return Snapshot(
        sequence=1,
        verdict=told,
        cameras=tuple(map(_camera, placed)) if told.publishable else (),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        final=True,
    )


def _camera(placed: Placed) -> CameraEstimate:
    frame = placed.frame
    return CameraEstimate(
        frame.name, frame.frame_id, placed.T_world_camera, placed.intrinsics.K, frame.width, frame.height, None, None
    )
