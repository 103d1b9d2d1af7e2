"""A small scene of the built-in capture with its landmarks, in which further photographs are placed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Camera
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras
from splatnode.recon.geometry import Similarity, align_cameras
from splatnode.recon.locating import Located
from splatnode.recon.result.snapshot import Landmarks
from tests.support.synthetic import photographs, view_graph

PLACE = synthetic.Config(views=6, width=480, height=360)


@dataclass(frozen=True, eq=False)
class KnownPlace:
    estimate: Reconstruction
    landmarks: Landmarks
    to_scene: Similarity  # from the built-in capture's world


@lru_cache(maxsize=1)
def known_place() -> KnownPlace:
    """Six photographs, registered and verified."""
    estimate = estimate_cameras(view_graph(photographs(PLACE)), (), ReconstructionConfig())
    assert estimate.landmarks is not None
    true = np.stack([T for T, _ in synthetic.scene_cameras(PLACE)])
    landmarks = estimate.landmarks
    return KnownPlace(estimate, landmarks, align_cameras(true, landmarks.Ts_world_camera))


def photograph(index: int) -> tuple[np.ndarray, Camera]:
    """Midway between two photographs of the scene, with its true camera."""
    return _render(index).copy(), synthetic.evaluation_cameras(PLACE)[index]


@lru_cache(maxsize=PLACE.views)
def _render(index: int) -> np.ndarray:
    return synthetic.render_image(PLACE, synthetic.evaluation_cameras(PLACE)[index], 100 + index)


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera once it has turned to its right where it stands."""
    T, K = camera
    turn, angle = np.eye(4), np.radians(degrees)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    return T @ turn, K


def errors(found: Located, camera: Camera) -> tuple[float, float]:
    """Degrees, and percent of the distance to the scene."""
    place = known_place()
    truth = place.to_scene.camera(camera[0])
    turn = found.T_world_camera[:3, :3].T @ truth[:3, :3]
    degrees = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    return float(degrees), 100.0 * float(np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]))
