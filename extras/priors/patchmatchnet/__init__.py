"""PatchmatchNet (Wang et al. 2021) as a prior: depth from a small network in place of PatchMatch stereo."""

from __future__ import annotations

from pathlib import Path

from splatnode.extras.priors.patchmatchnet.network import NetworkStereo, PatchmatchNet
from splatnode.recon.networks import weights as networks_weights
from splatnode.recon.networks.weights import find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

WEIGHTS = ("patchmatchnet/patchmatchnet_dtu.pth",)


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # file of the network's; None: where `splatnode weights` puts them


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError or FileNotFoundError without weights, ValueError where they are not PatchmatchNet's."""
    return ClassicalPrior(config, NetworkStereo(load_network(config.weights or find(*WEIGHTS))).estimate_depth_maps)


def load_network(path: Path) -> PatchmatchNet:
    """Raises ValueError where the file is damaged or another network's, and FileNotFoundError."""
    return networks_weights.load_network(PatchmatchNet, networks_weights.read_weights(path), path, "PatchmatchNet")
