"""The configuration of matching: local features, which pairs are matched and how, which get simulated tilts."""

from __future__ import annotations

import msgspec

from splatnode.recon.matching import candidates, features, pair_matching, tilting


class MovingObjectsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of `matching/moving.py`."""

    enabled: bool = True  # look for things that moved between photographs that are all at hand, and leave them out


class MatchingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.FeatureConfig = features.FeatureConfig()
    candidates: candidates.PairSelectionConfig = candidates.PairSelectionConfig()
    pair_matching: pair_matching.PairMatchingConfig = pair_matching.PairMatchingConfig()
    tilting: tilting.AffineSimulationConfig = tilting.AffineSimulationConfig()
    moving: MovingObjectsConfig = MovingObjectsConfig()
