"""The view graph: the keyframes so far, and what each verified pair of them says."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

from recon.keyframe import Keyframe
from recon.registration import features, register
from recon.registration.two_view import TwoView


class ViewGraph:
    """Grows by one keyframe at a time; each new one is compared with all before it."""

    def __init__(self, config: register.Config) -> None:
        self._config = config
        self.keyframes: list[Keyframe] = []
        self.pairs: dict[tuple[int, int], TwoView] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Takes in `keyframe` and verifies it against every other keyframe.

        Where two frames share little and one of them has few firm partners, they are compared again with squeezed
        features, which find each other from further to the side and cost as much again.
        """
        new = len(self.keyframes)
        self.keyframes.append(keyframe)
        for index in range(new):
            self._compare(index, new)
        for index in range(new) if self._config.squeezes else ():
            needed = min(self._num_firm(index), self._num_firm(new)) < self._config.enough_firm_pairs
            if needed and not self._is_firm(index, new):
                self._squeeze(index)
                self._squeeze(new)
                self._compare(index, new)

    def _compare(self, first: int, second: int) -> None:
        pair = register.compare(self.keyframes[first], self.keyframes[second], self._config)
        if pair is not None:
            self.pairs[first, second] = pair

    def _is_firm(self, first: int, second: int) -> bool:
        pair = self.pairs.get((first, second))
        return pair is not None and len(pair.matches) >= self._config.firm_matches

    def _num_firm(self, index: int) -> int:
        return sum(self._is_firm(*pair) for pair in self.pairs if index in pair)

    def _squeeze(self, index: int) -> None:
        keyframe = self.keyframes[index]
        widened = features.add_squeezed(
            keyframe.features, keyframe.frame.image, self._config.squeezes, self._config.features
        )
        self.keyframes[index] = replace(keyframe, features=widened)

    def without(self, names: Collection[str]) -> ViewGraph:
        """A view graph of the other keyframes, with what their pairs say."""
        kept = [index for index, keyframe in enumerate(self.keyframes) if keyframe.name not in names]
        rest = ViewGraph(self._config)
        rest.keyframes = [self.keyframes[index] for index in kept]
        place = {index: position for position, index in enumerate(kept)}
        rest.pairs = {(place[i], place[j]): pair for (i, j), pair in self.pairs.items() if i in place and j in place}
        return rest

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
