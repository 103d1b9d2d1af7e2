"""The view graph: keyframes as nodes, verified pairs of them as edges. A value: every change gives another graph.

Below it are the functions that match pending pairs, one at a time, and give the next graph.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.masks import apply_mask
from splatnode.capture.process.config import Internal
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import ProgressStep, Tell
from splatnode.recon.geometry import epipolar_errors
from splatnode.recon.keyframes import (
    LIBRARY_ERRORS,
    REFERENCE_SIDE,
    Keyframe,
    content_key,
    longer_side,
    principal_point,
    resize_image,
)
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching import pair_matching as candidates
from splatnode.recon.matching import pair_matching as matching_pair_matching
from splatnode.recon.matching.features import Code, compute_global_descriptor
from splatnode.recon.matching.pair_matching import (
    MatchedPair,
    TwoView,
    find_components,
    is_strong_pair,
    select_pairs_worth_matching,
    select_short_list_pairs,
    select_weak_pairs,
)
from splatnode.recon.threads import BACKGROUND, RunContext, map_parallel, map_parallel_lazily

# The configuration of matching: local features, which pairs are matched and how, which get simulated tilts.


class MovingObjectsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Detection of moving objects."""

    enabled: bool = True  # look for things that moved between photographs that are all at hand, and leave them out


class MatchingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of matching: local features, which pairs are matched and how, which get simulated tilts."""

    features: features.FeatureConfig = features.FeatureConfig()
    candidates: Internal[candidates.PairSelectionConfig] = candidates.PairSelectionConfig()
    pair_matching: Internal[matching_pair_matching.PairMatchingConfig] = matching_pair_matching.PairMatchingConfig()
    tilting: Internal[matching_pair_matching.AffineSimulationConfig] = matching_pair_matching.AffineSimulationConfig()
    dynamic_objects: MovingObjectsConfig = MovingObjectsConfig()


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

    def forget_lenses(self, names: Collection[str]) -> ViewGraph:
        """The same graph; nothing is told of the lenses of these keyframes."""
        keyframes = [
            replace(each, frame=replace(each.frame, intrinsics=None)) if each.name in names else each
            for each in self.keyframes
        ]
        return replace(self, keyframes=tuple(keyframes))

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
        """The pairs (i < j), matched or not, that are worth it (`pair_matching.select_pairs_worth_matching`)."""
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


# Matches the keyframes of a view graph: work that is abandoned loses the few pairs that are under way.

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
    run: RunContext = BACKGROUND,
) -> ViewGraph:
    """The complete view graph of the keyframes. The deadline counts as for `match_pending`; progress is told."""
    graph = ViewGraph(config)
    for keyframe in keyframes:
        graph = graph.add_keyframe(keyframe)
    for further in _report_progress(match_pending(graph, matcher, run), run.tell):
        graph = further
    return graph


def _report_progress(graphs: Iterable[ViewGraph], tell: Tell) -> Iterator[ViewGraph]:
    """The graphs of `match_pending`, each of which is told.

    What is still to match is asked once a round: it takes long.
    """
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


def match_pending(graph: ViewGraph, matcher: Matcher | None, run: RunContext = BACKGROUND) -> Iterator[ViewGraph]:
    """The graph after each pair that was pending and is worth matching; the last one is complete.

    Pairs are matched by plain features. Those that match weakly but may overlap (`select_weak_pairs` of
    pair_matching.py) are matched again with tilted features, which bridge wider baselines, and with what a prior's
    matcher proposes: but for those of which the turn comes after the deadline.
    """
    graph = yield from _glance_pairs(graph)
    while pairs := sorted(graph.select_pairs_to_match()):
        graph = yield from _match_all_plain(graph, pairs)
    to_tilt = graph.select_weak_pairs()
    weak = [pair for pair in graph.plain if pair in to_tilt and pair not in graph.tilted]
    for further in _match_weak_pairs(graph, weak, graph.config.tilting.tilts, matcher):
        if run.is_over:
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
        return matching_pair_matching.glance(first, second, config.candidates.glance_features, config.pair_matching)

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
        lambda pair: matching_pair_matching.match_plain(*_select_pair(keyframes, pair), config), ordered
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
        return matching_pair_matching.match_affine(*both, found, tilts, config.pair_matching) if tilts else found

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
    first = len(keyframe.features.points)
    return replace(keyframe, features=features.apply_mask(found, keyframe.frame.mask, first))


def _add_matcher_proposals(
    first: Keyframe, second: Keyframe, found: MatchedPair, matcher: Matcher, config: MatchingConfig
) -> MatchedPair:
    proposed = matcher.match(first, second)
    proposed = proposed[_is_unmasked(first, proposed[:, 0]) & _is_unmasked(second, proposed[:, 1])]
    return matching_pair_matching.add_proposed(first, second, found, proposed, config.pair_matching)


def _is_unmasked(keyframe: Keyframe, points: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(M,) which of the points with these numbers no mask hides."""
    if keyframe.frame.mask is None:
        return np.ones(len(points), bool)
    inside = features.well_inside(keyframe.frame.mask)
    x, y = np.clip(keyframe.features.points[points].astype(np.int64), 0, np.array(inside.shape)[::-1] - 1).T
    return inside[y, x]


