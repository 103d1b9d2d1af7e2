"""The view graph: the keyframes so far, and what each verified pair of them says."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, content_key
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.config import Config
from splatnode.recon.matching.pair_matching import Compared
from splatnode.recon.matching.two_view import TwoView

T = TypeVar("T")


class Matcher(Protocol):
    """Finds matches that the plain features do not, as a prior may."""

    def with_points(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with the points that `match` needs beside those it has, which keep their numbers."""
        ...

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        """(M, 2) numbers of points that show the same, most distinct first. They are checked by their geometry."""
        ...


AT_FIRST = 4  # keyframes that a further one is compared with before it is used
CONNECTED = 2  # pairs, so that it can be


class ViewGraph:
    """Grows by one keyframe at a time. What its pairs say does not depend on the order in which keyframes came.

    Each keyframe is compared with all others by their plain features. Where two hardly match, one of them has few firm
    partners, and they may overlap all the same, they are compared again with squeezed features, which find each other
    from further to the side and cost twice as much again. They may overlap when something in their matches hints at it,
    when they have a firm partner in common, or when firm pairs do not connect them at all. What a prior's matcher finds
    there is added to them.

    A keyframe may be added `soon`: compared with a few others, and with the rest by `complete`.
    """

    def __init__(self, config: Config, matcher: Matcher | None = None) -> None:
        self._config, self._matcher = config, matcher
        self.keyframes: list[Keyframe] = []
        self.pairs: dict[tuple[int, int], TwoView] = {}  # verified, by position (i < j)
        self._plain: dict[tuple[int, int], Compared] = {}  # the first frame is the first in order of content
        self._squeezed: dict[tuple[int, int], Compared] = {}
        self.pending: set[tuple[int, int]] = set()  # that have not been compared (i < j)

    def add(self, keyframe: Keyframe, soon: bool = False) -> None:
        """Takes in `keyframe` and verifies it against every other keyframe.

        If this is to be `soon`, it is verified against a few at first, if these connect it, and without squeezed
        features: against the latest and then those that have most in common with what it has something in common with.
        """
        new = len(self.keyframes)
        self.keyframes.append(keyframe)
        self.pending |= {(index, new) for index in range(new)}
        if not soon:
            self.complete()
            return
        for _ in range(min(AT_FIRST, new)):
            self._compare(self._most_promising(new), new)
        if len(self._partners(new)) < CONNECTED:
            self.complete()

    def complete(self, pause: Callable[[], None] = lambda: None) -> None:
        """Makes all comparisons that have not been made. `pause` may raise: what was compared by then is kept."""
        for pair in sorted(self.pending):
            pause()
            self._compare(*pair)
        self._settle(pause)

    def _compare(self, index: int, new: int) -> None:
        """Compares two keyframes by their plain features, for now."""
        first, second = self._in_order(index, new)
        compared = pair_matching.compare(self.keyframes[first], self.keyframes[second], self._config)
        self._plain[first, second] = compared
        self.pending.discard((index, new))
        if compared.pair is not None:
            self.pairs[index, new] = compared.pair if first < second else compared.pair.swapped()

    def _most_promising(self, new: int) -> int:
        """Of the keyframes that `new` is not compared with, the one that shares most with its partners; the latest."""
        mine = self._partners(new)
        score = {
            index: sum(shared * mine.get(partner, 0) for partner, shared in self._partners(index).items())
            for index in range(new)
            if (index, new) in self.pending
        }
        return max(score, key=lambda index: (score[index], index))

    def _partners(self, index: int) -> dict[int, int]:
        """The keyframes that share something with keyframe `index`, and how many matches."""
        return {i + j - index: len(pair.matches) for (i, j), pair in self.pairs.items() if index in (i, j)}

    def without(self, names: Collection[str]) -> ViewGraph:
        """A view graph of the other keyframes, with what their pairs say."""
        kept = [index for index, keyframe in enumerate(self.keyframes) if keyframe.name not in names]
        place = {index: position for position, index in enumerate(kept)}

        def remaining(pairs: Mapping[tuple[int, int], T]) -> dict[tuple[int, int], T]:
            return {(place[i], place[j]): what for (i, j), what in pairs.items() if i in place and j in place}

        rest = ViewGraph(self._config, self._matcher)
        rest.keyframes = [self.keyframes[index] for index in kept]
        rest.pairs, rest._plain, rest._squeezed = (
            remaining(self.pairs),
            remaining(self._plain),
            remaining(self._squeezed),
        )
        rest.pending = set(remaining(dict.fromkeys(self.pending)))
        if not rest.pending:
            rest._settle()
        return rest

    def joined(self, other: ViewGraph) -> ViewGraph:
        """A view graph of the keyframes of both, as their frames came, with what either knows of their pairs."""
        both = ViewGraph(self._config, self._matcher)
        keyframes = {keyframe.name: keyframe for keyframe in (*other.keyframes, *self.keyframes)}
        both.keyframes = sorted(keyframes.values(), key=lambda keyframe: keyframe.frame.frame_id)
        place = {keyframe.name: index for index, keyframe in enumerate(both.keyframes)}
        both.pending = set(itertools.combinations(range(len(both.keyframes)), 2))
        for graph in (other, self):
            both._take_over(graph, [place[keyframe.name] for keyframe in graph.keyframes])
        return both

    def _take_over(self, graph: ViewGraph, number: Sequence[int]) -> None:
        """What `graph` knows, whose keyframe i is keyframe `number[i]` here."""
        for index, keyframe in zip(number, graph.keyframes, strict=True):
            if len(keyframe.features.points) > len(self.keyframes[index].features.points):  # squeezed ones, too
                self.keyframes[index] = keyframe
        for (i, j), pair in graph.pairs.items():
            first, second = number[i], number[j]
            self.pairs[min(first, second), max(first, second)] = pair if first < second else pair.swapped()
        self._plain |= {(number[i], number[j]): found for (i, j), found in graph._plain.items()}
        self._squeezed |= {(number[i], number[j]): found for (i, j), found in graph._squeezed.items()}
        for i, j in itertools.combinations(range(len(number)), 2):
            if (i, j) not in graph.pending:
                self.pending.discard((min(number[i], number[j]), max(number[i], number[j])))

    def _settle(self, pause: Callable[[], None] = lambda: None) -> None:
        """Chooses for each compared pair what its plain or its squeezed features say.

        Pairs that came from elsewhere, restored by a process that compared them, stay as they are.
        """
        wanted = self._wanted()
        for pair, plain in self._plain.items():
            if pair in wanted and pair not in self._squeezed:
                pause()
                self._squeezed[pair] = self._compare_squeezed(*pair)
            found = (self._squeezed[pair].pair if pair in wanted else None) or plain.pair
            first, second = pair
            self.pairs.pop((min(pair), max(pair)), None)
            if found is not None:
                self.pairs[min(pair), max(pair)] = found if first < second else found.swapped()

    def _wanted(self) -> set[tuple[int, int]]:
        """The pairs for which squeezed features are worth their time, by what the plain ones say of all pairs."""
        if not self._config.squeezes:
            return set()
        firm = {
            pair
            for pair, plain in self._plain.items()
            if plain.pair is not None and len(plain.pair.matches) >= self._config.firm_matches
        }
        everyone = range(len(self.keyframes))
        partners = [{i + j - index for i, j in firm if index in (i, j)} for index in everyone]
        group_of = {index: number for number, group in enumerate(connected(everyone, firm)) for index in group}

        def may_overlap(i: int, j: int) -> bool:
            hinted = self._plain[i, j].log10_nfa < self._config.hint_log10_nfa
            return hinted or group_of[i] != group_of[j] or not partners[i].isdisjoint(partners[j])

        return {
            (i, j)
            for i, j in self._plain
            if (i, j) not in firm
            and min(len(partners[i]), len(partners[j])) < self._config.enough_firm_pairs
            and may_overlap(i, j)
        }

    def _compare_squeezed(self, first: int, second: int) -> Compared:
        for index in (first, second):
            keyframe = self.keyframes[index]
            widened = features.add_squeezed(
                keyframe.features, keyframe.frame.image, self._config.squeezes, self._config.features
            )
            self.keyframes[index] = replace(keyframe, features=widened)
        keyframes = self.keyframes[first], self.keyframes[second]
        squeezed = pair_matching.compare_squeezed(*keyframes, self._plain[first, second], self._config)
        if self._matcher is None:
            return squeezed
        for index in (first, second):
            self.keyframes[index] = self._matcher.with_points(self.keyframes[index])
        keyframes = self.keyframes[first], self.keyframes[second]
        return pair_matching.compare_further(*keyframes, squeezed, self._matcher.match(*keyframes), self._config)

    def _in_order(self, *indices: int) -> tuple[int, ...]:
        """The keyframes' numbers in the order of their content."""
        return tuple(sorted(indices, key=lambda index: content_key(self.keyframes[index])))

    def components(self) -> list[list[int]]:
        """Sets of keyframes that verified pairs connect, the largest first."""
        return connected(range(len(self.keyframes)), self.pairs)


def connected(nodes: Iterable[int], pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """The sets of `nodes` that `pairs` of them connect, the largest first."""
    label = {node: node for node in nodes}
    for i, j in pairs:
        old, new = max(label[i], label[j]), min(label[i], label[j])
        label = {node: new if name == old else name for node, name in label.items()}
    groups = [[node for node, name in label.items() if name == group] for group in sorted(set(label.values()))]
    return sorted(groups, key=lambda group: (-len(group), group))
