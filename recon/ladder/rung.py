"""What a rung of the ladder is: more to estimate cameras from, at a price."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

from splatnode.recon.config import Config
from splatnode.recon.matching.match import Matcher, matched_further
from splatnode.recon.matching.view_graph import Pair, ViewGraph


@dataclass(frozen=True, eq=False)
class Means:
    """What cameras are estimated from."""

    graph: ViewGraph
    config: Config
    work: float = 0.0  # that went into them, as `config.ladder.work` counts it

    def after(self, work: float) -> Means:
        """The same, after so much further work."""
        return replace(self, work=self.work + work)


# The means after each further piece of work, given those so far and the names of the keyframes in doubt; none
# where this rung has nothing to add.
Climb = Callable[[Means, Collection[str]], Iterator[Means]]
# The work of matching a pair of the view graph further, by what there is to do: never by a clock.
Work = Callable[[ViewGraph, Pair], float]


@dataclass(frozen=True)
class Rung:
    """One thing to try."""

    name: str  # as the verdict says what was tried
    climb: Climb
    obstacle: Callable[[], str] = lambda: ""  # what keeps this rung from being tried, in a word; empty: nothing does


def with_matches(
    means: Means, doubtful: Collection[str], work: Work, tilts: tuple[float, ...] = (), matcher: Matcher | None = None
) -> Iterator[Means]:
    """After each weak pair of a doubtful keyframe has got further matches, the most promising pairs first."""
    for pair in weak_pairs(means.graph, doubtful):
        cost = work(means.graph, pair)
        means = replace(means, graph=matched_further(means.graph, pair, tilts, matcher).chosen()).after(cost)
        yield means


def weak_pairs(graph: ViewGraph, doubtful: Collection[str]) -> list[Pair]:
    """The pairs of these keyframes that are not firm and may overlap, those first whose matches agree best."""
    names = graph.names
    weak = [pair for pair in graph.to_tilt() if names[pair[0]] in doubtful or names[pair[1]] in doubtful]
    return sorted(weak, key=lambda pair: (graph.tilted.get(pair, graph.plain[pair]).log10_nfa, pair))