# Things that moved between photographs, by their matches: a second motion beside that of the scene.
#
# What stands still agrees on one geometry for each two photographs. What moves by itself, a person or a vehicle,
# gives matches that agree with each other and not with it. Of two such motions the one on the smaller patch of both
# photographs is the thing's. Walls repeat, too: a point counts as moving where two pairs of photographs say so of it,
# and no two say that it stands still: a pattern that repeats stands still where photographs show the same part of the
# wall.


Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

MIN_MATCHES = 40  # of one thing in two photographs: a plane among fewer may be chance
MOST_COMMON = 0.3  # share of a thing's matches that may fit the scene's motion, too
SMALLER = 0.6  # the thing's patch over the scene's, in both photographs: beyond, nobody can tell which one moves
VOTES = 2  # pairs of photographs that find a point on a thing
RESTS = 2  # pairs of photographs in which a point stands still with the scene, so that it is of a wall that repeats
FEW = 0.3  # share of the points that fit a motion, beside which all others make it the scene's
MOST_AT_REST = 0.2  # share of a photograph's moving points: where more stand still, all of them do
MIN_SHOWN = 3  # photographs that a thing must be found in, if there are so many
ROUNDS = 3  # things of different motion that are looked for, one after the other
KNOWN_SHARE = 0.5  # of a patch's points that are known to move, for the others of it to move, too
SAME_LINE_PX = 3.0  # distance from an epipolar line within which a match fits, pixels at REFERENCE_SIDE

_MAP_SIDE = 256  # pixels: the longer side of the small picture in which points become patches
_REACH = 0.05  # between points of one patch, over the longer side
_MARGIN = 0.025  # around a patch: its outline has no points of its own
_MIN_POINTS = 8  # of a patch: fewer are wrong matches
MOST_HIDDEN = 0.6  # share of a photograph: what covers more is the scene


@dataclass(frozen=True, eq=False)
class _Group:
    """Matches of two photographs that agree on a motion other than the scene's, or may."""

    pair: Pair
    matches: Index  # (M, 2) point numbers
    moves: bool  # whether it is the smaller patch beyond doubt


def mask_moving_objects(graph: ViewGraph, matcher: Matcher | None, run: RunContext = BACKGROUND) -> ViewGraph:
    """The complete view graph without what moved between the photographs: matched again where there is such a thing.

    Such a keyframe has a mask over it, and its share in `moving`. The deadline counts as for
    `match_pending`; it pauses between parts of the work, which may raise.
    """
    run.pause()
    masks = moving_masks(graph)
    shown = [keyframe for keyframe in graph.keyframes if keyframe.name in masks]
    hidden = [_apply_moving_mask(keyframe, masks[keyframe.name]) for keyframe in shown]
    changed = [after for before, after in zip(shown, hidden, strict=True) if after is not before]
    run.pause()
    for further in match_pending(graph.replace_keyframes(changed), matcher, run) if changed else ():
        graph = further
        run.pause()
    return graph


