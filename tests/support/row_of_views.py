"""Views in a row before a wall of noise, with their registration, their point maps and the scene that they make."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace

import numpy as np

from splatnode.capture.frame import ExposureSettings, Frame
from splatnode.recon.geometry import Similarity
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors import Pointmap
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.scene import Scene
from splatnode.recon.scene.initialization import SceneInitializationConfig, initialize_scene
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT, STEP = 32, 24, 0.3
NO_FEATURES = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))


def camera(index: int) -> np.ndarray:
    """T_world_camera, `index` steps to the right of a wall of noise's first view."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = STEP * index
    return T_world_camera


def graph_of(count: int, exposures: Mapping[int, ExposureSettings] = MappingProxyType({})) -> ViewGraph:
    """Views in a row; the nearer two are, the more matches they have. `exposures` is what their cameras tell."""
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH + 16 * count, 3)).astype(np.uint8)
    images = [np.ascontiguousarray(noise[:, index : index + WIDTH]) for index in range(count)]
    keyframes = [
        Keyframe(Frame(index, f"{index:02d}.png", 0, image, None, exposure=exposures.get(index)), image, NO_FEATURES)
        for index, image in enumerate(images)
    ]
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    matches = {(i, j): SimpleNamespace(matches=np.zeros((100 - 9 * (j - i), 2))) for i, j in pairs}
    return ViewGraph(matching.MatchingConfig(), tuple(keyframes), matches)


def registration_of(count: int, world: Similarity | None = None) -> Registration:
    world = world or Similarity(1.0, np.eye(3), np.zeros(3))
    principal = np.array([WIDTH / 2, HEIGHT / 2])
    return Registration(
        cameras=tuple(
            RegisteredCamera(
                i, world.camera(camera(i)), 0, 1.1 * WIDTH, principal, np.zeros(2), 0.1, 0.01, 1e-4 * np.eye(3)
            )
            for i in range(count)
        ),
        points=np.array([[0.0, 0.0, 2.0]]) * world.scale @ world.rotation.T + world.translation,
        observed_by=np.zeros(0, np.int64),
        observed_point=np.zeros(0, np.int64),
        observed_pixels=np.zeros((0, 2)),
        inlier_ratios={},
        focal_sigma=0.0,
        median_angle_deg=10.0,
        rms_px=0.3,
    )


def maps_of(indices: range) -> dict[str, Pointmap]:
    maps = [plane_pointmap(camera(index), confidence=0.9 - 0.01 * index, frame_id=index) for index in indices]
    return {pointmap.name: pointmap for pointmap in maps}


def scene_of(count: int, graph: ViewGraph) -> Scene:
    images = {keyframe.name: keyframe.image for keyframe in graph.keyframes}
    return initialize_scene(list(maps_of(range(count)).values()), images, SceneInitializationConfig())
