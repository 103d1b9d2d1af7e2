"""MASt3R as a prior: it proposes matches and depth, and is believed as far as geometry bears it out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import torch

from recon.keyframe import Keyframe
from recon.priors.classical import modelled_K
from recon.priors.depth_normals import normals_of_depth
from recon.priors.mast3r.alignment import AlignedView, align
from recon.priors.mast3r.checkpoint import LICENCE, load_network
from recon.priors.mast3r.inference import Answers, Crop, Network, ask
from recon.priors.mast3r.network import Prediction
from recon.priors.pointmap import Pointmap
from recon.registration import register, two_view
from recon.registration.register import RegisteredCamera, Registration
from recon.registration.two_view import TwoView
from recon.view_graph import ViewGraph
from recon.weights import find

log = logging.getLogger(__name__)

WEIGHTS = "mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth"


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # None: where `splatnode weights` puts them
    registration: register.Config = register.Config()
    longer_side: int = 512  # of the network's images: what it was trained with
    max_neighbours: int = 6  # places: with up to 13 frames every pair is asked about
    seed: int = 0


class Mast3rPrior:
    """Matches by descriptors, cameras by `recon.registration` from them, depth by global alignment."""

    licence = LICENCE

    def __init__(self, network: Network, config: Config) -> None:
        self._network, self._config = network, config
        self._asked: tuple[tuple[str, ...], Answers] | None = None

    def register(self, graph: ViewGraph) -> Registration | None:
        """Cameras from the classical matches and those that the network's descriptors add to them.

        A match is one between two detected features, and counts only where a pair's epipolar geometry holds it: what
        the network invents between unrelated images is not in agreement with any.
        """
        if len(graph.keyframes) < 2:
            return None
        answers = self._answers(graph)
        pairs = dict(graph.pairs)
        for i, j in answers.pairs:
            if i < j and (verified := _verified(graph.keyframes, answers, i, j, self._config.registration)):
                known = pairs.get((i, j))
                if known is None or len(known.matches) < len(verified.matches):
                    pairs[i, j] = verified
        if not pairs:
            return None
        return register.register(graph.keyframes, pairs, self._config.registration)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        """The aligned depth maps, each brought to the scale of the registered points that its camera sees."""
        answers = self._answers(graph)
        views = align(answers.points())
        pause()
        return tuple(
            _pointmap(graph, registration, camera, views[camera.index], answers.crops[camera.index])
            for camera in registration.cameras
        )

    def further_pointmaps(
        self, graph: ViewGraph, registration: Registration, known: Mapping[str, Pointmap]
    ) -> tuple[Pointmap, ...]:
        return tuple(found for found in self.pointmaps(graph, registration) if found.name not in known)

    def _answers(self, graph: ViewGraph) -> Answers:
        names = tuple(keyframe.name for keyframe in graph.keyframes)
        if self._asked is None or self._asked[0] != names:
            images = [keyframe.frame.image for keyframe in graph.keyframes]
            config = self._config
            self._asked = names, ask(self._network, images, config.longer_side, config.max_neighbours)
        return self._asked[1]


def load(config: Config) -> Mast3rPrior:
    """Raises FileNotFoundError or ValueError where there are no weights, or not MASt3R's."""
    network = load_network(config.weights or find(WEIGHTS))
    log.info("%s", LICENCE)
    return Mast3rPrior(network, config)


def _verified(
    keyframes: Sequence[Keyframe], answers: Answers, i: int, j: int, config: register.Config
) -> TwoView | None:
    """The pair's matches by descriptors, as far as one epipolar geometry holds them."""
    first, second = answers.pairs[i, j]
    found1, inside1 = _at_features(first, answers.crops[i], keyframes[i])
    found2, inside2 = _at_features(second, answers.crops[j], keyframes[j])
    matches = _mutual(found1, found2)
    matches = np.stack([inside1[matches[:, 0]], inside2[matches[:, 1]]], 1)
    points1 = keyframes[i].features.points[matches[:, 0]] - register.principal_point(keyframes[i].frame)
    points2 = keyframes[j].features.points[matches[:, 1]] - register.principal_point(keyframes[j].frame)
    size = (keyframes[j].frame.width, keyframes[j].frame.height)
    return two_view.verify(points1, points2, matches, size, config.two_view)


