"""The view graph: keyframes as nodes, verified pairs of them as edges."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, content_key
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.components import connected_components
from splatnode.recon.matching.config import Config
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.tilting import pairs_to_tilt
from splatnode.recon.matching.two_view import TwoView

T = TypeVar("T")
Pair = tuple[int, int]


class Matcher(Protocol):
    """Finds matches that the plain features do not, as a prior may."""

    def with_points(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with the points that `match` needs added after those it has, which keep their numbers."""
        ...

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        """(M, 2) numbers of points that show the same, the most distinct first; they are verified afterwards."""
        ...


FIRST_COMPARISONS = 4  # keyframes that one added `soon` is matched with at once
MIN_PARTNERS = 2  # verified pairs that it then needs; with fewer it is matched with all


class ViewGraph:
    """Grows by one keyframe at a time; its pairs do not depend on the order in which the keyframes came.

    Every pair is matched by plain features. Pairs that match weakly but may overlap (`tilting.pairs_to_tilt`) are
    matched again with tilted features, which bridge wider baselines, and with what a prior's matcher proposes.

    A keyframe may be added `soon`: it is matched with a few others at once, and with the rest by `complete`.
    """

    def __init__(self, config: Config, matcher: Matcher | None = None) -> None:
        self._config, self._matcher = config, matcher
        self.keyframes: list[Keyframe] = []
        self.pairs: dict[Pair, TwoView] = {}  # verified, by position (i < j)
        self.pending: set[Pair] = set()  # that have not been matched, by position (i < j)
        self._plain: dict[Pair, MatchedPair] = {}  # by position; the first frame is the first in order of content
        self._tilted: dict[Pair, MatchedPair] = {}  # the same

    def add(self, keyframe: Keyframe, soon: bool = False) -> None:
        """Adds `keyframe` and matches it with all others.

        If `soon`, only with FIRST_COMPARISONS others and without tilted features, if that connects it: the latest one,
        then those that share most with its partners.
        """
        new = len(self.keyframes)
        self.keyframes.append(keyframe)
        self.pending |= {(index, new) for index in range(new)}
        if not soon:
            self.complete()
            return
        for _ in range(min(FIRST_COMPARISONS, new)):
            self._match_plain(self._most_promising(new), new)
        if len(self._partners(new)) < MIN_PARTNERS:
            self.complete()

    def complete(self, pause: Callable[[], None] = lambda: None) -> None:
        """Matches all pending pairs. `pause` is called before each pair and may raise; what was matched is kept."""
        for pair in sorted(self.pending):
            pause()
            self._match_plain(*pair)
        self._choose_pairs(pause)

    def _match_plain(self, index: int, new: int) -> None:
        """Matches two keyframes by their plain features; `_choose_pairs` may replace the result."""
        first, second = self._in_order(index, new)
        matched = pair_matching.match_plain(self.keyframes[first], self.keyframes[second], self._config.pair_matching)
        self._plain[first, second] = matched
        self.pending.discard((index, new))
        if matched.geometry is not None:
            self.pairs[index, new] = matched.geometry if first < second else matched.geometry.swapped()

    def _most_promising(self, new: int) -> int:
        """Of the keyframes pending with `new`, the one that shares most with its partners; else the latest."""
        mine = self._partners(new)
        score = {
            index: sum(shared * mine.get(partner, 0) for partner, shared in self._partners(index).items())
            for index in range(new)
            if (index, new) in self.pending
        }
        return max(score, key=lambda index: (score[index], index))

    def _partners(self, index: int) -> dict[int, int]:
        """The keyframes that form a verified pair with keyframe `index`, with the number of inlier matches."""
        return {i + j - index: len(pair.matches) for (i, j), pair in self.pairs.items() if index in (i, j)}

    def without(self, names: Collection[str], pause: Callable[[], None] = lambda: None) -> ViewGraph:
        """A view graph of the other keyframes, with their pairs; this one stays as it is.

        Without the firm pairs of what is gone, others may be worth tilted features. `pause` is called before each such
        pair and may raise.
        """
        kept = [index for index, keyframe in enumerate(self.keyframes) if keyframe.name not in names]
        new = {index: position for position, index in enumerate(kept)}

        def remaining(pairs: Mapping[Pair, T]) -> dict[Pair, T]:
            return {(new[i], new[j]): value for (i, j), value in pairs.items() if i in new and j in new}

        rest = ViewGraph(self._config, self._matcher)
        rest.keyframes = [self.keyframes[index] for index in kept]
        rest.pairs = remaining(self.pairs)
        rest._plain, rest._tilted = remaining(self._plain), remaining(self._tilted)
        rest.pending = set(remaining(dict.fromkeys(self.pending)))
        if not rest.pending:
            rest._choose_pairs(pause)
        return rest

    def joined(self, other: ViewGraph) -> ViewGraph:
        """A view graph of the keyframes of both, by frame id, with the pairs that either has matched.

        Where both have a pair, this graph's counts. Pairs that neither has matched are pending.
        """
        both = ViewGraph(self._config, self._matcher)
        keyframes = {keyframe.name: keyframe for keyframe in (*other.keyframes, *self.keyframes)}
        both.keyframes = sorted(keyframes.values(), key=lambda keyframe: keyframe.frame.frame_id)
        position = {keyframe.name: index for index, keyframe in enumerate(both.keyframes)}
        both.pending = set(itertools.combinations(range(len(both.keyframes)), 2))
        for graph in (other, self):
            both._take_over(graph, [position[keyframe.name] for keyframe in graph.keyframes])
        return both

    def _take_over(self, graph: ViewGraph, new: Sequence[int]) -> None:
        """Takes over all that `graph` has matched; its keyframe i is keyframe `new[i]` here."""
        for index, keyframe in zip(new, graph.keyframes, strict=True):
            if len(keyframe.features.points) > len(self.keyframes[index].features.points):  # with tilted ones
                self.keyframes[index] = keyframe
        for (i, j), pair in graph.pairs.items():
            first, second = new[i], new[j]
            self.pairs[min(first, second), max(first, second)] = pair if first < second else pair.swapped()
        self._plain |= {(new[i], new[j]): matched for (i, j), matched in graph._plain.items()}
        self._tilted |= {(new[i], new[j]): matched for (i, j), matched in graph._tilted.items()}
        for i, j in itertools.combinations(range(len(new)), 2):
            if (i, j) not in graph.pending:
                self.pending.discard((min(new[i], new[j]), max(new[i], new[j])))

    def _choose_pairs(self, pause: Callable[[], None] = lambda: None) -> None:
        """Takes for each matched pair the geometry of its tilted features, where it needs them, else of its plain ones.

        Pairs restored from a checkpoint, which this process has not matched, stay as they are.
        """
        to_tilt = pairs_to_tilt(self._plain, len(self.keyframes), self._config.tilting)
        for pair, plain in self._plain.items():
            if pair in to_tilt and pair not in self._tilted:
                pause()
                self._tilted[pair] = self._match_tilted(*pair)
            geometry = (self._tilted[pair].geometry if pair in to_tilt else None) or plain.geometry
            first, second = pair
            self.pairs.pop((min(pair), max(pair)), None)
            if geometry is not None:
                self.pairs[min(pair), max(pair)] = geometry if first < second else geometry.swapped()

    def _match_tilted(self, first: int, second: int) -> MatchedPair:
        """Matches two keyframes with tilted features, which they get first, and with what the matcher proposes."""
        for index in (first, second):
            keyframe = self.keyframes[index]
            with_tilted = features.add_tilted(
                keyframe.features, keyframe.frame.image, self._config.tilting.tilts, self._config.features
            )
            self.keyframes[index] = replace(keyframe, features=with_tilted)
        keyframes = self.keyframes[first], self.keyframes[second]
        tilted = pair_matching.match_tilted(*keyframes, self._plain[first, second], self._config.pair_matching)
        if self._matcher is None:
            return tilted
        for index in (first, second):
            self.keyframes[index] = self._matcher.with_points(self.keyframes[index])
        keyframes = self.keyframes[first], self.keyframes[second]
        proposed = self._matcher.match(*keyframes)
        return pair_matching.add_proposed(*keyframes, tilted, proposed, self._config.pair_matching)

    def _in_order(self, *indices: int) -> tuple[int, ...]:
        """The positions of keyframes, sorted by the keyframes' content."""
        return tuple(sorted(indices, key=lambda index: content_key(self.keyframes[index])))

    def components(self) -> list[list[int]]:
        """Positions of the keyframes that verified pairs connect, the largest component first."""
        return connected_components(range(len(self.keyframes)), self.pairs)
