"""A scene of blobs with known cameras: photographs, splits, and the perfect reconstruction of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from splatnode.extras.evaluate.dataset import Split
from splatnode.extras.evaluate.protocol import Settings, create_empty_networks
from splatnode.recon.geometry import Similarity, exp_se3
from splatnode.recon.result.report import render_rgb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict

WIDTH, HEIGHT = 96, 72
K = np.array([[90.0, 0, 48], [0, 90.0, 36], [0, 0, 1]])
NAMES = [f"{i:02d}.png" for i in range(8)]
SPLIT = Split(("00.png", "04.png", "07.png"), ("01.png", "03.png"))
NO_NETWORKS = create_empty_networks()
QUICK = Settings(alignment_steps=20, alignment_levels=1)


def true_pose(i: int) -> np.ndarray:
    return exp_se3(
        torch.tensor([0.25 * (i - 4), 0.05 * (i % 3), 0, 0, -0.05 * (i - 4), 0], dtype=torch.float64)
    ).numpy()


def make_gaussians() -> GaussianArrays:
    rng = np.random.default_rng(0)
    count = 500
    return GaussianArrays(
        means=rng.uniform([-4, -3, 3], [4, 3, 6], (count, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.15, np.float32),
        opacities=np.full(count, 0.8, np.float32),
        sh=rng.uniform(-1.5, 1.5, (count, 1, 3)).astype(np.float32),
        source_frame=np.zeros(count, np.int32),
    )


def estimate(name: str, T_world_camera: np.ndarray) -> CameraEstimate:
    return CameraEstimate(name, int(name[:2]), T_world_camera, K, WIDTH, HEIGHT)


def perfect_snapshot() -> Snapshot:
    """The true scene, in a world of another scale, orientation and origin."""
    world = exp_se3(torch.tensor([1.0, -2, 0.5, 0.3, 0.9, -0.4], dtype=torch.float64)).numpy()
    similarity = Similarity(0.4, world[:3, :3], world[:3, 3])
    gaussians = make_gaussians()
    return Snapshot(
        sequence=0,
        verdict=Verdict(Code.OK, "Good.", "", publishable=True),
        cameras=tuple(estimate(name, similarity.camera(true_pose(int(name[:2])))) for name in SPLIT.train),
        gaussians=replace(
            gaussians,
            means=(0.4 * gaussians.means @ world[:3, :3].T + world[:3, 3]).astype(np.float32),
            scales=gaussians.scales * np.float32(0.4),
        ),
        images={},
        dropped=(),
        iterations=100,
        seconds={"poses": 1.0, "optimise": 2.0},
        final=True,
    )


def write_images(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    for name in NAMES:
        image = render_rgb(make_gaussians(), true_pose(int(name[:2])), K, WIDTH, HEIGHT)
        pixels = np.rint(image * 255).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / name), pixels[..., ::-1])


def write_scene(folder: Path) -> None:
    """`folder` with its images and true cameras, and the splits.json beside it."""
    write_images(folder)
    entries = []
    for name in NAMES:
        T_camera_world = np.linalg.inv(true_pose(int(name[:2])))
        pose = {"R": T_camera_world[:3, :3].tolist(), "t": T_camera_world[:3, 3].tolist()}
        entries.append({"name": name, "width": WIDTH, "height": HEIGHT, "K": K.tolist(), **pose})
    (folder / "cameras.json").write_text(json.dumps({"images": entries}))
    splits = {folder.name: {"train3": SPLIT.train, "test": SPLIT.test}}
    (folder.parent / "splits.json").write_text(json.dumps(splits))
