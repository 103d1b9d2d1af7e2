"""The ladder before the no: what costs more is tried before photographs are refused for want of matches.

The first estimate is the first rung. While it lacks cameras for some keyframes, and there is work left, further rungs
find more to estimate from, and cameras are estimated again. An answer is never made worse: the better one is kept.
How much is tried depends on the photographs alone: work is counted by what is done, and no clock decides unless
somebody asked for a deadline.
"""

from __future__ import annotations

import hashlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from splatnode.recon.clock import is_over
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras
from splatnode.recon.fallbacks import affine_simulation, learned
from splatnode.recon.fallbacks.fallback import Fallback, FallbackState, choose_better_reconstruction
from splatnode.recon.fallbacks.others import estimate_without_doubtful
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.result.verdict import Code

log = logging.getLogger(__name__)

RUNGS = (learned.RUNG, affine_simulation.RUNG)  # what wins most for its work comes first
CAMERAS = 0.2  # work of estimating the cameras again, for each keyframe
LACKING_MATCHES = (Code.NO_OVERLAP, Code.SPLIT, Code.OK_PARTIAL, Code.AMBIGUOUS)
# Of the others, what more cameras may mend, where some keyframes have none: few leave much open.
UNCERTAIN = (Code.OK_ROUGH, Code.TOO_ROUGH, Code.FOCAL_SUSPECT, Code.PLANAR_ONLY, Code.BASELINE_TOO_SMALL)


def run_fallbacks(
    estimate: Reconstruction,
    rejected: Sequence[Rejected],
    config: ReconstructionConfig,
    pause: Callable[[], None] = lambda: None,
    rungs: Sequence[Fallback] = RUNGS,
    until: float = math.inf,
) -> Reconstruction:
    """The best of `estimate` and what the `rungs` lead to; a refusal then says what was tried.

    With `config.no_fallbacks` it is `estimate`. `config.fallbacks` bounds the work that is added: what it comes to is
    looked at between pairs and before each rung, as is `until`, a time of `time.monotonic()`. A pair and an estimate
    that have begun are finished. Where that does not help, photographs in doubt are left out. `pause` may raise.
    """
    if config.no_fallbacks:
        return estimate
    if _lacks_matches(estimate):
        estimate = _try_fallbacks(estimate, rejected, config, pause, rungs, until)
    return estimate if is_over(until) else estimate_without_doubtful(estimate, rejected, config, pause)


def make_fallback_key(graph: ViewGraph, config: ReconstructionConfig, rungs: Sequence[Fallback] = RUNGS) -> str:
    """Identifies what the rungs start from: the keyframes, their matches, the budget, and which rungs are available.

    Rungs that gained nothing gain nothing from an equal start. The key is the same in another process.
    """
    digest, names = hashlib.blake2b(digest_size=16), graph.names
    available = [f"{rung.name}: {rung.obstacle()}" for rung in rungs]
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
    pause: Callable[[], None],
    rungs: Sequence[Fallback],
    until: float,
) -> Reconstruction:
    means, most_s = FallbackState(estimate.graph, config), config.fallbacks.timeout_s
    until = until if most_s is None else min(until, time.monotonic() + most_s)
    tried: list[str] = []
    not_tried: list[str] = []
    for rung in rungs:
        doubtful = find_doubtful_keyframes(estimate)
        if not doubtful or _is_exhausted(means, until):
            break
        obstacle = rung.obstacle()
        if obstacle:
            not_tried.append(f"{rung.name} ({obstacle})")
            continue
        before = means
        means = _run_fallback(rung.climb(before, doubtful), before, until, pause)
        if means is before:
            continue
        other = estimate_cameras(means.graph, rejected, means.config, pause)
        means = means.add_work(CAMERAS * len(means.graph.keyframes))
        estimate = choose_better_reconstruction(estimate, other)
        gained = "more photographs found their place" if estimate is other else "nothing gained"
        log.info("looked for more matches: %s: %s by %.1f of work", rung.name, gained, means.work - before.work)
        tried.append(rung.name)
    return _append_tried(estimate, {"Also tried": tried, "Not tried": not_tried})


def _lacks_matches(estimate: Reconstruction) -> bool:
    code = estimate.verdict.code
    return code in LACKING_MATCHES or (code in UNCERTAIN and bool(find_unplaced_keyframes(estimate)))


def _run_fallback(
    climb: Iterator[FallbackState], means: FallbackState, until: float, pause: Callable[[], None]
) -> FallbackState:
    """The means after the last piece of work that begins before the climb ends."""
    for further in climb:
        means = further
        pause()
        if _is_exhausted(means, until):
            break
    return means


def _is_exhausted(means: FallbackState, until: float) -> bool:
    """Whether nothing further begins, for these means or from `until` on, a time of `time.monotonic()`."""
    return means.work >= means.config.fallbacks.budget or is_over(until)


def find_doubtful_keyframes(estimate: Reconstruction) -> frozenset[str]:
    """The names of those without a camera, and of those that the verdict is about; none where all are published."""
    without = find_unplaced_keyframes(estimate)
    return without if estimate.verdict.publishable else without.union(estimate.verdict.frames)


def find_unplaced_keyframes(estimate: Reconstruction) -> frozenset[str]:
    """The names of the keyframes that have no camera."""
    return frozenset(estimate.graph.names) - estimate.camera_names


def _append_tried(estimate: Reconstruction, rungs: Mapping[str, Sequence[str]]) -> Reconstruction:
    """Appends the fallbacks to the verdict's message, unless nothing is left to explain."""
    if not find_doubtful_keyframes(estimate):
        return estimate
    sentences = [f"{what}: {', '.join(names)}." for what, names in rungs.items() if names]
    message = " ".join([estimate.verdict.message, *sentences])
    return replace(estimate, verdict=replace(estimate.verdict, message=message)) if sentences else estimate
