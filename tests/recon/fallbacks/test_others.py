"""Photographs in doubt are left out where most others are published without them, and the verdict says why."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from splatnode.recon import fallbacks
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.fallbacks import estimate_without_doubtful, run_fallbacks
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.row_of_views import graph_of, registration_of

COUNT = 6
GRAPH = graph_of(COUNT)
NAMES = GRAPH.names


def estimate(code: Code, cameras: int, *about: int) -> Reconstruction:
    """With a camera for each of the first keyframes; the verdict is about some of them."""
    publishable = code in (Code.OK, Code.OK_PARTIAL, Code.OK_ROUGH)
    verdict = Verdict(code, "So it is.", "Do so.", tuple(NAMES[index] for index in about), publishable)
    evidence: Any = SimpleNamespace()
    return Reconstruction(GRAPH, registration_of(cameras), evidence, verdict)


@pytest.fixture
def asked(monkeypatch):
    """The graphs that were estimated from; `answers` is what came of it, in order."""

    def of(*answers: Reconstruction) -> list:
        graphs, coming = [], iter(answers)

        def estimate_cameras(graph, *_: object):
            graphs.append(graph)
            return replace(next(coming), graph=graph)

        monkeypatch.setattr(fallbacks, "estimate_cameras", estimate_cameras)
        return graphs

    return of


def judged(first: Reconstruction) -> Reconstruction:
    return estimate_without_doubtful(first, (), ReconstructionConfig(), lambda: None)


def test_most_photographs_are_published_without_the_one_in_doubt(asked):
    graphs = asked(estimate(Code.OK_PARTIAL, 5, 5))
    found = judged(estimate(Code.MOVING_SCENE, 6, 5))
    assert graphs[0].names == NAMES and not any(5 in pair for pair in graphs[0].pairs)
    assert (0, 1) in graphs[0].pairs
    assert found.verdict.code is Code.OK_PARTIAL and len(found.publishable_camera_names) == 5
    assert found.verdict.message == "5 of 6 photographs were placed, after 05.png was left out: So it is."


def test_a_further_doubt_leaves_out_a_further_photograph(asked):
    graphs = asked(estimate(Code.AMBIGUOUS, 5, 4), estimate(Code.OK_PARTIAL, 4, 4, 5))
    found = judged(estimate(Code.MOVING_SCENE, 6, 5))
    assert len(graphs) == 2 and not any({4, 5} & set(pair) for pair in graphs[1].pairs)
    assert found.verdict.message.startswith("4 of 6 photographs were placed, after 04.png, 05.png were left out:")


@pytest.mark.parametrize(
    "first",
    [
        estimate(Code.OK, 6),
        estimate(Code.BASELINE_TOO_SMALL, 6, *range(6)),  # all are in doubt
        estimate(Code.SPLIT, 6, 3, 4, 5),  # half are: which half is right?
        estimate(Code.AMBIGUOUS, 3, 0),  # two would be left
        estimate(Code.AMBIGUOUS, 6),  # none is named
    ],
    ids=lambda first: f"{first.verdict.code.value} {len(first.verdict.frames)}",
)
def test_where_most_are_in_doubt_the_answer_stays(first, asked):
    assert judged(first) is first and asked() == []


def test_a_refusal_that_names_only_what_is_left_out_already_ends_it(asked):
    graphs = asked(estimate(Code.MIXED_CAMERAS, 5, 5))
    first = estimate(Code.MOVING_SCENE, 6, 5)
    assert judged(first) is first and len(graphs) == 1


@pytest.mark.parametrize("second", [estimate(Code.OK_ROUGH, 5), estimate(Code.AMBIGUOUS, 5, *range(5))])
def test_what_is_not_exact_or_not_published_is_not_taken(second, asked):
    asked(second)
    first = estimate(Code.MOVING_SCENE, 6, 5)
    assert judged(first) is first


def test_quick_takes_the_first_answer(asked):
    first = estimate(Code.MOVING_SCENE, 6, 5)
    assert run_fallbacks(first, (), ReconstructionConfig(no_fallbacks=True)) is first and asked() == []
    asked(estimate(Code.OK_PARTIAL, 5, 5))
    assert run_fallbacks(first, (), ReconstructionConfig()).publishable
