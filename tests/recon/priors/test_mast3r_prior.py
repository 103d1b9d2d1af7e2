"""MASt3R as a prior, with networks that answer from the known scene, or lie."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import msgspec
import numpy as np
import pytest
import torch

from splatnode.capture.cameras import synthetic
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.matching import features
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.networks.vit import crop
from splatnode.recon.priors import compute_depth_normals
from splatnode.recon.priors.mast3r import (
    PATCH,
    Config,
    EncodedImage,
    Mast3rPrior,
    NetworkCache,
    Prediction,
    load,
    prepare_image,
)
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.verification.decision import DecisionConfig, decide, refuse_before_registration
from splatnode.recon.verification.evidence import VerificationConfig, verify
from tests.support.synthetic import SMALL, photographs, places, renumbered, view_graph

VIEWS = 3


@cache
def true_depth(index: int) -> np.ndarray:
    return synthetic.depth(SMALL, index)


_FOURIER = np.random.default_rng(0).normal(0, 6.0, (3, 12))


@dataclass
class Oracle:
    """Answers from the true depth of the synthetic place; it knows the photographs by their pixels."""

    noise: float = 0.003
    encoded: list[torch.Tensor] = field(default_factory=list)

    def encode(self, image: torch.Tensor) -> EncodedImage:
        self.encoded.append(image)
        known = [
            prepare_image(photographs()[k].image, crop(SMALL.width, SMALL.height, 320, PATCH)) for k in range(VIEWS)
        ]
        gaps = [float((image - other).abs().mean()) if image.shape == other.shape else np.inf for other in known]
        index = torch.tensor([[float(np.argmin(gaps))]])
        return EncodedImage(index, torch.zeros(1, 2), image.shape[1], image.shape[2])

    def decode(self, first: EncodedImage, second: EncodedImage) -> tuple[Prediction, Prediction]:
        i, j = (int(encoded.tokens[0, 0]) for encoded in (first, second))
        to_first = np.linalg.inv(synthetic.scene_cameras(SMALL)[i][0])
        rng = np.random.default_rng(100 * i + j)
        scale = np.exp(rng.normal(0, 0.3))
        return self._seen(i, to_first, scale, first, rng), self._seen(j, to_first, scale, second, rng)

    def _seen(
        self, index: int, to_first: np.ndarray, scale: float, encoded: EncodedImage, rng: np.random.Generator
    ) -> Prediction:
        T_world_camera, K = synthetic.scene_cameras(SMALL)[index]
        to = crop(SMALL.width, SMALL.height, 320, PATCH)
        depth = true_depth(index)
        top, left = int(to.top), int(to.left)
        v, u = np.mgrid[top : top + encoded.height, left : left + encoded.width] + 0.5
        z = np.where(np.isfinite(depth), depth, 30.0)[top : top + encoded.height, left : left + encoded.width]
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
        world = (rays * z[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        points = world @ to_first[:3, :3].T + to_first[:3, 3]
        points = points * (1 + self.noise * rng.standard_normal((*z.shape, 1))) * scale
        phase = world @ _FOURIER
        descriptors = np.concatenate([np.cos(phase), np.sin(phase)], -1) / np.sqrt(12)
        sure = np.full(z.shape, 4.0, np.float32)
        return Prediction(*(torch.from_numpy(a.astype(np.float32)) for a in (points, sure, descriptors, sure)))


class Liar(Oracle):
    """Says of any two images that both show the same wall, pixel for pixel."""

    def decode(self, first: EncodedImage, second: EncodedImage) -> tuple[Prediction, Prediction]:
        v, u = np.mgrid[: first.height, : first.width]
        pixels = np.stack([u / first.width - 0.5, v / first.height - 0.5, np.ones(u.shape)], -1)
        phase = pixels @ _FOURIER
        descriptors = np.concatenate([np.cos(phase), np.sin(phase)], -1) / np.sqrt(12)
        sure = np.full(u.shape, 9.0, np.float32)
        same = Prediction(*(torch.from_numpy(a.astype(np.float32)) for a in (pixels, sure, descriptors, sure)))
        return same, same


def test_cameras_and_depth_come_out_right():
    graph = view_graph(photographs()[:VIEWS])
    oracle = Oracle()
    prior = Mast3rPrior(oracle, Config(longer_side=320))
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None and len(registration.cameras) == VIEWS
    cameras = synthetic.scene_cameras(SMALL)[:VIEWS]
    Ks = np.stack([np.diag([c.focal, c.focal, 1.0]) for c in registration.cameras])
    errors = compare_cameras(
        np.stack([camera.T_world_camera for camera in registration.cameras]),
        np.stack([T for T, _ in cameras]),
        Ks,
        np.stack([K for _, K in cameras]),
    )
    assert errors.rotation_pair_deg is not None and errors.rotation_pair_deg < 0.5
    true_step = np.linalg.norm(cameras[1][0][:3, 3] - cameras[0][0][:3, 3])
    step = np.linalg.norm(registration.cameras[1].T_world_camera[:3, 3])
    pointmaps = prior.pointmaps(graph, registration)
    assert len(oracle.encoded) == VIEWS  # the network is asked once for the same frames
    known = {pointmap.name: pointmap for pointmap in pointmaps[1:]}
    assert [pointmap.name for pointmap in prior.further_pointmaps(graph, registration, known)] == [pointmaps[0].name]
    for index, pointmap in enumerate(pointmaps):
        depth = true_depth(index)
        near = (pointmap.depth > 0) & (depth < 8)
        relative = np.abs(pointmap.depth * (true_step / step) / depth - 1)[near]
        assert near.mean() > 0.5 and np.median(relative) < 0.03
        assert pointmap.confidence[near].min() == pytest.approx(0.75)
        assert np.linalg.norm(pointmap.normal, axis=-1).max() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("noise", [False, True])
def test_what_a_lying_network_invents_is_refused(noise):
    """Frames of three places, or of nothing at all: the network claims that all of them show one wall."""
    few = matching.MatchingConfig(features=features.FeatureConfig(max_num_features=2000, min_longer_side=500))
    frames = places(msgspec.structs.replace(SMALL, views=3, width=192, height=144), seeds=(0, 1, 2))
    if noise:
        rng = np.random.default_rng(0)
        frames = [replace(frame, image=rng.integers(0, 256, frame.image.shape, np.uint8)) for frame in frames]
    prior = Mast3rPrior(Liar(), Config(longer_side=192))
    graph = view_graph(frames, prior.matcher, few)
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    evidence = verify(graph, registration, VerificationConfig())
    verdict = refuse_before_registration(graph, (), DecisionConfig()) or decide(
        graph, registration, evidence, DecisionConfig()
    )
    assert not verdict.publishable


def test_crops_are_whole_patches_and_keep_the_middle():
    to = crop(4032, 3024, 512, PATCH)
    assert (to.width, to.height, to.left, to.top) == (512, 384, 0, 0)
    to = crop(300, 1000, 512, PATCH)
    assert (to.width, to.height) == (144, 512)
    np.testing.assert_allclose(to.map_to_network(np.array([[150.0, 500.0]])), [[72.0, 256.0]], atol=0.5)
    image = np.zeros((1000, 300, 3), np.uint8)
    image[:, :, 0] = 255
    seen = prepare_image(image, to)
    assert seen.shape == (3, 512, 144) and seen[0].min() == 1.0 and seen[1].max() == -1.0
    with pytest.raises(ValueError, match="too thin"):
        crop(4000, 60, 512, PATCH)


def test_with_many_frames_only_neighbours_are_asked_about():
    frames = renumbered([np.zeros((32, 32, 3), np.uint8)] * 6)
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.int64), np.zeros(0))
    keyframes = [Keyframe(frame, frame.image, nothing) for frame in frames]
    liar = Liar()
    pairs = NetworkCache(liar, 32).predict_points(keyframes, 1)
    assert sorted(pairs) == sorted({(i, (i + d) % 6) for i in range(6) for d in (1, -1)})
    assert len(liar.encoded) == 6


def test_descriptors_match_the_features_of_two_keyframes():
    graph = view_graph(photographs()[:2])
    matcher = Mast3rPrior(Oracle(), Config(longer_side=320)).matcher
    matches = matcher.match(*graph.keyframes)
    both = {tuple(pair) for pair in matches.tolist()}
    plain = {tuple(pair) for pair in graph.pairs[0, 1].matches.tolist()}
    assert len(both) > len(plain) and len(both & plain) > 0.5 * len(plain)
    assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))


def test_normals_of_a_tilted_plane():
    K = np.array([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    facing = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    rays = np.stack([(u - 16) / 50, (v - 12) / 50, np.ones_like(u)], -1)
    depth = (-2.0 / (rays @ facing)).astype(np.float32)
    depth[5:8, 5:8] = 0
    normal = compute_depth_normals(depth, K)
    known = depth > 0
    np.testing.assert_allclose(normal[known], np.broadcast_to(facing, normal[known].shape), atol=1e-3)
    assert (normal[~known] == 0).all()


def test_without_weights_the_message_names_them(monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(ValueError, match="splatnode weights fetch MASt3R_ViTLarge"):
        load(Config())
