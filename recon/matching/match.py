"""Matches the keyframes of a view graph, one pair at a time: work that is abandoned loses one pair at most."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.config import Config
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.view_graph import Pair, ViewGraph

FIRST_COMPARISONS = 4  # keyframes that a further one is matched with at once
MIN_PARTNERS = 2  # verified pairs that it then needs; with fewer it is matched with all


class Matcher(Protocol):
    """Finds matches that the plain features do not, as a prior may."""

    def with_points(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with the points that `match` needs added after those it has, which keep their numbers."""
        ...

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        """(M, 2) numbers of points that show the same, the most distinct first; they are verified afterwards."""
        ...


def match(
    keyframes: Iterable[Keyframe],
    config: Config,
    matcher: Matcher | None = None,
    pause: Callable[[], None] = lambda: None,
) -> ViewGraph:
    """The view graph of the keyframes, each matched with all others. `pause` may raise to abandon the work."""
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.with_keyframe(keyframe)
    for further in completed(graph, matcher):
        pause()
        graph = further
    return graph


def matched_soon(graph: ViewGraph, matcher: Matcher | None) -> Iterator[ViewGraph]:
    """The graph while its newest keyframe is matched with a few others, if these connect it; else with all.

    First with the latest one, then with those that share most with its partners, by plain features.
    """
    new = len(graph.keyframes) - 1
    for _ in range(min(FIRST_COMPARISONS, new)):
        graph = _matched_plain(graph, (_most_promising(graph, new), new))
        yield graph
    if len(graph.partners(new)) < MIN_PARTNERS:
        yield from completed(graph, matcher)


def completed(graph: ViewGraph, matcher: Matcher | None) -> Iterator[ViewGraph]:
    """The graph after each pair that was pending; the last one is complete.

    Every pair is matched by plain features. Pairs that match weakly but may overlap (`tilting.pairs_to_tilt`) are
    matched again with tilted features, which bridge wider baselines, and with what a prior's matcher proposes.
    """
    for pair in sorted(graph.pending):
        graph = _matched_plain(graph, pair)
        yield graph
    to_tilt = graph.to_tilt()
    for pair in [pair for pair in graph.plain if pair in to_tilt and pair not in graph.tilted]:
        graph = matched_further(graph, pair, graph.config.tilting.tilts, matcher)
        yield graph
    yield graph.chosen()


def _matched_plain(graph: ViewGraph, pair: Pair) -> ViewGraph:
    """With two keyframes matched by their plain features."""
    first, second = graph.in_order_of_content(*pair)
    found = pair_matching.match_plain(graph.keyframes[first], graph.keyframes[second], graph.config.pair_matching)
    pairs = dict(graph.pairs)
    if found.geometry is not None:
        pairs[pair] = found.geometry if first < second else found.geometry.swapped()
    return replace(
        graph, pairs=pairs, pending=graph.pending - {pair}, plain={**graph.plain, (first, second): found}
    )  # fmt: skip


def _most_promising(graph: ViewGraph, new: int) -> int:
    """Of the keyframes pending with `new`, the one that shares most with its partners; else the latest."""
    mine = graph.partners(new)
    score = {
        index: sum(shared * mine.get(partner, 0) for partner, shared in graph.partners(index).items())
        for index in range(new)
        if (index, new) in graph.pending
    }
    return max(score, key=lambda index: (score[index], index))


def matched_further(graph: ViewGraph, pair: Pair, tilts: Sequence[float], matcher: Matcher | None = None) -> ViewGraph:
    """With matches by features of these tilts, which the two keyframes get first, and by what the matcher proposes.

    They are added to what is known of `pair`, a key of `plain`. `ViewGraph.chosen` makes them count.
    """
    keyframes = list(graph.keyframes)
    found = graph.tilted.get(pair, graph.plain[pair])
    if tilts:
        for index in pair:
            keyframes[index] = _with_tilted_features(keyframes[index], tilts, graph.config)
        found = pair_matching.match_tilted(*_of(keyframes, pair), found, tilts, graph.config.pair_matching)
    if matcher is not None:
        for index in pair:
            keyframes[index] = matcher.with_points(keyframes[index])
        found = _with_matcher(*_of(keyframes, pair), found, matcher, graph.config)
    return replace(graph, keyframes=tuple(keyframes), tilted={**graph.tilted, pair: found})


def _of(keyframes: list[Keyframe], pair: Pair) -> tuple[Keyframe, Keyframe]:
    return keyframes[pair[0]], keyframes[pair[1]]


def _with_tilted_features(keyframe: Keyframe, tilts: Sequence[float], config: Config) -> Keyframe:
    found = features.add_tilted(keyframe.features, keyframe.frame.image, tilts, config.features)
    return replace(keyframe, features=found)


def _with_matcher(
    first: Keyframe, second: Keyframe, found: MatchedPair, matcher: Matcher, config: Config
) -> MatchedPair:
    return pair_matching.add_proposed(first, second, found, matcher.match(first, second), config.pair_matching)
