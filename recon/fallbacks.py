"""Fallbacks: what costs more is tried before photographs are refused for want of matches.

While the estimate lacks cameras for some keyframes, and the budget lasts, a fallback extends the view graph, and
cameras are estimated again. An answer is never made worse: the better one is kept. How much is tried depends on the
photographs alone: the cost is counted by what is done, and no clock decides unless somebody asked for a deadline. One
fallback simulates tilts in both directions, and stronger ones, as affine SIFT has them (Morel and Yu, 2009); another
matches by networks that were trained on wide baselines (XFeat, LighterGlue), where their weights are.

Where a refusal is about a few photographs, the rest is judged by itself. A photograph that shows little of what the
others show, or only something that may have been moved, says nothing against these. They are judged as if it had never
been taken. Where photographs show too little and depth images came with them, these place the cameras.
"""

from __future__ import annotations

import hashlib
import importlib.util
import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from splatnode.recon import networks
from splatnode.recon.config import PriorChoice, ReconstructionConfig
from splatnode.recon.estimation import (
    Reconstruction,
    add_cameras_by_depth,
    estimate_cameras,
    estimate_cameras_by_depth,
)
from splatnode.recon.geometry import align_cameras, angles_deg
from splatnode.recon.keyframes import PLAIN, Rejected
from splatnode.recon.matching.features import count_search_pixels
from splatnode.recon.matching.view_graph import Matcher, Pair, ViewGraph, match_weak_pair
from splatnode.recon.networks import Weights, depth_anything, find_mismatch, locate_weights
from splatnode.recon.optimize.losses import semantic
from splatnode.recon.priors import xfeat
from splatnode.recon.registration.known_poses import has_calibrated_lens
from splatnode.recon.registration.posed_mapping import find_telling_pairs
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import BACKGROUND, RunContext

# The learned parts: what each is for, and whether it can be used here: its package, its weights and their licence.
#
# A prior's module says by itself what it takes: `WEIGHTS` are its files' paths in the catalogue of weights, `PACKAGE`
# is the import name of what it needs beside torch. A prior without `WEIGHTS` is not learned.


@dataclass(frozen=True)
class LearnedPart:
    """Something that can only be used with weights from elsewhere."""

    name: str
    purpose: str
    weights: tuple[str, ...]  # paths in the catalogue
    package: str | None = None  # import name of what it needs beside torch

    @property
    def licence(self) -> str:
        """Returns the licence of the weights; empty where the catalogue does not have them."""
        known = _catalogue()
        return "; ".join(dict.fromkeys(known[path].licence for path in self.weights if path in known))


OTHERS = (
    LearnedPart("mono depth", "depth and normal losses", (depth_anything.RELATIVE,)),
    LearnedPart("dinov2", "semantic loss", (semantic.WEIGHTS,)),
    LearnedPart("metric", "metres indoors", (depth_anything.METRIC,)),
)


def list_learned_parts() -> tuple[LearnedPart, ...]:
    """The priors that have weights, in recon/priors or beside it, and the networks of other rooms."""
    return (*_priors(), *OTHERS)


def find_unavailable_reason(part: LearnedPart) -> str:
    """Returns why `part` is unavailable, and the remedy; empty if it is available, as far as digests tell."""
    if part.package is not None and not importlib.util.find_spec(part.package):
        return f"pip install {part.package}"
    known = _catalogue()
    for path in part.weights:
        if path not in known:
            return f"{path} is not in the catalogue of weights: recon/networks/__init__.py needs its entry"
        entry, file = known[path], locate_weights(path)
        if file is None:
            return f"no weights: splatnode weights fetch {entry.name}" if entry.url else f"no weights: see {entry.name}"
        if wrong := find_mismatch(entry, file):
            return f"{file}: {wrong}; splatnode weights fetch {entry.name}"
    return ""


def _priors() -> list[LearnedPart]:
    modules = {kind: PriorChoice.load_module(kind) for kind in PriorChoice.kinds()}
    return [
        LearnedPart(kind, "prior", module.WEIGHTS, getattr(module, "PACKAGE", None))
        for kind, module in modules.items()
        if hasattr(module, "WEIGHTS")
    ]


def _catalogue() -> dict[str, Weights]:
    """The catalogue's entries by their paths."""
    return {entry.path: entry for entry in networks.CATALOGUE}


# Fallbacks: what costs more is tried before photographs are refused for want of matches.


