"""The configuration of matching: local features, which pairs are matched and how, which get simulated tilts."""

from __future__ import annotations

import msgspec

from splatnode.recon.matching import candidates, features, pair_matching, tilting


class Moving(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of `matching/moving.py`."""

    enabled: bool = True  # look for things that moved between photographs that are all at hand, and leave them out


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.Config = features.Config()
    candidates: candidates.Config = candidates.Config()
    pair_matching: pair_matching.Config = pair_matching.Config()
    tilting: tilting.Config = tilting.Config()
    moving: Moving = Moving()
