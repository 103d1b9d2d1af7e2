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
from splatnode.capture.process.progress import ProgressStep, Tell, ignore_progress
from splatnode.recon.deadline import is_over
from splatnode.recon.frames.keyframe import LIBRARY_ERRORS, Keyframe
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.candidates import select_short_list_pairs
from splatnode.recon.matching.config import MatchingConfig
from splatnode.recon.matching.image_code import compute_global_descriptor
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.view_graph import Pair, ViewGraph
from splatnode.recon.workers import map_parallel, map_parallel_lazily

log = logging.getLogger(__name__)

FIRST_COMPARISONS = 4  # keyframes that a further one is matched with at once
MIN_PARTNERS = 2  # verified pairs that it then needs; with fewer it is matched with all

Steps = Generator[ViewGraph, None, ViewGraph]  # the graph after each step, and in the end


class Matcher(Protocol):
    """Finds matches that the plain features do not, as a prior may."""

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with the points that `match` needs added after those it has, which keep their numbers."""
        ...

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        """(M, 2) numbers of points that show the same, the most distinct first; they are verified afterwards."""
        ...


def match(
    keyframes: Iterable[Keyframe],
    config: MatchingConfig,
    matcher: Matcher | None = None,
    until: float = math.inf,
    tell: Tell = ignore_progress,
) -> ViewGraph:
    """The complete view graph of the keyframes. `until` as for `match_pending`; `tell` hears how far it is."""
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.add_keyframe(keyframe)
    for further in _report_progress(match_pending(graph, matcher, until), tell):
        graph = further
    return graph


def _report_progress(graphs: Iterable[ViewGraph], tell: Tell) -> Iterator[ViewGraph]:
    """The graphs of `match_pending`, each of which is told. What is still to match is asked once a round: it takes long."""
    what, plain, of, weak = "photograph pair", -1, 0, 0
    for graph in graphs:
        if len(graph.plain) > plain:
            plain = len(graph.plain)
            of = of if plain < of else plain + len(graph.select_pairs_to_match())
            if of:
                tell(ProgressStep("matching", plain, of, what))
        elif weak := weak or len(graph.select_weak_pairs()):
            tell(ProgressStep("matching weak pairs again", len(graph.tilted), weak, what))
        yield graph


def match_newest(graph: ViewGraph, matcher: Matcher | None) -> Iterator[ViewGraph]:
    """The graph while its newest keyframe is matched with a few others, if these connect it; else with all.

    First with the latest one, then with those that share most with its partners, by plain features.
    """
    new = len(graph.keyframes) - 1
    for _ in range(min(FIRST_COMPARISONS, new)):
        graph = _match_plain(graph, (_find_most_promising(graph, new), new))
        yield graph
    if len(graph.partners(new)) < MIN_PARTNERS:
        yield from match_pending(graph, matcher)


def match_pending(graph: ViewGraph, matcher: Matcher | None, until: float = math.inf) -> Iterator[ViewGraph]:
    """The graph after each pair that was pending and is worth matching; the last one is complete.

    Pairs are matched by plain features. Those that match weakly but may overlap (`tilting.pairs_to_tilt`) are matched
    again with tilted features, which bridge wider baselines, and with what a prior's matcher proposes: but for those of
    which the turn comes after `until`, a time of `time.monotonic()`.
    """
    graph = yield from _glance_pairs(graph)
    while pairs := sorted(graph.select_pairs_to_match()):
        graph = yield from _match_all_plain(graph, pairs)
    to_tilt = graph.select_weak_pairs()
    weak = [pair for pair in graph.plain if pair in to_tilt and pair not in graph.tilted]
    for further in _match_weak_pairs(graph, weak, graph.config.tilting.tilts, matcher):
        if is_over(until):
            break
        yield (graph := further)
    yield graph.select_geometries()


def _glance_pairs(graph: ViewGraph) -> Steps:
    """Adds global descriptors and quick matches, as far as these are needed to choose the pairs."""
    config = graph.config
    if len(graph.keyframes) <= config.candidates.exhaustive:
        return graph
    without = [keyframe for keyframe in graph.keyframes if keyframe.name not in graph.codes]
    codes = map_parallel(lambda keyframe: compute_global_descriptor(keyframe.features), without)
    names = [keyframe.name for keyframe in without]
    graph = replace(graph, codes={**graph.codes, **dict(zip(names, codes, strict=True))})
    yield graph

    def glance(pair: Pair) -> int:
        first, second = (graph.keyframes[index] for index in graph.sort_by_content(*pair))
        return pair_matching.glance(first, second, config.candidates.glance_features, config.pair_matching)

    wanted = select_short_list_pairs([graph.codes[name] for name in graph.names], config.candidates)
    missing = sorted(wanted.difference(graph.glanced))
    found = dict(zip(missing, map_parallel(glance, missing), strict=True))
    return replace(graph, glanced={**graph.glanced, **found})


def _match_plain(graph: ViewGraph, pair: Pair) -> ViewGraph:
    """Matches two keyframes by their plain features."""
    *_, matched = _match_all_plain(graph, [pair])
    return matched


def _match_all_plain(graph: ViewGraph, pairs: Sequence[Pair]) -> Steps:
    """After each of the `pairs` that is matched by plain features."""
    keyframes, config = graph.keyframes, graph.config.pair_matching
    ordered = [graph.sort_by_content(*pair) for pair in pairs]
    matches = map_parallel_lazily(
        lambda pair: pair_matching.match_plain(*_select_pair(keyframes, pair), config), ordered
    )
    for pair, (first, second), found in zip(pairs, ordered, matches, strict=True):
        verified = dict(graph.pairs)
        if found.geometry is not None:
            verified[pair] = found.geometry if first < second else found.geometry.swap()
        plain = {**graph.plain, (first, second): found}
        graph = replace(graph, pairs=verified, pending=graph.pending - {pair}, plain=plain)
        yield graph
    return graph


def _find_most_promising(graph: ViewGraph, new: int) -> int:
    """Returns the keyframe pending with `new` that shares most with its partners; else the latest."""
    mine = graph.partners(new)
    score = {
        index: sum(shared * mine.get(partner, 0) for partner, shared in graph.partners(index).items())
        for index in range(new)
        if (index, new) in graph.pending
    }
    return max(score, key=lambda index: (score[index], index))


def match_weak_pair(graph: ViewGraph, pair: Pair, tilts: Sequence[float], matcher: Matcher | None = None) -> ViewGraph:
    """Adds matches by features of these tilts, which both keyframes get first, and matcher proposals.

    They are added to what is known of `pair`, a key of `plain`. `ViewGraph.chosen` makes them count.
    """
    *_, matched = _match_weak_pairs(graph, [pair], tilts, matcher)
    return matched


def _match_weak_pairs(
    graph: ViewGraph, pairs: Sequence[Pair], tilts: Sequence[float], matcher: Matcher | None
) -> Steps:
    """After each step of `match_weak_pair` for all `pairs`."""
    config = graph.config
    for index in sorted({index for pair in pairs for index in pair}):
        keyframes = list(graph.keyframes)
        keyframes[index] = _try_affine_features(keyframes[index], tilts, config)
        graph = replace(graph, keyframes=tuple(keyframes))
        yield graph
    known = graph

    def match_tilted_pair(pair: Pair) -> MatchedPair:
        found = known.tilted.get(pair, known.plain[pair])
        both = _select_pair(known.keyframes, pair)
        return pair_matching.match_affine(*both, found, tilts, config.pair_matching) if tilts else found

    for pair, found in zip(pairs, map_parallel_lazily(match_tilted_pair, pairs), strict=True):
        if matcher is not None:
            keyframes = list(graph.keyframes)
            for index in pair:
                keyframes[index] = matcher.add_points(keyframes[index])
            graph = replace(graph, keyframes=tuple(keyframes))
            found = _add_matcher_proposals(*_select_pair(graph.keyframes, pair), found, matcher, config)
        graph = replace(graph, tilted={**graph.tilted, pair: found})
        yield graph
    return graph


def _select_pair(keyframes: Sequence[Keyframe], pair: Sequence[int]) -> tuple[Keyframe, Keyframe]:
    return keyframes[pair[0]], keyframes[pair[1]]


def _try_affine_features(keyframe: Keyframe, tilts: Sequence[float], config: MatchingConfig) -> Keyframe:
    """Adds features of these tilts; logs where a library fails, and leaves the keyframe as it is."""
    try:
        return _add_affine_features(keyframe, tilts, config)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        log.warning("%s is matched without simulated tilts: %s", keyframe.name, error)
        return keyframe


def _add_affine_features(keyframe: Keyframe, tilts: Sequence[float], config: MatchingConfig) -> Keyframe:
    found = features.add_affine_features(keyframe.features, keyframe.frame.image, tilts, config.features)
    return replace(keyframe, features=features.apply_mask(found, keyframe.frame.mask))


def _add_matcher_proposals(
    first: Keyframe, second: Keyframe, found: MatchedPair, matcher: Matcher, config: MatchingConfig
) -> MatchedPair:
    proposed = matcher.match(first, second)
    proposed = proposed[_is_unmasked(first, proposed[:, 0]) & _is_unmasked(second, proposed[:, 1])]
    return pair_matching.add_proposed(first, second, found, proposed, config.pair_matching)


def _is_unmasked(keyframe: Keyframe, points: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(M,) which of the points with these numbers no mask hides."""
    if keyframe.frame.mask is None:
        return np.ones(len(points), bool)
    inside = features.well_inside(keyframe.frame.mask)
    x, y = np.clip(keyframe.features.points[points].astype(np.int64), 0, np.array(inside.shape)[::-1] - 1).T
    return inside[y, x]
