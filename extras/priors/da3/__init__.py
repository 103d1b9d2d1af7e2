"""Depth Anything 3 Small (Lin et al. 2025, Apache-2.0) as a prior: matches and depth for any number of photographs."""

from splatnode.extras.priors.da3.prior import PACKAGE, WEIGHTS, Config, load

__all__ = ["PACKAGE", "WEIGHTS", "Config", "load"]
