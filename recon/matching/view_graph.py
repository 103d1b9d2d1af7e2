"""The view graph: keyframes as nodes, verified pairs of them as edges. A value: every change gives another graph.

Nothing here matches anything: that is done, one pair at a time, by `matching/match.py`.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from splatnode.recon.frames.keyframe import Keyframe, content_key
from splatnode.recon.matching.candidates import select_pairs_worth_matching
from splatnode.recon.matching.components import find_components
from splatnode.recon.matching.config import MatchingConfig
from splatnode.recon.matching.image_code import Code
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.tilting import is_strong_pair, select_weak_pairs
from splatnode.recon.matching.two_view import TwoView

T = TypeVar("T")
Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """Keyframes by position, and their pairs, which do not depend on the order in which the keyframes came.

    `plain` and `tilted` hold pairs as matched by plain and by tilted features, the first frame in order of content
    first. `glanced` holds how many matches pairs have at a glance, `codes` the code of each image by its name. `pairs`
    holds what was chosen of them, by position (i < j); pairs that were restored from a checkpoint, which
    this process has not matched, stay as they are.
    """

    config: MatchingConfig
    keyframes: tuple[Keyframe, ...] = ()
    pairs: Mapping[Pair, TwoView] = field(default_factory=dict)  # verified
    pending: frozenset[Pair] = frozenset()  # (i < j) that have not been matched; not all of them are worth it
    plain: Mapping[Pair, MatchedPair] = field(default_factory=dict)
    tilted: Mapping[Pair, MatchedPair] = field(default_factory=dict)
    glanced: Mapping[Pair, int] = field(default_factory=dict)  # (i < j)
    codes: Mapping[str, Code] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Returns the names of the keyframes, in their order."""
        return [keyframe.name for keyframe in self.keyframes]

    def add_keyframe(self, keyframe: Keyframe) -> ViewGraph:
        """Adds a keyframe at the end, which is matched with none yet."""
        new = len(self.keyframes)
        pending = self.pending.union((index, new) for index in range(new))
        return replace(self, keyframes=(*self.keyframes, keyframe), pending=pending)

    def remove_keyframes(self, names: Collection[str]) -> ViewGraph:
        """The view graph of the other keyframes, with what is known of their pairs."""
        kept = [index for index, keyframe in enumerate(self.keyframes) if keyframe.name not in names]
        position = {index: place for place, index in enumerate(kept)}

        def remaining(pairs: Mapping[Pair, T]) -> dict[Pair, T]:
            return {(position[i], position[j]): found for (i, j), found in pairs.items() if {i, j} <= position.keys()}

        rest = ViewGraph(
            self.config,
            tuple(self.keyframes[index] for index in kept),
            remaining(self.pairs),
            frozenset(remaining(dict.fromkeys(self.pending))),
            remaining(self.plain),
            remaining(self.tilted),
            remaining(self.glanced),
            {name: code for name, code in self.codes.items() if name not in names},
        )
        return rest if rest.select_pairs_to_match() else rest.select_geometries()

    def forget_pairs(self, names: Collection[str]) -> ViewGraph:
        """The same keyframes; nothing is known of the pairs of these, and nothing pending."""
        gone = {index for index, keyframe in enumerate(self.keyframes) if keyframe.name in names}

        def remaining(pairs: Mapping[Pair, T]) -> dict[Pair, T]:
            return {pair: found for pair, found in pairs.items() if gone.isdisjoint(pair)}

        return replace(
            self,
            pairs=remaining(self.pairs),
            pending=frozenset(remaining(dict.fromkeys(self.pending))),
            plain=remaining(self.plain),
            tilted=remaining(self.tilted),
            glanced=remaining(self.glanced),
        )

    def replace_keyframes(self, keyframes: Collection[Keyframe]) -> ViewGraph:
        """Replaces the keyframes of the same names; all their pairs are pending."""
        names, by_name = self.names, {keyframe.name: keyframe for keyframe in keyframes}
        changed = {index for index, name in enumerate(names) if name in by_name}
        rest = self.forget_pairs(by_name)
        pairs = itertools.combinations(range(len(names)), 2)
        return replace(
            rest,
            keyframes=tuple(by_name.get(keyframe.name, keyframe) for keyframe in self.keyframes),
            pending=rest.pending.union(pair for pair in pairs if not changed.isdisjoint(pair)),
            codes={name: code for name, code in self.codes.items() if name not in by_name},
        )

    def merge(self, other: ViewGraph) -> ViewGraph:
        """The view graph of the keyframes of both, by frame id, with the pairs that either has matched.

        Where both have a pair, this graph's counts. Pairs that neither has matched are pending.
        """
        by_name = {keyframe.name: keyframe for keyframe in (*other.keyframes, *self.keyframes)}
        keyframes = sorted(by_name.values(), key=lambda keyframe: keyframe.frame.frame_id)
        position = {keyframe.name: index for index, keyframe in enumerate(keyframes)}
        everything = frozenset(itertools.combinations(range(len(keyframes)), 2))
        both = ViewGraph(self.config, tuple(keyframes), pending=everything)
        for graph in (other, self):
            both = both._merge_pairs(graph, [position[name] for name in graph.names])
        return both

    def _merge_pairs(self, graph: ViewGraph, number: Sequence[int]) -> ViewGraph:
        """Merges what `graph` knows, whose keyframe i is keyframe `number[i]` here."""
        keyframes, pairs = list(self.keyframes), dict(self.pairs)
        for index, keyframe in zip(number, graph.keyframes, strict=True):
            if len(keyframe.features.points) > len(keyframes[index].features.points):  # with tilted ones
                keyframes[index] = keyframe
        for (i, j), pair in graph.pairs.items():
            pairs[_ascending(number[i], number[j])] = pair if number[i] < number[j] else pair.swap()
        known = set(itertools.combinations(range(len(number)), 2)) - graph.pending
        return replace(
            self,
            keyframes=tuple(keyframes),
            pairs=pairs,
            pending=self.pending.difference(_ascending(number[i], number[j]) for i, j in known),
            plain={**self.plain, **{(number[i], number[j]): found for (i, j), found in graph.plain.items()}},
            tilted={**self.tilted, **{(number[i], number[j]): found for (i, j), found in graph.tilted.items()}},
            glanced={**self.glanced, **{_ascending(number[i], number[j]): n for (i, j), n in graph.glanced.items()}},
            codes={**self.codes, **graph.codes},
        )

    def sort_by_content(self, *indices: int) -> tuple[int, ...]:
        return tuple(sorted(indices, key=lambda index: content_key(self.keyframes[index])))

    def partners(self, index: int) -> dict[int, int]:
        """The keyframes that form a verified pair with keyframe `index`, with the number of inlier matches."""
        return {i + j - index: len(pair.matches) for (i, j), pair in self.pairs.items() if index in (i, j)}

    def components(self) -> list[list[int]]:
        """Positions of the keyframes that verified pairs connect, the largest component first."""
        return find_components(range(len(self.keyframes)), self.pairs)

    def select_pairs_worth_matching(self) -> set[Pair]:
        """The pairs (i < j), matched or not, that are worth it (`candidates.worth_matching`)."""
        firm = {
            _ascending(i, j)
            for (i, j), pair in self.plain.items()
            if is_strong_pair(pair.geometry, self.config.tilting)
        }
        firm |= {pair for pair, geometry in self.pairs.items() if is_strong_pair(geometry, self.config.tilting)}
        return select_pairs_worth_matching(
            len(self.keyframes),
            self.glanced,
            lambda pair: pair not in self.pending,
            firm.__contains__,
            self.config.candidates,
        )

    def select_pairs_to_match(self) -> set[Pair]:
        """The pending pairs that are worth matching; once they are matched, others may follow."""
        return self.select_pairs_worth_matching() & self.pending

    def select_weak_pairs(self) -> set[Pair]:
        """The pairs that tilted features are worth their time for, by what the plain ones say of all pairs."""
        return self._select_weak_pairs_among(self.select_pairs_worth_matching())

    def _select_weak_pairs_among(self, worth: set[Pair]) -> set[Pair]:
        plain = {pair: found for pair, found in self.plain.items() if _ascending(*pair) in worth}
        return select_weak_pairs(plain, len(self.keyframes), self.config.tilting)

    def select_geometries(self) -> ViewGraph:
        """Selects the geometry of tilted features for pairs that need them, and of plain ones for the others.

        Pairs that were matched and turned out not to be worth it do not count.
        """
        worth, pairs = self.select_pairs_worth_matching(), dict(self.pairs)
        to_tilt = self._select_weak_pairs_among(worth)
        for (first, second), plain in self.plain.items():
            tilted = self.tilted.get((first, second)) if (first, second) in to_tilt else None
            geometry = (tilted.geometry if tilted else None) or plain.geometry
            pairs.pop(_ascending(first, second), None)
            if geometry is not None and _ascending(first, second) in worth:
                pairs[_ascending(first, second)] = geometry if first < second else geometry.swap()
        return replace(self, pairs=pairs)


def _ascending(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)