def _at_features(
    prediction: Prediction, crop: Crop, keyframe: Keyframe
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """(F, D) descriptors at those features that the crop shows, and which they are (F,)."""
    pixels = np.floor(crop.to_network(keyframe.features.points)).astype(np.int64)
    (inside,) = np.nonzero(((pixels >= 0) & (pixels < [crop.width, crop.height])).all(1))
    descriptors = prediction.descriptors.numpy()[pixels[inside, 1], pixels[inside, 0]]
    return descriptors, inside


def _mutual(descriptors1: npt.NDArray[np.float32], descriptors2: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """(M, 2) mutual nearest neighbours, the most alike first."""
    if not len(descriptors1) or not len(descriptors2):
        return np.zeros((0, 2), np.int64)
    alike = torch.from_numpy(descriptors1) @ torch.from_numpy(descriptors2).T
    score, nearest = alike.max(1)
    (chosen,) = torch.nonzero(alike.argmax(0)[nearest] == torch.arange(len(nearest)), as_tuple=True)
    chosen = chosen[score[chosen].argsort(descending=True, stable=True)]
    return torch.stack([chosen, nearest[chosen]], 1).numpy()


def _pointmap(
    graph: ViewGraph, registration: Registration, camera: RegisteredCamera, view: AlignedView, crop: Crop
) -> Pointmap:
    keyframe = graph.keyframes[camera.index]
    height, width = keyframe.image.shape[:2]
    K = modelled_K(graph, camera)
    # From modelled pixels to those of the network's image; pixels outside the crop are unknown.
    step = keyframe.frame.width / width * crop.scale, keyframe.frame.height / height * crop.scale
    u = ((np.arange(width) + 0.5) * step[0] - crop.left - 0.5).astype(np.float32)
    v = ((np.arange(height) + 0.5) * step[1] - crop.top - 0.5).astype(np.float32)
    map_u, map_v = np.meshgrid(u, v)
    depth = np.asarray(
        cv2.remap(view.depth, map_u, map_v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0),
        np.float32,
    )
    sure = cv2.remap(view.confidence, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
    depth = (depth * _scale_to_points(registration, camera, keyframe, depth)).astype(np.float32)
    known = depth > 0
    confidence = np.where(known, 1.0 - 1.0 / np.maximum(sure, 1.0), 0).astype(np.float32)
    return Pointmap(
        name=keyframe.name,
        frame_id=keyframe.frame.frame_id,
        depth=depth,
        confidence=confidence,
        normal=normals_of_depth(depth, K),
        T_world_camera=camera.T_world_camera,
        K=K,
    )


def _scale_to_points(
    registration: Registration, camera: RegisteredCamera, keyframe: Keyframe, depth: npt.NDArray[np.float32]
) -> float:
    """What `depth` (h, w) has to be multiplied by to agree with the registered points, in the median."""
    mine = registration.observed_by == camera.index
    world = registration.points[registration.observed_point[mine]]
    to_camera = np.linalg.inv(camera.T_world_camera)
    z = world @ to_camera[2, :3] + to_camera[2, 3]
    pixels = np.floor(registration.observed_pixels[mine] * keyframe.scale).astype(np.int64)
    height, width = depth.shape
    inside = ((pixels >= 0) & (pixels < [width, height])).all(1)
    there = depth[pixels[inside, 1], pixels[inside, 0]]
    both = (there > 0) & (z[inside] > 0)
    return float(np.median(z[inside][both] / there[both])) if both.any() else 1.0
