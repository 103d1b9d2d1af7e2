"""A result to write: Gaussians, cameras and a verdict that a seed decides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatnode.capture.frame import Clock, DroppedFrame, Stamp
from splatnode.recon.result.export import write_result
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, KnownLenses, Landmarks, Snapshot
from splatnode.recon.result.verdict import Bounds, Code, Verdict


def make_gaussians(num_gaussians: int = 50, num_bases: int = 4, seed: int = 0) -> GaussianArrays:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(num_gaussians, 4))
    return GaussianArrays(
        means=rng.uniform(-3, 3, (num_gaussians, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, -1, (num_gaussians, 3))).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, num_gaussians).astype(np.float32),
        sh=rng.uniform(-0.7, 0.7, (num_gaussians, num_bases, 3)).astype(np.float32),
        source_frame=np.zeros(num_gaussians, np.int32),
    )


def make_camera(frame_id: int, angle: float = 0.3) -> CameraEstimate:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_world_camera[:3, 3] = [frame_id, -0.5, 0.25]
    K = np.array([[400.0, 0, 256], [0, 410, 192], [0, 0, 1]])
    bounds = Bounds(0.1, 0.02, 2.0, 1.5, ((0.03, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.005, 0.0)))
    return CameraEstimate(f"{frame_id:04d}.jpg", frame_id, T_world_camera, K, 512, 384, bounds)


def stamped(snapshot: Snapshot, first_ns: int = 1_714_989_607_250_000_001) -> Snapshot:
    """With times of capture, a second apart."""
    times = (Stamp(first_ns + index * 10**9, Clock.UTC) for index in range(len(snapshot.cameras)))
    cameras = tuple(replace(camera, captured_at=stamp) for camera, stamp in zip(snapshot.cameras, times, strict=True))
    return replace(snapshot, cameras=cameras)


def make_snapshot(code: Code = Code.OK, publishable: bool = True) -> Snapshot:
    return Snapshot(
        sequence=3,
        verdict=Verdict(code, "Said in one sentence.", "Do this.", ("0001.jpg",), publishable),
        cameras=(make_camera(0), make_camera(2, -0.7)),
        gaussians=make_gaussians(),
        images={},
        dropped=(DroppedFrame("0001.jpg", "blurred"),),
        iterations=200,
        seconds={"poses": 1.5, "optimise": 2.0},
        final=True,
    )


def write(snapshot: Snapshot, folder: Path, **extra) -> Path:
    report = build_report(snapshot, seed=1, preset="fast", peak_rss_mb=100.0)
    return write_result(snapshot, folder, report, **extra)


def make_landmarks() -> Landmarks:
    """Five points with nine descriptors in two photographs."""
    draw = np.random.default_rng(0)
    half = draw.normal(size=(5, 3, 3))
    return Landmarks(
        points=draw.normal(size=(5, 3)),
        covariances=half @ half.transpose(0, 2, 1),
        descriptors=draw.integers(0, 20, (9, 128)).astype(np.uint8),
        point_of=np.array([0, 0, 1, 1, 2, 2, 3, 4, 4]),
        photograph_of=np.array([0, 1, 0, 1, 0, 1, 1, 0, 1]),
        names=("a.jpg", "ü b.jpg"),
        Ts_world_camera=np.tile(np.eye(4), (2, 1, 1)),
        lenses=KnownLenses(np.full(2, 0.8), np.full((2, 2), 0.01), np.full((2, 2), 0.001), np.full(2, 0.75)),
        rotation_bounds=np.array([0.3, 0.5]),
        centre_bounds=np.array([0.01, 0.02]),
        noise_px=0.4,
        focal_bounds=np.array([1.0, 2.0]),
    )


def same_rotations(a: np.ndarray, b: np.ndarray, degrees: float) -> bool:
    cosine = np.abs((a.astype(np.float64) * b).sum(1)) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return bool((np.rad2deg(2 * np.arccos(np.minimum(cosine, 1.0))) <= degrees).all())
