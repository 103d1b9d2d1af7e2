"""What matching can be told: features, descriptor matches, two-view geometry, and when a pair is compared again."""

from __future__ import annotations

import msgspec

from splatnode.recon.matching import features, nearest_neighbours, two_view


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.Config = features.Config()
    nearest_neighbours: nearest_neighbours.Config = nearest_neighbours.Config()
    two_view: two_view.Config = two_view.Config()
    squeezes: tuple[float, ...] = (1.6,)  # of the image's width, for pairs that share little
    firm_matches: int = 150  # verified matches from which on a pair needs no squeezed features
    enough_firm_pairs: int = 4  # of a frame, so that it needs no more
    # log10 of the false alarms of a pair's plain matches from which on squeezed ones are tried although firm pairs
    # connect the frames already: of 40 such pairs that squeezed features verified, 39 were below, of others one in ten.
    hint_log10_nfa: float = -1.0
    still_px: float = 1.0  # median motion of a pair, at 1024 px, below which it may show the robot itself
    enough_moved: int = 60  # matches that moved by more, so that they are asked by themselves