@dataclass(frozen=True, eq=False)
class FallbackState:
    """The view graph and configuration that cameras are estimated from, with the cost so far."""

    graph: ViewGraph
    config: ReconstructionConfig
    cost: float = 0.0  # of what was tried, as `config.fallbacks.budget` counts it

    def add_cost(self, cost: float) -> FallbackState:
        """Returns the same state at a further cost."""
        return replace(self, cost=self.cost + cost)


# The state after each further pair, given the one so far and the names of the doubtful keyframes; none where this
# fallback has nothing to add.
GraphExtension = Callable[[FallbackState, Collection[str]], Iterator[FallbackState]]
# What it costs to match a pair of the view graph further, by what there is to do: never by a clock.
PairCost = Callable[[ViewGraph, Pair], float]


@dataclass(frozen=True)
class Fallback:
    """One thing to try."""

    name: str  # as the verdict says what was tried
    extend: GraphExtension
    unavailable_reason: Callable[[], str] = lambda: ""  # empty: it is available


def match_weak_pairs(
    state: FallbackState,
    doubtful: Collection[str],
    estimate_cost: PairCost,
    tilts: tuple[float, ...] = (),
    matcher: Matcher | None = None,
) -> Iterator[FallbackState]:
    """After each weak pair of a doubtful keyframe has got further matches, the most promising pairs first."""
    for pair in find_weak_pairs(state.graph, doubtful):
        cost = estimate_cost(state.graph, pair)
        graph = match_weak_pair(state.graph, pair, tilts, matcher).select_geometries()
        state = replace(state, graph=graph).add_cost(cost)
        yield state


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


# Of the width, and below 1 of the height. The first matching has 1.6 of the width.
_TILTS = (1.0 / 1.6, 2.5)
_COST_OF_PIXEL = 2.3e-7  # finding features of both tilts, for each pixel that plain ones are looked for in
_COST_OF_COMPARISON = 2.8e-9  # for each two plain features: about 2.8 times as many of other tilts are compared


def _match_affine(state: FallbackState, doubtful: Collection[str]) -> Iterator[FallbackState]:
    return match_weak_pairs(state, doubtful, _estimate_cost, _TILTS)


def _estimate_cost(graph: ViewGraph, pair: Pair) -> float:
    """Estimates what it costs to simulate tilts of the pair's images, and to compare their features."""
    both = [graph.keyframes[index] for index in pair]
    untilted = [each for each in both if not np.isin(_TILTS, each.features.tilt).all()]
    searched = sum(count_search_pixels(each.frame.image, graph.config.features) for each in untilted)
    compared = np.prod([(each.features.tilt == PLAIN).sum() for each in both], dtype=float)
    return _COST_OF_PIXEL * searched + _COST_OF_COMPARISON * float(compared)


AFFINE_SIMULATION = Fallback("stronger tilts", _match_affine)


# With its share of finding the photographs' points: the networks take pictures of one size only
LEARNED_PAIR_COST = 0.48
_PART = LearnedPart("xfeat", "matches of wide baselines", xfeat.WEIGHTS, xfeat.PACKAGE)


def _match_learned(state: FallbackState, doubtful: Collection[str]) -> Iterator[FallbackState]:
    if state.config.prior.kind != "classical":  # another prior has been asked for matches
        return iter(())
    return match_weak_pairs(
        state, doubtful, lambda graph, pair: LEARNED_PAIR_COST, matcher=xfeat.load(xfeat.Config()).matcher
    )


LEARNED_MATCHES = Fallback("learned matches", _match_learned, partial(find_unavailable_reason, _PART))


MIN_REMAINING = 3  # photographs with cameras: of fewer, nothing tells whether one of them is wrong


def estimate_without_doubtful(
    estimate: Reconstruction, rejected: Sequence[Rejected], config: ReconstructionConfig, run: RunContext
) -> Reconstruction:
    """The estimate of the others, where they are most photographs, and are published exactly; else `estimate`.

    The photographs that are left out stay in its view graph, without pairs.
    """
    other, left_out = estimate, frozenset[str]()
    while not other.verdict.publishable:
        doubtful = frozenset(other.verdict.frames) - left_out
        left_out |= doubtful
        few = 2 * len(left_out) < len(estimate.graph.keyframes)
        if not doubtful or not few or len(other.camera_names - left_out) < MIN_REMAINING:
            return estimate
        other = estimate_cameras(estimate.graph.forget_pairs(left_out), rejected, config, run)
    if other is estimate or other.verdict.code is Code.OK_ROUGH:
        return estimate
    return _explain_left_out(other, estimate, left_out)