def _apply_moving_mask(keyframe: Keyframe, mask: Mask) -> Keyframe:
    """The keyframe without what the mask (H, W) hides; itself where hardly anything would remain."""
    frame = apply_mask(keyframe.frame, mask)
    if isinstance(frame, DroppedFrame) or frame is keyframe.frame or frame.mask is None:
        return keyframe
    before = 1.0 if keyframe.frame.mask is None else float(keyframe.frame.mask.mean())
    return replace(
        keyframe,
        frame=frame,
        image=resize_image(frame.image, max(keyframe.image.shape[:2])),
        features=features.apply_mask(keyframe.features, frame.mask),
        moving=before - float(frame.mask.mean()),
    )


def moving_masks(graph: ViewGraph) -> dict[str, Mask]:
    """For each keyframe that shows a thing which moved: the mask (H, W) at full size, False on the thing."""
    if not graph.config.dynamic_objects.enabled:
        return {}
    moving = moving_points(graph)
    found = {}
    for keyframe, points in zip(graph.keyframes, moving, strict=True):
        hidden = _patches(keyframe, points)
        if 0 < hidden.sum() <= MOST_HIDDEN * hidden.size:
            found[keyframe.name] = ~hidden
    return found


def moving_points(graph: ViewGraph) -> list[Mask]:
    """(M,) for each keyframe which of its points lie on a thing that moved."""
    moving = [np.zeros(len(keyframe.features.points), bool) for keyframe in graph.keyframes]
    matches = {pair: graph.tilted.get(pair, plain).matches for pair, plain in sorted(graph.plain.items())}
    needed = min(VOTES, len(matches))
    for _ in range(ROUNDS):
        asked = [(graph, pair, found) for pair, found in matches.items()]
        groups = [group for found in map_parallel(lambda one: _find_groups(*one), asked) for group in found]
        votes = [np.zeros(len(points), int) for points in moving]
        for group in groups:
            if group.moves:
                for side, index in enumerate(group.pair):
                    votes[index][group.matches[:, side]] += 1
        new = _not_at_rest(_propagate_moving([own >= needed for own in votes], groups), graph)
        if sum(own.sum() >= _MIN_POINTS for own in new) < min(MIN_SHOWN, len(new)):
            break
        moving = [before | own for before, own in zip(moving, new, strict=True)]
        matches = {
            (i, j): found[~(moving[i][found[:, 0]] | moving[j][found[:, 1]])] for (i, j), found in matches.items()
        }
    return moving


def _find_groups(graph: ViewGraph, pair: Pair, matches: Index) -> list[_Group]:
    """Those of `_groups`; none, which the log tells, where a library fails on this pair."""
    try:
        return list(_groups(graph, pair, matches))
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        first, second = (graph.keyframes[index].name for index in pair)
        log.warning("%s and %s are not searched for what moves: %s", first, second, error)
        return []


def _groups(graph: ViewGraph, pair: Pair, matches: Index) -> Iterator[_Group]:
    """The plane that most matches agree on, or what else agrees, if one of the two may move beside the other."""
    first, second = (graph.keyframes[index] for index in pair)
    if len(matches) < 2 * MIN_MATCHES:
        return
    points1, points2 = first.features.points[matches[:, 0]], second.features.points[matches[:, 1]]
    config, scale = graph.config.pair_matching.two_view, longer_side(second.frame) / REFERENCE_SIDE
    plane_px = config.homography_px * scale
    plane = _plane(points1, points2, plane_px)
    if plane.sum() < MIN_MATCHES:
        return
    (others,) = np.nonzero(~plane)
    size = second.frame.width, second.frame.height
    own1, own2 = points1 - principal_point(first.frame), points2 - principal_point(second.frame)
    geometry, _ = pair_matching.estimate(own1[others], own2[others], matches[others], size, config)
    if geometry is None:
        yield _Group(pair, matches[plane], moves=False)
        return
    if _share_on_lines(geometry, own1[plane], own2[plane], SAME_LINE_PX * scale) > MOST_COMMON:
        return
    rest = np.isin(matches[:, 0], geometry.matches[:, 0]) & ~plane
    patches = np.array([[_patch(points1[own], first), _patch(points2[own], second)] for own in (plane, rest)])
    if (patches[0] < SMALLER * patches[1]).all():
        yield _Group(pair, matches[plane], moves=True)
    elif (patches[1] < SMALLER * patches[0]).all():
        thing = np.flatnonzero(rest)[_plane(points1[rest], points2[rest], plane_px)]
        if len(thing) >= MIN_MATCHES:
            yield _Group(pair, matches[thing], moves=True)
    else:
        yield _Group(pair, matches[plane], moves=False)


