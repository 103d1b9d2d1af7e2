"""What a rung of the ladder is: more to estimate cameras from, at a price."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.matching.match import Matcher, match_weak_pair
from splatnode.recon.matching.view_graph import Pair, ViewGraph


@dataclass(frozen=True, eq=False)
class FallbackState:
    """The view graph and configuration that cameras are estimated from, with the work spent so far."""

    graph: ViewGraph
    config: ReconstructionConfig
    work: float = 0.0  # that went into them, as `config.ladder.work` counts it

    def add_work(self, work: float) -> FallbackState:
        """The same, after so much further work."""
        return replace(self, work=self.work + work)


# The means after each further piece of work, given those so far and the names of the keyframes in doubt; none
# where this rung has nothing to add.
Climb = Callable[[FallbackState, Collection[str]], Iterator[FallbackState]]
# The work of matching a pair of the view graph further, by what there is to do: never by a clock.
Work = Callable[[ViewGraph, Pair], float]


@dataclass(frozen=True)
class Fallback:
    """One thing to try."""

    name: str  # as the verdict says what was tried
    climb: Climb
    obstacle: Callable[[], str] = lambda: ""  # what keeps this rung from being tried, in a word; empty: nothing does


def match_weak_pairs(
    means: FallbackState,
    doubtful: Collection[str],
    work: Work,
    tilts: tuple[float, ...] = (),
    matcher: Matcher | None = None,
) -> Iterator[FallbackState]:
    """After each weak pair of a doubtful keyframe has got further matches, the most promising pairs first."""
    for pair in find_weak_pairs(means.graph, doubtful):
        cost = work(means.graph, pair)
        means = replace(means, graph=match_weak_pair(means.graph, pair, tilts, matcher).select_geometries()).add_work(
            cost
        )
        yield means


def find_weak_pairs(graph: ViewGraph, doubtful: Collection[str]) -> list[Pair]:
    """The pairs of these keyframes that are not firm and may overlap, those first whose matches agree best."""
    names = graph.names
    weak = [pair for pair in graph.select_weak_pairs() if names[pair[0]] in doubtful or names[pair[1]] in doubtful]
    return sorted(weak, key=lambda pair: (graph.tilted.get(pair, graph.plain[pair]).log10_nfa, pair))
