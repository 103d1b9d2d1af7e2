"""What a rung of the ladder is: more to estimate cameras from, at a price."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.geometry import align_cameras, angles_deg
from splatnode.recon.matching.view_graph import Matcher, Pair, ViewGraph, match_weak_pair
from splatnode.recon.result.verdict import Code


@dataclass(frozen=True, eq=False)
class FallbackState:
    """The view graph and configuration that cameras are estimated from, with the work spent so far."""

    graph: ViewGraph
    config: ReconstructionConfig
    work: float = 0.0  # that went into them, as `config.fallbacks.budget` counts it

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


# Which of two estimates of the same keyframes is better: an accepted answer is extended, never replaced.

MAX_TURN_DEG = 2.0  # of an accepted camera from one estimate to the other, after the best similarity


def choose_better_reconstruction(one: Reconstruction, other: Reconstruction) -> Reconstruction:
    """`other` where it is publishable and has the cameras of `one`, where they were, and more; else `one`.

    A rough answer that weak matches lead to is not taken: they may join two places, and rough bounds would hide it.
    Of two refusals `one` stands: it says what is wrong with the photographs, `other` with what was made of them.
    """
    if (
        not other.publishable
        or other.verdict.code is Code.OK_ROUGH
        or not one.publishable_camera_names < other.publishable_camera_names
    ):
        return one
    return other if _compute_turn_deg(one, other) <= MAX_TURN_DEG else one


def _compute_turn_deg(one: Reconstruction, other: Reconstruction) -> float:
    """The largest angle between the cameras that `one` has placed and the same ones in `other`; 0 without any."""
    if not one.publishable_camera_names:
        return 0.0
    source, target = _collect_poses(one), _collect_poses(other)
    Ts, others = (
        np.stack([cameras[name] for name in sorted(one.publishable_camera_names)]) for cameras in (source, target)
    )
    return float(angles_deg(align_cameras(Ts, others).rotation @ Ts[:, :3, :3], others[:, :3, :3]).max())


def _collect_poses(estimate: Reconstruction) -> dict[str, npt.NDArray[np.float64]]:
    """T_world_camera by the keyframe's name."""
    if estimate.registration is None:
        return {}
    return {estimate.graph.names[camera.index]: camera.T_world_camera for camera in estimate.registration.cameras}
