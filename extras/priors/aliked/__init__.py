"""ALIKED (Zhao et al. 2023) as a prior: the classical depth, with learned matches where plain features find few."""

from __future__ import annotations

from pathlib import Path

from splatnode.capture.process.config_keys import Internal
from splatnode.extras.priors.aliked.network import AlikedMatcher, load_aliked
from splatnode.recon.networks.weights import find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

WEIGHTS = ("aliked/aliked-n16.pth",)


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of N16 or T16; None: N16's, where `splatnode weights` puts them
    longer_side: Internal[int] = 800  # of the network's images, pixels; none is enlarged
    num_keypoints: Internal[int] = 2000  # of an image, at most


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not ALIKED N16's or T16's."""
    network = load_aliked(config.weights or find(*WEIGHTS))
    return ClassicalPrior(config, matcher=AlikedMatcher(network, config.longer_side, config.num_keypoints))
