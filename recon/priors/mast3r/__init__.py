"""MASt3R (Leroy et al. 2024), the paper's prior: matches and depth from a network, for non-commercial use."""

from splatnode.recon.priors.mast3r.prior import WEIGHTS, Config, load

__all__ = ["WEIGHTS", "Config", "load"]
