"""What was found in a scene, kept for its further windows: of one photograph or of two, whatever others there are."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec

from splatnode.recon.frames.keyframe import PLAIN, Features, Keyframe
from splatnode.recon.matching.config import MatchingConfig
from splatnode.recon.matching.match import Matcher, match_pending
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import Pair, ViewGraph

Key = tuple[str, ...]  # what was found; then the name of the photograph, or the names of both
Pieces = Mapping[Key, bytes]  # each pickled: who keeps them need not know what they are

_PLAIN, _TILTED = "plain", "tilted"  # features of a photograph, or matches of two, in the order of content


def select_keys(keys: Collection[Key], names: Collection[str]) -> list[Key]:
    """Those of photographs that are all among `names`."""
    chosen = frozenset(names)
    return [key for key in keys if chosen.issuperset(key[1:])]


def load_plain_features(known: Pieces, name: str) -> Features | None:
    """Loads the plain features of an image; None where they are not known."""
    return _load_piece(known, (_PLAIN, name))


def match_keyframes(
    keyframes: Sequence[Keyframe], known: Pieces, config: MatchingConfig, matcher: Matcher | None
) -> tuple[ViewGraph, dict[Key, bytes]]:
    """The complete view graph of `keyframes`, which have plain features, and what was found for it and not known.

    The graph is to the bit that which matching from scratch gives: which pairs tilted features are chosen for is asked
    anew. Where not all pairs are matched, which are depends on what was matched before: of pairs nothing is used then.
    """
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.add_keyframe(keyframe)
    found: dict[Key, object] = {(_PLAIN, keyframe.name): keyframe.features for keyframe in keyframes}
    if len(keyframes) > config.candidates.exhaustive:
        graph = _take_last(match_pending(graph, matcher))
    else:
        graph = _match_plain_features(_restore_plain_matches(graph, known))
        found |= {(_PLAIN, *_list_names(graph, pair)): each for pair, each in graph.plain.items()}
        graph = _take_last(match_pending(graph if matcher else _restore_tilted_matches(graph, known), matcher))
        graph = replace(graph, tilted=_sort_pairs(graph.tilted))
    if matcher is None:  # else the features of its points are among them
        found |= {
            (_TILTED, each.name): each.features for each in graph.keyframes if (each.features.tilt != PLAIN).any()
        }
        found |= {(_TILTED, *_list_names(graph, pair)): each for pair, each in graph.tilted.items()}
    return graph, {key: pickle.dumps(piece) for key, piece in found.items() if key not in known}


def _match_plain_features(graph: ViewGraph) -> ViewGraph:
    """Matches all pairs by plain features alone, in the order of matching from scratch."""
    config = graph.config
    untilted = msgspec.structs.replace(config, tilting=msgspec.structs.replace(config.tilting, tilts=()))
    whole = _take_last(match_pending(replace(graph, config=untilted), None))
    return replace(whole, config=config, plain=_sort_pairs(whole.plain))


def _restore_plain_matches(graph: ViewGraph, known: Pieces) -> ViewGraph:
    """Restores the pairs that are known to be matched by plain features."""
    plain: dict[Pair, MatchedPair] = {}
    pairs: dict[Pair, TwoView] = {}
    done: set[Pair] = set()
    for pair in graph.pending:
        first, second = graph.sort_by_content(*pair)
        found = _load_piece(known, (_PLAIN, *_list_names(graph, (first, second))))
        if found is None:
            continue
        done.add(pair)
        plain[first, second] = found
        if found.geometry is not None:
            pairs[pair] = found.geometry if first < second else found.geometry.swapped()
    return replace(graph, pairs=pairs, plain=plain, pending=graph.pending - done)


def _restore_tilted_matches(graph: ViewGraph, known: Pieces) -> ViewGraph:
    """Restores the weak pairs that are known to be matched by tilted features, and these features."""
    keyframes, tilted = list(graph.keyframes), dict(graph.tilted)
    for pair in sorted(graph.select_weak_pairs()):
        found = _load_piece(known, (_TILTED, *_list_names(graph, pair)))
        if found is None:
            continue
        tilted[pair] = found
        for index in pair:
            features = _load_piece(known, (_TILTED, keyframes[index].name))
            keyframes[index] = replace(keyframes[index], features=features)
    return replace(graph, keyframes=tuple(keyframes), tilted=tilted)


def _sort_pairs(pairs: Mapping[Pair, MatchedPair]) -> dict[Pair, MatchedPair]:
    """Sorts the pairs in the order of matching from scratch."""
    return dict(sorted(pairs.items(), key=lambda item: sorted(item[0])))


def _list_names(graph: ViewGraph, pair: Pair) -> tuple[str, str]:
    return graph.keyframes[pair[0]].name, graph.keyframes[pair[1]].name


def _load_piece(known: Pieces, key: Key) -> Any:
    """None where it is not known."""
    return pickle.loads(known[key]) if key in known else None


def _take_last(graphs: Iterable[ViewGraph]) -> ViewGraph:
    (last,) = deque(graphs, maxlen=1)
    return last
