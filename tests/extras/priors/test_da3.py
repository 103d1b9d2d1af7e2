"""Depth Anything 3: the network against values of the authors' own package, and the prior with networks that know.

The golden values were computed by depth_anything_3 0.1.1 (its da3-small, in float32, with its own normalisation of
known cameras) with weights generated from their names (tests/support/generated.py); only `cam_dec.fc_fov.0.bias` has 1
added, so that fields of view are wide. Ours and theirs agree to 1e-6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatnode.capture.cameras import synthetic
from splatnode.extras.priors.da3 import (
    Config,
    Da3Prior,
    DepthAnything3,
    DepthEstimate,
    PlacedCamera,
    estimate_keyframes,
    load,
    load_network,
)
from splatnode.recon.networks.vit import MEAN, STD
from splatnode.recon.registration import registration as registration_registration
from tests.support.generated import generated_images, generated_weights, shapes_of
from tests.support.synthetic import SMALL, photographs, view_graph

# Four views: depth and confidence at row 20, column 33, then their means; first coordinate of each position, and the
# first element of each rotation; focal lengths.
UNKNOWN = {
    "depth": (0.8545088, 0.6867534, 0.9084644, 1.386207, 0.7741677, 0.9637021, 0.8742101, 1.563867),
    "confidence": (2.491887, 2.374198, 1.843546, 2.113454, 2.290063, 2.109252, 1.832142, 1.942129),
    "x": (-0.1128149, -0.1245491, -0.09291251, -0.1081901),
    "rotation": (-0.8470311, -0.5086892, -0.2281625, -0.2928865),
    "focal": (62.66099, 61.85639, 62.52884, 64.08064, 43.32393, 40.79428, 43.32504, 44.61185),
}
KNOWN = {
    "depth": (0.8560123, 0.6822259, 0.9053423, 1.384754, 0.7739432, 0.9600925, 0.8727037, 1.556105),
    "confidence": (2.518041, 2.389618, 1.838783, 2.108615, 2.293456, 2.117526, 1.834767, 1.939986),
    "x": (-0.4107431, -1.078541, -0.9586924, -0.7844433),
    "rotation": (0.3470227, 0.5032868, 0.5092415, 0.2315435),
    "focal": (53.83543, 58.87543, 74.76547, 92.64879, 24.02789, 23.03114, 22.71306, 21.65268),
}


def cameras() -> list[PlacedCamera]:
    """Not in the first one's frame, nor at the distance that the network wants."""
    placed = []
    for i in range(4):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = Rotation.from_rotvec([0.1 * i, 0.2 * i, -0.1 * i]).as_matrix()
        T_world_camera[:3, 3] = 2.0 * i, 0.5 * i * i, -i
        moved = np.diag([3.0, 3.0, 3.0, 1.0])
        moved[:3, :3] = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
        moved[:3, 3] = 1.0, -2.0, 0.5
        placed.append(PlacedCamera(moved @ T_world_camera, np.array([[80.0, 0, 35], [0, 82, 28], [0, 0, 1]])))
    return placed


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    made = generated_weights(DepthAnything3)
    made["cam_dec.fc_fov.0.bias"] = made["cam_dec.fc_fov.0.bias"] + 1.0
    return made


@pytest.fixture(scope="module")
def network(weights, tmp_path_factory) -> DepthAnything3:
    """Loaded from a file as it is published: every name behind `model.`, and a second head that is not needed."""
    from safetensors.torch import save_file

    path = tmp_path_factory.mktemp("da3") / "model.safetensors"
    unused = {"model.head.scratch.output_conv2_aux.0.0.weight": torch.zeros(32, 32, 3, 3)}
    save_file({f"model.{name}": tensor for name, tensor in weights.items()} | unused, path)
    return load_network(path)


@pytest.mark.parametrize("known", [False, True])
def test_outputs_equal_those_of_the_authors_package(network, known):
    estimates = network(generated_images(4, 56, 70), cameras() if known else None)
    golden = KNOWN if known else UNKNOWN
    for name in ("depth", "confidence"):
        maps = [getattr(estimate, name) for estimate in estimates]
        assert all(each.shape == (56, 70) for each in maps)
        np.testing.assert_allclose([each[20, 33] for each in maps] + [each.mean() for each in maps], golden[name], 1e-5)
    Ts = [estimate.camera.T_world_camera for estimate in estimates]
    np.testing.assert_allclose([T[0, 3] for T in Ts], golden["x"], rtol=1e-4)
    np.testing.assert_allclose([T[0, 0] for T in Ts], golden["rotation"], rtol=1e-4)
    Ks = [estimate.camera.K for estimate in estimates]
    np.testing.assert_allclose([K[0, 0] for K in Ks] + [K[1, 1] for K in Ks], golden["focal"], rtol=1e-4)


def test_the_checkpoint_is_known_by_names_and_shapes(network, weights, tmp_path):
    shapes = shapes_of(DepthAnything3)
    assert len(shapes) == 343 and sum(np.prod(shape) for shape in shapes.values()) == 33_358_315
    path = tmp_path / "other.pth"
    torch.save({name: weights[name] for name in list(weights)[1:]}, path)
    with pytest.raises(ValueError, match="not the checkpoint of Depth Anything 3 Small: it lacks backbone"):
        load_network(path)
    with pytest.raises(ValueError, match="multiples of 14"):
        network(torch.zeros(2, 3, 50, 70))


