"""Depth Anything 3 as a prior: it proposes matches, and gives depth once it was told the verified cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.networks.weight_folder import find
from splatnode.recon.priors.da3.inference import KnownCamera, Network, estimate_keyframes
from splatnode.recon.priors.da3.matcher import WarpMatcher
from splatnode.recon.priors.da3.network import load_network
from splatnode.recon.priors.network_depth import make_registered_pointmap
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.priors.prior import Prior
from splatnode.recon.registration.register import Registration

WEIGHTS = ("da3/da3-small.safetensors",)
PACKAGE = "safetensors"  # reads them


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them
    longer_side: int = 504  # of the network's images, pixels: what it was published with
    views_at_once: int = 12  # photographs that look at each other: memory and time grow with their square
    seed: int = 0  # every prior has one; this one draws no random numbers


class Da3Prior(Prior):
    """Matches by warping one photograph into another's view, depth from the network given registered cameras.

    The network's own cameras serve the warping alone; matches are verified as plain ones are. Depth maps are brought
    to the scale of the registered points that each camera sees.
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
                some, estimate_keyframes(self._network, keyframes, self._config.longer_side, known), strict=True
            ):
                depth, sure = answer.estimate.depth, answer.estimate.confidence
                found.append(make_registered_pointmap(graph, registration, camera, answer.crop, depth, sure))
            pause()
        return tuple(found)


def load(config: Config) -> Da3Prior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are another network's."""
    return Da3Prior(load_network(config.weights or find(*WEIGHTS)), config)