def _explain_left_out(other: Reconstruction, refused: Reconstruction, left_out: frozenset[str]) -> Reconstruction:
    """Explains in the verdict why the other images were left out."""
    found, count = len(other.publishable_camera_names), len(other.graph.keyframes)
    names = ", ".join(name for name in other.graph.names if name in left_out)
    gone = f"{names} {'was' if len(left_out) == 1 else 'were'} left out"
    message = f"{found} of {count} photographs were placed, after {gone}: {refused.verdict.message}"
    verdict = replace(other.verdict, code=Code.OK_PARTIAL, message=message, advice=refused.verdict.advice)
    return replace(other, verdict=verdict)


log = logging.getLogger(__name__)

FALLBACKS = (LEARNED_MATCHES, AFFINE_SIMULATION)  # what wins most for its work comes first
CAMERA_COST = 0.2  # of estimating the cameras again, for each keyframe
LACKING_MATCHES = (Code.NO_OVERLAP, Code.SPLIT, Code.OK_PARTIAL, Code.AMBIGUOUS)
# What is too little to be seen by photographs may be enough to be measured by a depth camera
NEEDING_DEPTH = (
    *(Code.NO_OVERLAP, Code.SPLIT, Code.AMBIGUOUS, Code.LOW_TEXTURE, Code.NO_PARALLAX, Code.PLANAR_ONLY),
    *(Code.BASELINE_TOO_SMALL, Code.UNDETERMINED),
)
LENS_FOR_DEPTH = "Give the lens (--intrinsics FILE; Python: intrinsics=): with it depth images can place the cameras."
# Of the others, what more cameras may mend, where some keyframes have none: few leave much open.
UNCERTAIN = (Code.OK_ROUGH, Code.TOO_ROUGH, Code.FOCAL_SUSPECT, Code.PLANAR_ONLY, Code.BASELINE_TOO_SMALL)


def run_fallbacks(
    estimate: Reconstruction,
    rejected: Sequence[Rejected],
    config: ReconstructionConfig,
    run: RunContext = BACKGROUND,
    fallbacks: Sequence[Fallback] = FALLBACKS,
) -> Reconstruction:
    """Returns the best of `estimate` and what the `fallbacks` lead to; a refusal then says what was tried.

    With `config.no_fallbacks` it is `estimate`. `config.fallbacks` bounds the cost: it is compared with the budget
    between pairs and before each fallback, as is the deadline. A pair and an estimate that have begun are finished.
    Where that does not help, doubtful photographs are left out.
    """
    if config.no_fallbacks:
        return estimate
    if _lacks_matches(estimate):
        estimate = _try_fallbacks(estimate, rejected, config, run, fallbacks)
    if run.is_over:
        return estimate
    estimate = estimate_without_doubtful(estimate, rejected, config, run)
    if not _needs_depth(estimate):
        return _extend_by_depth(estimate, config, run)
    by_depth = estimate_cameras_by_depth(estimate.graph, config, run)
    if by_depth is None or not by_depth.publishable:
        return _advise_lens(estimate)
    log.info("depth images place %d cameras", len(by_depth.camera_names))
    return by_depth


def _extend_by_depth(estimate: Reconstruction, config: ReconstructionConfig, run: RunContext) -> Reconstruction:
    """The estimate with cameras that depth images place beside its own; as it is where these would move or be rough."""
    if not estimate.publishable or not find_unplaced_keyframes(estimate):
        return estimate
    extended = add_cameras_by_depth(estimate, config, run)
    if extended is None or not estimate.camera_names < extended.camera_names:
        return estimate
    is_blurred = extended.verdict.code is Code.OK_ROUGH and estimate.verdict.code is not Code.OK_ROUGH
    if not extended.publishable or is_blurred or _compute_turn_deg(estimate, extended) > MAX_TURN_DEG:
        return estimate
    log.info("depth images place %d further cameras", len(extended.camera_names - estimate.camera_names))
    return extended