def test_a_single_view_is_enough(network):
    (estimate,) = network(generated_images(1, 42, 56))
    assert estimate.depth.shape == (42, 56) and estimate.depth.min() > 0 and estimate.confidence.min() > 1


@dataclass
class Oracle:
    """Answers from the true depth and cameras of the synthetic place, whose photographs it knows by their pixels."""

    views: tuple[int, ...]
    unit: float = 0.37
    told: list[PlacedCamera] | None = None

    def __call__(self, images, cameras=None):
        self.told = cameras
        return [self._estimate(image) for image in images]

    def _estimate(self, image: torch.Tensor) -> DepthEstimate:
        height, width = image.shape[1:]
        top, left = (SMALL.height - height) // 2, (SMALL.width - width) // 2
        shown = image.permute(1, 2, 0).numpy() * STD + MEAN
        gaps = [
            np.abs(photographs()[k].image[top : top + height, left : left + width] / 255 - shown).mean()
            for k in self.views
        ]
        index = self.views[int(np.argmin(gaps))]
        T_world_camera, K = synthetic.scene_cameras(SMALL)[index]
        depth = np.where(np.isfinite(synthetic.depth(SMALL, index)), synthetic.depth(SMALL, index), 30.0) * self.unit
        T_scaled = T_world_camera.copy()
        T_scaled[:3, 3] *= self.unit
        K = K - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        depth = depth[top : top + height, left : left + width].astype(np.float32)
        return DepthEstimate(depth, np.full((height, width), 4.0, np.float32), PlacedCamera(T_scaled, K))


def test_depth_comes_out_right_for_the_verified_cameras():
    graph = view_graph(photographs()[:3])
    oracle = Oracle((0, 1, 2))
    prior = Da3Prior(oracle, Config(longer_side=320))
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None
    pointmaps = prior.pointmaps(graph, registration)
    assert oracle.told is not None  # the registered cameras, as the network's image has them
    for told, camera in zip(oracle.told, registration.cameras, strict=True):
        assert (told.T_world_camera == camera.T_world_camera).all()
        assert told.K[0, 0] == pytest.approx(camera.focal) and told.K[0, 2] == 154
    truth = synthetic.scene_cameras(SMALL)
    step = np.linalg.norm(registration.cameras[1].T_world_camera[:3, 3])
    true_step = np.linalg.norm(truth[1][0][:3, 3] - truth[0][0][:3, 3])
    for index, pointmap in enumerate(pointmaps):
        depth = synthetic.depth(SMALL, index)
        near = (pointmap.depth > 0) & (depth < 8)
        relative = np.abs(pointmap.depth * (true_step / step) / depth - 1)[near]
        assert near.mean() > 0.5 and np.median(relative) < 0.03
        assert pointmap.confidence[near].min() == pytest.approx(0.75)
    known = {pointmap.name: pointmap for pointmap in pointmaps[:2]}
    assert [found.name for found in prior.further_pointmaps(graph, registration, known)] == [pointmaps[2].name]


def test_what_it_draws_from_the_other_camera_matches_from_far_apart():
    ends = (photographs()[0], photographs()[5])
    graph = view_graph(ends)
    matcher = Da3Prior(Oracle((0, 5)), Config(longer_side=320)).matcher
    matches = matcher.match(*graph.keyframes)
    (T1, K1), (T2, _) = (synthetic.scene_cameras(SMALL)[index] for index in (0, 5))
    points1, points2 = (graph.keyframes[side].features.points[matches[:, side]] for side in (0, 1))
    depth = synthetic.depth(SMALL, 0)[points1[:, 1].astype(int), points1[:, 0].astype(int)]
    world = (np.column_stack([points1, np.ones(len(points1))]) @ np.linalg.inv(K1).T) * depth[:, None]
    seen = (np.linalg.inv(T2) @ T1 @ np.column_stack([world, np.ones(len(world))]).T)[:3]
    truly = (K1 @ seen / (K1 @ seen)[2])[:2].T
    right = np.linalg.norm(truly - points2, axis=1) < 3
    plain = graph.pairs.get((0, 1))
    assert right.sum() > 100 and right.mean() > 0.8
    assert right.sum() > 1.5 * (0 if plain is None else len(plain.matches))


def test_photographs_of_different_shapes_are_cut_to_what_all_have():
    wide, tall = photographs()[0], replace(photographs()[1], image=photographs()[1].image.transpose(1, 0, 2).copy())
    graph = view_graph([wide, tall])
    answers = estimate_keyframes(lambda images, cameras: [None] * len(images), graph.keyframes, 280)  # type: ignore[arg-type]
    assert {(answer.crop.width, answer.crop.height) for answer in answers} == {(210, 210)}


def test_without_weights_the_message_names_them(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(ValueError, match="splatnode weights fetch da3-small"):
        load(Config())
