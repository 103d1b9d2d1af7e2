"""Depth Anything 3 as a prior: it is believed as far as matches bear it out, then told the cameras that they gave."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.weights import find
from splatnode.recon.priors.da3.inference import KnownCamera, Network, ask
from splatnode.recon.priors.da3.matcher import WarpMatcher
from splatnode.recon.priors.da3.network import load_network
from splatnode.recon.priors.placed import pointmap_of
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.register import Registration

WEIGHTS = "da3/da3-small.safetensors"


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # None: where `splatnode weights` puts them
    longer_side: int = 504  # of the network's images: what it was published with
    views_at_once: int = 12  # all of them look at each other: memory and time grow with their square
    seed: int = 0


class Da3Prior(Prior):
    """Its own cameras and depth draw one photograph from another's viewpoint, for matches that are then verified.

    The cameras are `recon.registration`'s. Depth comes from the network that was told these cameras, brought to the
    scale of the points that each camera sees.
    """

    def __init__(self, network: Network, config: Config) -> None:
        self._network, self._config = network, config
        self.matcher = WarpMatcher(network, config.longer_side)

    def pointmaps(
        self, graph: ViewGraph, registration: Registration, pause: Callable[[], None] = lambda: None
    ) -> tuple[Pointmap, ...]:
        found = []
        cameras, at_once = registration.cameras, self._config.views_at_once
        for start in range(0, len(cameras), at_once):
            some = cameras[start : start + at_once]
            keyframes = [graph.keyframes[camera.index] for camera in some]
            known = [KnownCamera(camera.T_world_camera, camera.focal) for camera in some]
            for camera, answer in zip(
                some, ask(self._network, keyframes, self._config.longer_side, known), strict=True
            ):
                depth, sure = answer.estimate.depth, answer.estimate.confidence
                found.append(pointmap_of(graph, registration, camera, answer.crop, depth, sure))
            pause()
        return tuple(found)


def load(config: Config) -> Da3Prior:
    """Raises FileNotFoundError or ValueError where there are no weights, or not those of Depth Anything 3 Small."""
    return Da3Prior(load_network(config.weights or find(WEIGHTS)), config)