def _plane(points1: Array, points2: Array, threshold: float) -> Mask:
    """(M,) which matches the homography that explains most of them explains; none where they are too few for one."""
    if len(points1) < MIN_MATCHES:
        return np.zeros(len(points1), bool)
    _, inliers = cv2.findHomography(points1, points2, cv2.USAC_MAGSAC, threshold)
    return np.zeros(len(points1), bool) if inliers is None else inliers.ravel() > 0


def _share_on_lines(geometry: pair_matching.TwoView, points1: Array, points2: Array, threshold: float) -> float:
    """The share of matches, pixels (M, 2) from the principal points, within `threshold` of the geometry's lines."""
    fundamental, _ = cv2.findFundamentalMat(geometry.points1, geometry.points2, cv2.FM_LMEDS)
    if fundamental is None or fundamental.shape != (3, 3):
        return 1.0  # nothing is known of what the geometry explains
    errors = epipolar_errors(np.asarray(fundamental, np.float64), points1, points2)
    return float((np.abs(errors) < threshold).mean())


def _patch(points: Array, keyframe: Keyframe) -> float:
    """The share of the photograph in the convex hull of `points` (M, 2)."""
    hull = cv2.convexHull(points.astype(np.float32))
    return cv2.contourArea(hull) / (keyframe.frame.width * keyframe.frame.height)


def _propagate_moving(moving: Sequence[Mask], groups: Sequence[_Group]) -> list[Mask]:
    """Adds the points of every group that one image knows to move, until nothing is added."""
    moving = [own.copy() for own in moving]
    waiting = list(groups)
    while True:
        known = [
            group
            for group in waiting
            if any(moving[i][group.matches[:, side]].mean() >= KNOWN_SHARE for side, i in enumerate(group.pair))
        ]
        if not known:
            return moving
        for group in known:
            for side, index in enumerate(group.pair):
                moving[index][group.matches[:, side]] = True
        waiting = [group for group in waiting if group not in known]


def _not_at_rest(moving: Sequence[Mask], graph: ViewGraph) -> list[Mask]:
    """Without those of photographs in which they fit, in RESTS pairs each, the motion of many more points."""
    rests = [np.zeros(len(own), int) for own in moving]
    for pair, geometry in graph.pairs.items():
        for side, index in enumerate(pair):
            still = np.zeros(len(moving[index]), bool)
            still[geometry.matches[:, side]] = True
            own = still & moving[index]
            if 0 < own.sum() < FEW * still.sum():
                rests[index] += own
    at_rest = [(known[own] >= RESTS).mean() if own.any() else 1.0 for own, known in zip(moving, rests, strict=True)]
    return [own if share < MOST_AT_REST else np.zeros_like(own) for own, share in zip(moving, at_rest, strict=True)]


def _patches(keyframe: Keyframe, moving: Mask) -> Mask:
    """(H, W) at full size: the hull of each cluster of the moving points, and a margin around it."""
    height, width = keyframe.frame.image.shape[:2]
    scale = min(1.0, _MAP_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    points = keyframe.features.points[moving] * np.array(size) / (width, height)
    columns, rows = np.clip(points.astype(int), 0, np.array(size) - 1).T
    dots = np.zeros(size[::-1], np.uint8)
    dots[rows, columns] = 1
    _, labels = cv2.connectedComponents(cv2.dilate(dots, _disc(_REACH / 2 * max(size))))
    cluster = labels[rows, columns]
    result = np.zeros(size[::-1], np.uint8)
    for label in np.unique(cluster):
        if (own := cluster == label).sum() >= _MIN_POINTS:
            hull = cv2.convexHull(np.column_stack([columns[own], rows[own]]).astype(np.int32))
            cv2.fillConvexPoly(result, hull, (1,))
    result = cv2.dilate(result, _disc(_MARGIN * max(size)))
    return cv2.resize(result, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _disc(radius: float) -> npt.NDArray[np.uint8]:
    side = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
