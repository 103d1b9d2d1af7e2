"""XFeat (Potje et al. 2024) and LighterGlue as a prior: classical depth, learned matches where plain ones are few."""

from __future__ import annotations

from pathlib import Path

from splatnode.capture.process.config_keys import Internal
from splatnode.recon.networks.weights import WeightsError, find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

WEIGHTS = ("xfeat/xfeat_640x640.onnx", "xfeat/lighterglue_L3.onnx")
PACKAGE = "onnxruntime"


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    features: Path | None = None  # ONNX file of XFeat; None: where `splatnode weights` puts it
    matcher: Path | None = None  # ONNX file of LighterGlue; None: the same
    num_keypoints: Internal[int] = 2000  # of an image, at most


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError where onnxruntime or the weights are missing, or are not XFeat's."""
    try:
        from splatnode.recon.priors.xfeat.matcher import XfeatMatcher
        from splatnode.recon.priors.xfeat.network import load_network
    except ModuleNotFoundError as error:
        raise WeightsError("the prior xfeat needs onnxruntime: pip install 'splatnode[xfeat]'") from error
    features = config.features or find(WEIGHTS[0])
    matcher = config.matcher or find(WEIGHTS[1])
    return ClassicalPrior(config, matcher=XfeatMatcher(load_network(features, matcher), config.num_keypoints))
