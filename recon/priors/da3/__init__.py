"""Depth Anything 3 Small (Apache-2.0): cameras, depth and confidence of any number of photographs."""

from splatnode.recon.priors.da3.prior import Config, load

__all__ = ["Config", "load"]
