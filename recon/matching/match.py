"""Matches the keyframes of a view graph: work that is abandoned loses the few pairs that are under way."""

from __future__ import annotations

import logging
import math
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.progress import Step, Tell, told_to_nobody
from splatnode.recon.deadline import is_over
from splatnode.recon.frames.keyframe import LIBRARY_ERRORS, Keyframe
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.candidates import to_glance_at
from splatnode.recon.matching.config import Config
from splatnode.recon.matching.image_code import image_code
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.view_graph import Pair, ViewGraph
from splatnode.recon.workers import each, in_turn

log = logging.getLogger(__name__)

FIRST_COMPARISONS = 4  # keyframes that a further one is matched with at once
MIN_PARTNERS = 2  # verified pairs that it then needs; with fewer it is matched with all

Steps = Generator[ViewGraph, None, ViewGraph]  # the graph after each step, and in the end


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
    until: float = math.inf,
    tell: Tell = told_to_nobody,
) -> ViewGraph:
    """The complete view graph of the keyframes. `until` as for `completed`; `tell` hears how far it is."""
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.with_keyframe(keyframe)
    for further in _told(completed(graph, matcher, until), tell):
        graph = further
    return graph


def _told(graphs: Iterable[ViewGraph], tell: Tell) -> Iterator[ViewGraph]:
    """The graphs of `completed`, each of which is told. What is still to match is asked once a round: it takes long."""
    what, plain, of, weak = "photograph pair", -1, 0, 0
    for graph in graphs:
        if len(graph.plain) > plain:
            plain = len(graph.plain)
            of = of if plain < of else plain + len(graph.to_match())
            if of:
                tell(Step("matching", plain, of, what))
        elif weak := weak or len(graph.to_tilt()):
            tell(Step("matching weak pairs again", len(graph.tilted), weak, what))
        yield graph


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


def completed(graph: ViewGraph, matcher: Matcher | None, until: float = math.inf) -> Iterator[ViewGraph]:
    """The graph after each pair that was pending and is worth matching; the last one is complete.

    Pairs are matched by plain features. Those that match weakly but may overlap (`tilting.pairs_to_tilt`) are matched
    again with tilted features, which bridge wider baselines, and with what a prior's matcher proposes: but for those of
    which the turn comes after `until`, a time of `time.monotonic()`.
    """
    graph = yield from _glanced(graph)
    while pairs := sorted(graph.to_match()):
        graph = yield from _all_matched_plain(graph, pairs)
    to_tilt = graph.to_tilt()
    weak = [pair for pair in graph.plain if pair in to_tilt and pair not in graph.tilted]
    for further in _all_matched_further(graph, weak, graph.config.tilting.tilts, matcher):
        if is_over(until):
            break
        yield (graph := further)
    yield graph.chosen()


def _glanced(graph: ViewGraph) -> Steps:
    """With codes of the images and matches at a glance, as far as these are needed to choose the pairs."""
    config = graph.config
    if len(graph.keyframes) <= config.candidates.exhaustive:
        return graph
    without = [keyframe for keyframe in graph.keyframes if keyframe.name not in graph.codes]
    codes = each(lambda keyframe: image_code(keyframe.features), without)
    names = [keyframe.name for keyframe in without]
    graph = replace(graph, codes={**graph.codes, **dict(zip(names, codes, strict=True))})
    yield graph

    def glance(pair: Pair) -> int:
        first, second = (graph.keyframes[index] for index in graph.in_order_of_content(*pair))
        return pair_matching.glance(first, second, config.candidates.glance_features, config.pair_matching)

    wanted = to_glance_at([graph.codes[name] for name in graph.names], config.candidates)
    missing = sorted(wanted.difference(graph.glanced))
    found = dict(zip(missing, each(glance, missing), strict=True))
    return replace(graph, glanced={**graph.glanced, **found})


