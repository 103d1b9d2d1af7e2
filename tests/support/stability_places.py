"""Small places for the stability matrix, with cameras on an arc."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from splatnode.extras.evaluate.dataset import EvaluationScene, TrueCamera
from splatnode.extras.evaluate.stability.perturbations import ScenesByMotion, TrialScene

K = np.array([[200.0, 0.0, 120.0], [0.0, 200.0, 90.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 240, 180


def on_arc(degrees: float, distance: float = 3.0) -> np.ndarray:
    """A camera (4, 4) on an arc around the origin, which it looks at."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    T_world_camera[:3, 3] = -distance * T_world_camera[:3, 2]
    return T_world_camera


def three_places(folder: Path) -> ScenesByMotion:
    """Three places of twelve photographs each, 6 degrees apart; pixels without a meaning."""
    rng = np.random.default_rng(0)
    made = []
    for name in ("east", "south", "west"):
        names = tuple(f"{i:02d}.png" for i in range(12))
        for image_name in names:
            small = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
            image = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
            (folder / name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / name / image_name), image)
        cameras = {n: TrueCamera(on_arc(6.0 * i), K, WIDTH, HEIGHT) for i, n in enumerate(names)}
        scene = EvaluationScene(name, {n: folder / name / n for n in names}, cameras)
        made.append(TrialScene(scene, names))
    return ScenesByMotion(tuple(made))