def make_fallback_key(graph: ViewGraph, config: ReconstructionConfig, fallbacks: Sequence[Fallback] = FALLBACKS) -> str:
    """Identifies what fallbacks start from: the keyframes, their matches, the budget, and which ones are available.

    Fallbacks that gained nothing gain nothing from an equal start. The key is the same in another process.
    """
    digest, names = hashlib.blake2b(digest_size=16), graph.names
    available = [f"{each.name}: {each.unavailable_reason()}" for each in fallbacks]
    for text in (repr(config.fallbacks), *available, *sorted(names)):
        digest.update(f"{text}\0".encode(errors="surrogateescape"))
    by_name = {tuple(sorted((names[i], names[j]))): pair for (i, j), pair in graph.pairs.items()}
    for pair in sorted(by_name):
        found = by_name[pair]
        matched = f"{len(found.matches)}, {found.num_candidates}, {found.log10_nfa!r}"
        digest.update("\0".join((*pair, matched, "")).encode(errors="surrogateescape"))
    return digest.hexdigest()


def _try_fallbacks(
    estimate: Reconstruction,
    rejected: Sequence[Rejected],
    config: ReconstructionConfig,
    run: RunContext,
    fallbacks: Sequence[Fallback],
) -> Reconstruction:
    state, most_s = FallbackState(estimate.graph, config), config.fallbacks.timeout_s
    run = run if most_s is None else run.advance_deadline(time.monotonic() + most_s)
    tried: list[str] = []
    not_tried: list[str] = []
    for fallback in fallbacks:
        doubtful = find_doubtful_keyframes(estimate)
        if not doubtful or _is_exhausted(state, run):
            break
        reason = fallback.unavailable_reason()
        if reason:
            not_tried.append(f"{fallback.name} ({reason})")
            continue
        before = state
        state = _run_fallback(fallback.extend(before, doubtful), before, run)
        if state is before:
            continue
        other = estimate_cameras(state.graph, rejected, state.config, run)
        state = state.add_cost(CAMERA_COST * len(state.graph.keyframes))
        estimate = choose_better_reconstruction(estimate, other)
        gained = "more photographs found their place" if estimate is other else "nothing gained"
        log.info("looked for more matches: %s: %s at a cost of %.1f", fallback.name, gained, state.cost - before.cost)
        tried.append(fallback.name)
    return _append_tried(estimate, {"Also tried": tried, "Not tried": not_tried})


def _needs_depth(estimate: Reconstruction) -> bool:
    """Whether photographs show too little, where few matches at most speak against a lens."""
    code = estimate.verdict.code
    return code in NEEDING_DEPTH or (code is Code.FOCAL_SUSPECT and not find_telling_pairs(estimate.graph.pairs))


def _advise_lens(estimate: Reconstruction) -> Reconstruction:
    """Appends to the advice that depth images could place the cameras, where they came without a lens that was told."""
    frames = [keyframe.frame for keyframe in estimate.graph.keyframes if keyframe.frame.depth is not None]
    if len(frames) < 2 or any(map(has_calibrated_lens, frames)):
        return estimate
    advice = f"{estimate.verdict.advice} {LENS_FOR_DEPTH}".strip()
    return replace(estimate, verdict=replace(estimate.verdict, advice=advice))


def _lacks_matches(estimate: Reconstruction) -> bool:
    code = estimate.verdict.code
    return code in LACKING_MATCHES or (code in UNCERTAIN and bool(find_unplaced_keyframes(estimate)))


def _run_fallback(steps: Iterator[FallbackState], state: FallbackState, run: RunContext) -> FallbackState:
    """Returns the state after the last pair that begins within the budget and before the deadline."""
    for further in steps:
        state = further
        run.pause()
        if _is_exhausted(state, run):
            break
    return state


def _is_exhausted(state: FallbackState, run: RunContext) -> bool:
    """Whether nothing further begins: the budget is spent, or the deadline has passed."""
    return state.cost >= state.config.fallbacks.budget or run.is_over


def find_doubtful_keyframes(estimate: Reconstruction) -> frozenset[str]:
    """The names of those without a camera, and of those that the verdict is about; none where all are published."""
    without = find_unplaced_keyframes(estimate)
    return without if estimate.verdict.publishable else without.union(estimate.verdict.frames)


def find_unplaced_keyframes(estimate: Reconstruction) -> frozenset[str]:
    """The names of the keyframes that have no camera."""
    return frozenset(estimate.graph.names) - estimate.camera_names


def _append_tried(estimate: Reconstruction, tried: Mapping[str, Sequence[str]]) -> Reconstruction:
    """Appends the fallbacks to the verdict's message, unless nothing is left to explain."""
    if not find_doubtful_keyframes(estimate):
        return estimate
    sentences = [f"{what}: {', '.join(names)}." for what, names in tried.items() if names]
    message = " ".join([estimate.verdict.message, *sentences])
    return replace(estimate, verdict=replace(estimate.verdict, message=message)) if sentences else estimate
