"""The configuration of matching: local features, which pairs are matched and how, which get simulated tilts."""

from __future__ import annotations

import msgspec

from splatnode.recon.matching import candidates, features, pair_matching, tilting


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.Config = features.Config()
    candidates: candidates.Config = candidates.Config()
    pair_matching: pair_matching.Config = pair_matching.Config()
    tilting: tilting.Config = tilting.Config()
