"""The view graph: the keyframes so far, and what each verified pair of them says."""

from __future__ import annotations

from recon.keyframe import Keyframe
from recon.registration import register
from recon.registration.two_view import TwoView


class ViewGraph:
    """Grows by one keyframe at a time; each new one is compared with all before it."""

    def __init__(self, config: register.Config) -> None:
        self._config = config
        self.keyframes: list[Keyframe] = []
        self.pairs: dict[tuple[int, int], TwoView] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Takes in `keyframe` and verifies it against every other keyframe."""
        new = len(self.keyframes)
        for index, other in enumerate(self.keyframes):
            pair = register.compare(other, keyframe, self._config)
            if pair is not None:
                self.pairs[index, new] = pair
        self.keyframes.append(keyframe)

    def components(self) -> list[list[int]]:
        """Sets of keyframes that verified pairs connect, the largest first."""
        label = list(range(len(self.keyframes)))
        for i, j in self.pairs:
            old, new = max(label[i], label[j]), min(label[i], label[j])
            label = [new if value == old else value for value in label]
        groups = [[i for i, value in enumerate(label) if value == name] for name in sorted(set(label))]
        return sorted(groups, key=lambda group: (-len(group), group))
