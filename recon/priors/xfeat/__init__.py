"""XFeat and LighterGlue as a prior: the classical one, with learned matches where its own features find few."""

from __future__ import annotations

from pathlib import Path

from splatnode.recon.networks.weights import WeightsError, find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    features: Path | None = None  # ONNX files; None: where `splatnode weights` puts them
    matcher: Path | None = None
    num_keypoints: int = 2000


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError where onnxruntime or the weights are missing, or are not XFeat's."""
    try:
        from splatnode.recon.priors.xfeat.matcher import XfeatMatcher
        from splatnode.recon.priors.xfeat.network import load_network
    except ModuleNotFoundError as error:
        raise WeightsError("the prior xfeat needs onnxruntime: pip install 'splatnode[xfeat]'") from error
    features = config.features or find("xfeat/xfeat_640x640.onnx")
    matcher = config.matcher or find("xfeat/lighterglue_L3.onnx")
    return ClassicalPrior(config, matcher=XfeatMatcher(load_network(features, matcher), config.num_keypoints))
