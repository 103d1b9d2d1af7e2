"""MASt3R (Leroy et al. 2024), the paper's prior: matches and point maps from a network, for non-commercial use."""

from splatnode.recon.priors.mast3r.prior import Config, load

__all__ = ["Config", "load"]
