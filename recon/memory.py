"""Estimates that were made a moment ago: a keyframe may be tried and taken back, and nothing is estimated twice."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from splatnode.recon.estimation import Reconstruction

REMEMBERED = 8  # estimates: a keyframe that is tried with each of several others, and taken back
REMEMBERED_MASKED = 2  # estimates with things that move, whose photographs are copies without these
REMEMBERED_REFUSED = 100  # sets of keyframes of which nothing came: they need not be tried again

REMEMBERED_FRUITLESS = 200  # starts of fallbacks that gained nothing

Key = tuple[tuple[str, ...], int]  # the keyframes' names, and how many frames were rejected beside them


@dataclass(frozen=True, eq=False)
class ReconstructionCache:
    """The latest estimates, by the keyframes that they are about; what was asked for last comes last."""

    recent: tuple[tuple[Key, Reconstruction], ...] = ()
    refused: tuple[frozenset[str], ...] = ()  # sets of keyframes for which a thorough estimate forbade a scene
    proven: frozenset[str] = frozenset()  # keyframes of the last thorough estimate that was publishable
    # Starts of fallbacks that gained nothing (recon/fallbacks/run.py), and what the verdict then said of them
    fruitless: tuple[tuple[str, str], ...] = ()

    def find_reconstruction(self, key: Key) -> Reconstruction | None:
        """The estimate for just these keyframes, if it is remembered."""
        return dict(self.recent).get(key)

    def add_reconstruction(self, key: Key, estimate: Reconstruction) -> ReconstructionCache:
        """Returns the cache with this estimate as the latest one."""
        recent = [*((known, before) for known, before in self.recent if known != key), (key, estimate)][-REMEMBERED:]
        masked = [known for known, before in recent if any(keyframe.moving for keyframe in before.graph.keyframes)]
        gone = masked[:-REMEMBERED_MASKED]
        memory = replace(self, recent=tuple((known, before) for known, before in recent if known not in gone))
        if estimate.verdict.provisional:
            return memory
        names = frozenset(key[0])
        if estimate.verdict.publishable:
            return replace(memory, proven=names)
        refused = [known for known in self.refused if known != names]
        return replace(memory, refused=(*refused, names)[-REMEMBERED_REFUSED:])

    def add_fruitless_fallback(self, start: str, told: str) -> ReconstructionCache:
        """Adds a start from which fallbacks gained nothing; `told` is what the verdict says of them."""
        others = [each for each in self.fruitless if each[0] != start]
        return replace(self, fruitless=(*others, (start, told))[-REMEMBERED_FRUITLESS:])

    def find_fruitless_fallback(self, start: str) -> str | None:
        """Returns what the verdict said of fruitless fallbacks from this start; None without such."""
        return dict(self.fruitless).get(start)

    def is_rejected(self, names: Collection[str]) -> bool:
        """Whether a thorough estimate for these keyframes is known, and forbade a scene."""
        return frozenset(names) in self.refused

    def newest_publishable(self, among: Collection[str]) -> Reconstruction | None:
        """The latest estimate with cameras that may be published whose keyframes are all `among` these."""
        for (names, _), estimate in reversed(self.recent):
            if estimate.publishable and set(names) <= set(among):
                return estimate
        return None
