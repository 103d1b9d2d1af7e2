"""Fallbacks are tried while they are needed and the budget lasts, and the better answer is kept."""

from __future__ import annotations

import itertools
import time
from collections.abc import Collection, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from splatnode.recon import fallbacks
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.fallbacks import Fallback, FallbackState, choose_better_reconstruction, run_fallbacks
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.threads import RunContext
from tests.support.row_of_views import graph_of, registration_of
from tests.support.synthetic import SMALL, places

NAMES = graph_of(4).names


def estimate(code: Code, cameras: int) -> Reconstruction:
    """With a camera for each of the first keyframes of four."""
    publishable = code in (Code.OK, Code.OK_PARTIAL, Code.OK_ROUGH)
    verdict = Verdict(code, "So it is.", "", () if publishable else tuple(NAMES), publishable)
    evidence: Any = SimpleNamespace()
    return Reconstruction(graph_of(4), registration_of(cameras), evidence, verdict)


NO_OVERLAP = estimate(Code.NO_OVERLAP, 2)


def make_fallback(name: str, parts: int = 1, reason: str = "") -> Fallback:
    """Adds so many pairs at a cost of 1 each; the seed of the state's configuration counts them all."""

    def extend(state: FallbackState, doubtful: Collection[str]) -> Iterator[FallbackState]:
        for _ in range(parts):
            state = replace(state, config=apply_changes(state.config, {"seed": state.config.seed + 1})).add_cost(1.0)
            yield state

    return Fallback(name, extend, lambda: reason)


@pytest.fixture
def estimated(monkeypatch):
    """The seeds of what was estimated from; `answers` is what came of it, in order."""
    seeds: list[int] = []

    def of(*answers: Reconstruction) -> list[int]:
        coming = iter(answers)

        def estimate_cameras(graph, rejected, config, run):
            seeds.append(config.seed)
            return next(coming)

        monkeypatch.setattr(fallbacks, "estimate_cameras", estimate_cameras)
        return seeds

    return of


def make_config(cost: float) -> ReconstructionConfig:
    return apply_changes(ReconstructionConfig(), {"fallbacks": {"budget": cost}})


def run(first: Reconstruction, *tried: Fallback, config: ReconstructionConfig | None = None) -> Reconstruction:
    return run_fallbacks(first, (), config or make_config(100.0), fallbacks=tried)


def test_fallbacks_add_up_until_one_leads_to_an_answer(estimated):
    answer = estimate(Code.OK, 4)
    seeds = estimated(NO_OVERLAP, answer)
    assert run(NO_OVERLAP, make_fallback("a", 2), make_fallback("b", 3), make_fallback("c")) is answer
    assert seeds == [2, 5]


def test_a_refusal_says_what_was_tried(estimated):
    estimated(NO_OVERLAP)
    found = run(
        NO_OVERLAP, make_fallback("tilts"), make_fallback("networks", reason="no weights"), make_fallback("nothing", 0)
    )
    assert found.verdict.message == "So it is. Also tried: tilts. Not tried: networks (no weights)."
    assert found.verdict.code is Code.NO_OVERLAP and not found.publishable


@pytest.mark.parametrize(
    "first",
    [estimate(Code.OK, 4), estimate(Code.BASELINE_TOO_SMALL, 4), estimate(Code.TOO_FEW_VIEWS, 0)],
    ids=lambda found: found.verdict.code.value,
)
def test_what_no_match_could_help_is_not_touched(first, estimated):
    assert run(first, make_fallback("a")) is first and estimated() == []


def test_no_fallbacks_keeps_the_first_estimate(estimated):
    assert (
        run(NO_OVERLAP, make_fallback("a"), config=ReconstructionConfig(no_fallbacks=True)) is NO_OVERLAP
        and estimated() == []
    )


def test_the_budget_ends_fallbacks_between_pairs_and_between_fallbacks(estimated):
    seeds = estimated(NO_OVERLAP, NO_OVERLAP)
    found = run(NO_OVERLAP, make_fallback("long", 100), make_fallback("late"), config=make_config(6.0))
    assert seeds == [6] and found.verdict.message.endswith("Also tried: long.")


@pytest.mark.parametrize(("beyond", "tried"), [(-0.1, [2]), (0.1, [2, 3])])
def test_to_estimate_again_is_work_too(beyond, tried, estimated):
    seeds = estimated(NO_OVERLAP, NO_OVERLAP)
    cost = 2.0 + fallbacks.CAMERA_COST * len(NAMES) + beyond
    run(NO_OVERLAP, make_fallback("short", 2), make_fallback("late"), config=make_config(cost))
    assert seeds == tried


