"""Which pairs of keyframes are matched again with simulated tilts, which find more and take three times as long."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from splatnode.recon.matching.components import find_components
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.two_view import TwoView


class AffineSimulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    tilts: tuple[float, ...] = (
        1.6,
    )  # by which the image's width is divided; below 1, its height multiplied; none: no pair is matched again
    firm_matches: int = 150  # verified matches that make a pair firm: it needs no tilted features
    enough_firm_pairs: int = 4  # firm pairs of a frame, so that it needs no more
    # log10 of the number of false alarms of a pair's plain matches below which the pair may overlap: of 40 pairs that
    # tilted features verified 39 were below it, of all others one in ten.
    hint_log10_nfa: float = -1.0


def is_strong_pair(geometry: TwoView | None, config: AffineSimulationConfig) -> bool:
    """Whether a pair has so many verified matches that nothing need be done to find more."""
    return geometry is not None and len(geometry.matches) >= config.firm_matches


def select_weak_pairs(
    plain: Mapping[tuple[int, int], MatchedPair], num_keyframes: int, config: AffineSimulationConfig
) -> set[tuple[int, int]]:
    """The pairs that are worth matching with tilted features, given what the `plain` features say of all pairs.

    Such a pair is not firm, one of its frames has few firm pairs, and the frames may overlap: their plain matches hint
    at it, they have a firm partner in common, or no chain of firm pairs connects them.
    """
    if not config.tilts:
        return set()
    firm = {pair for pair, matched in plain.items() if is_strong_pair(matched.geometry, config)}
    everyone = range(num_keyframes)
    partners = [{i + j - index for i, j in firm if index in (i, j)} for index in everyone]
    components = find_components(everyone, firm)
    component_of = {index: number for number, component in enumerate(components) for index in component}

    def may_overlap(i: int, j: int) -> bool:
        hinted = plain[i, j].log10_nfa < config.hint_log10_nfa
        return hinted or component_of[i] != component_of[j] or not partners[i].isdisjoint(partners[j])

    return {
        (i, j)
        for i, j in plain
        if (i, j) not in firm
        and min(len(partners[i]), len(partners[j])) < config.enough_firm_pairs
        and may_overlap(i, j)
    }