def _matched_plain(graph: ViewGraph, pair: Pair) -> ViewGraph:
    """With two keyframes matched by their plain features."""
    *_, matched = _all_matched_plain(graph, [pair])
    return matched


def _all_matched_plain(graph: ViewGraph, pairs: Sequence[Pair]) -> Steps:
    """After each of the `pairs` that is matched by plain features."""
    keyframes, config = graph.keyframes, graph.config.pair_matching
    ordered = [graph.in_order_of_content(*pair) for pair in pairs]
    matches = in_turn(lambda pair: pair_matching.match_plain(*_of(keyframes, pair), config), ordered)
    for pair, (first, second), found in zip(pairs, ordered, matches, strict=True):
        verified = dict(graph.pairs)
        if found.geometry is not None:
            verified[pair] = found.geometry if first < second else found.geometry.swapped()
        plain = {**graph.plain, (first, second): found}
        graph = replace(graph, pairs=verified, pending=graph.pending - {pair}, plain=plain)
        yield graph
    return graph


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
    *_, matched = _all_matched_further(graph, [pair], tilts, matcher)
    return matched


def _all_matched_further(
    graph: ViewGraph, pairs: Sequence[Pair], tilts: Sequence[float], matcher: Matcher | None
) -> Steps:
    """After each step of `matched_further` for all `pairs`."""
    config = graph.config
    for index in sorted({index for pair in pairs for index in pair}):
        keyframes = list(graph.keyframes)
        keyframes[index] = _with_tilted_features(keyframes[index], tilts, config)
        graph = replace(graph, keyframes=tuple(keyframes))
        yield graph
    known = graph

    def tilted(pair: Pair) -> MatchedPair:
        found = known.tilted.get(pair, known.plain[pair])
        both = _of(known.keyframes, pair)
        return pair_matching.match_tilted(*both, found, tilts, config.pair_matching) if tilts else found

    for pair, found in zip(pairs, in_turn(tilted, pairs), strict=True):
        if matcher is not None:
            keyframes = list(graph.keyframes)
            for index in pair:
                keyframes[index] = matcher.with_points(keyframes[index])
            graph = replace(graph, keyframes=tuple(keyframes))
            found = _with_matcher(*_of(graph.keyframes, pair), found, matcher, config)
        graph = replace(graph, tilted={**graph.tilted, pair: found})
        yield graph
    return graph


def _of(keyframes: Sequence[Keyframe], pair: Sequence[int]) -> tuple[Keyframe, Keyframe]:
    return keyframes[pair[0]], keyframes[pair[1]]


def _with_tilted_features(keyframe: Keyframe, tilts: Sequence[float], config: Config) -> Keyframe:
    """With features of these tilts; as it is, which the log tells, where a library fails on its image."""
    try:
        return _add_tilted_features(keyframe, tilts, config)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        log.warning("%s is matched without simulated tilts: %s", keyframe.name, error)
        return keyframe


def _add_tilted_features(keyframe: Keyframe, tilts: Sequence[float], config: Config) -> Keyframe:
    found = features.add_tilted(keyframe.features, keyframe.frame.image, tilts, config.features)
    return replace(keyframe, features=features.used(found, keyframe.frame.mask))


def _with_matcher(
    first: Keyframe, second: Keyframe, found: MatchedPair, matcher: Matcher, config: Config
) -> MatchedPair:
    proposed = matcher.match(first, second)
    proposed = proposed[_shown(first, proposed[:, 0]) & _shown(second, proposed[:, 1])]
    return pair_matching.add_proposed(first, second, found, proposed, config.pair_matching)


def _shown(keyframe: Keyframe, points: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(M,) which of the points with these numbers no mask hides."""
    if keyframe.frame.mask is None:
        return np.ones(len(points), bool)
    inside = features.well_inside(keyframe.frame.mask)
    x, y = np.clip(keyframe.features.points[points].astype(np.int64), 0, np.array(inside.shape)[::-1] - 1).T
    return inside[y, x]
