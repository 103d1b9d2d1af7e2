"""PatchmatchNet (Wang et al. 2021) as a prior: our own cameras, and depth from a small network (MIT licence)."""

from __future__ import annotations

from pathlib import Path

import torch

from recon.priors import classical
from recon.priors.classical import ClassicalPrior
from recon.priors.patchmatchnet.network import PatchmatchNet
from recon.priors.patchmatchnet.stereo import NetworkStereo
from recon.weights import WeightsError, find

WEIGHTS = "patchmatchnet/patchmatchnet_dtu.pth"


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    weights: Path | None = None  # None: where `splatnode weights` puts them


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError where there are no weights, or not PatchmatchNet's."""
    return ClassicalPrior(config, NetworkStereo(load_network(config.weights or find(WEIGHTS))).depth_maps)


def load_network(path: Path) -> PatchmatchNet:
    network = PatchmatchNet()
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:
        first_line = str(error).splitlines()[0]
        raise WeightsError(f"{path} is not the state dict of PatchmatchNet ({first_line}); fetch it again") from error
    return network.eval().requires_grad_(False)