def test_without_budget_no_fallback_is_tried(estimated):
    assert run(NO_OVERLAP, make_fallback("a"), config=make_config(0.0)) is NO_OVERLAP


def test_a_deadline_ends_fallbacks_and_without_one_no_clock_is_read(estimated, monkeypatch):
    seeds, clock = estimated(NO_OVERLAP, NO_OVERLAP, NO_OVERLAP), itertools.count(0.0, 1.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    run_fallbacks(
        NO_OVERLAP, (), make_config(1000.0), run=RunContext(deadline=6.0), fallbacks=[make_fallback("long", 100)]
    )
    assert 1 < seeds[0] <= 6 and (read := next(clock)) < 10
    run_fallbacks(NO_OVERLAP, (), make_config(1000.0), fallbacks=[make_fallback("long", 100)])
    assert seeds[1] == 100 and next(clock) == read + 1
    run(
        NO_OVERLAP,
        make_fallback("long", 100),
        config=apply_changes(make_config(1000.0), {"fallbacks": {"timeout_s": 6.0}}),
    )
    assert 1 < seeds[2] <= 6


def test_the_better_answer_is_kept(estimated):
    partial, worse = estimate(Code.OK_PARTIAL, 3), estimate(Code.OK_PARTIAL, 3)
    refusals = [estimate(Code.AMBIGUOUS, 4), estimate(Code.NO_OVERLAP, 1)]
    estimated(refusals[0], worse, refusals[1])
    kept = run(partial, make_fallback("a"), make_fallback("b"), make_fallback("c"))
    assert kept.registration is partial.registration and kept.verdict.code is Code.OK_PARTIAL
    more = estimate(Code.BASELINE_TOO_SMALL, 4)  # "move further to the side" would be the wrong thing to say
    estimated(more)
    assert run(NO_OVERLAP, make_fallback("a")).verdict.code is Code.NO_OVERLAP
    estimated(estimate(Code.OK_PARTIAL, 4))
    assert len(run(partial, make_fallback("a")).publishable_camera_names) == 4


def test_an_answer_that_contradicts_the_accepted_one_is_not_better():
    partial, whole = estimate(Code.OK_PARTIAL, 3), estimate(Code.OK, 4)
    assert choose_better_reconstruction(partial, whole) is whole
    assert whole.registration is not None
    first, *others = whole.registration.cameras
    for turn_deg, kept in ((1.0, "other"), (10.0, "one")):
        T_world_camera = first.T_world_camera.copy()
        T_world_camera[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(turn_deg), 0.0]))[0]
        turned = replace(first, T_world_camera=T_world_camera)
        other = replace(whole, registration=replace(whole.registration, cameras=(turned, *others)))
        assert choose_better_reconstruction(partial, other) is (other if kept == "other" else partial)


def test_a_rough_answer_of_weak_matches_is_not_taken(estimated):
    estimated(estimate(Code.OK_ROUGH, 4))
    assert run(NO_OVERLAP, make_fallback("a")).verdict.code is Code.NO_OVERLAP


def test_what_a_few_cameras_leave_uncertain_may_be_mended_by_more(estimated):
    pair, answer = estimate(Code.FOCAL_SUSPECT, 2), estimate(Code.OK, 4)
    estimated(answer)
    assert run(pair, make_fallback("a")) is answer


def test_an_accepted_camera_is_not_given_up_for_two_others():
    others = estimate(Code.OK_PARTIAL, 4)
    assert others.registration is not None
    without_first = replace(others, registration=replace(others.registration, cameras=others.registration.cameras[1:]))
    one = estimate(Code.OK_PARTIAL, 2)
    assert choose_better_reconstruction(one, without_first) is one and len(without_first.publishable_camera_names) == 3


def test_pause_may_abandon_fallbacks(estimated):
    class Abandoned(Exception):
        pass

    def pause() -> None:
        raise Abandoned

    estimated(NO_OVERLAP)
    with pytest.raises(Abandoned):
        run_fallbacks(NO_OVERLAP, (), ReconstructionConfig(), RunContext(pause), [make_fallback("a")])


@pytest.mark.parametrize("quick", [False, True])
def test_photographs_of_three_places_are_refused_with_what_was_tried_unless_quick(quick, monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    frames = places(msgspec.structs.replace(SMALL, views=3), seeds=(0, 1, 2))
    *_, final = reconstruct(frames, ReconstructionConfig(no_fallbacks=quick))
    assert final.verdict.code is Code.NO_OVERLAP
    assert ("stronger tilts" in final.verdict.message) != quick
    assert (final.seconds["fallbacks"] > 0.1) != quick
