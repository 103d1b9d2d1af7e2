"""PatchmatchNet (Wang et al. 2021) as a prior: our own cameras, and depth from a small network (MIT licence)."""

from __future__ import annotations

from pathlib import Path

from splatnode.recon.networks import weight_files
from splatnode.recon.networks.weights import find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior
from splatnode.recon.priors.patchmatchnet.network import PatchmatchNet
from splatnode.recon.priors.patchmatchnet.stereo import NetworkStereo

WEIGHTS = "patchmatchnet/patchmatchnet_dtu.pth"


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # None: where `splatnode weights` puts them


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError where there are no weights, ValueError where they are not PatchmatchNet's."""
    return ClassicalPrior(config, NetworkStereo(load_network(config.weights or find(WEIGHTS))).depth_maps)


def load_network(path: Path) -> PatchmatchNet:
    """Raises ValueError where the file is damaged or another network's, and FileNotFoundError."""
    return weight_files.load_network(PatchmatchNet, weight_files.read_weights(path), path, "PatchmatchNet")
