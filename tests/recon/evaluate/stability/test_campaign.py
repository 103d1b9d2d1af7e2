"""Trials of the stability matrix: each ends, and a campaign goes on where it was stopped."""

from __future__ import annotations

import argparse
import json
import os
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.command_line import build_parser
from splatnode.recon.evaluate.stability import campaign
from splatnode.recon.evaluate.stability.campaign import Plan, run_campaign
from splatnode.recon.evaluate.stability.case import Case, Demand, Row
from splatnode.recon.evaluate.stability.methods import by_name
from splatnode.recon.evaluate.stability.places import Places
from splatnode.recon.evaluate.stability.trial import Trial, run_trial
from splatnode.recon.result.verdict import Code
from tests.support.stability_places import three_places


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> Places:
    return three_places(tmp_path_factory.mktemp("places"))


def hang() -> list[Frame]:
    time.sleep(600)
    return []


def one_frame() -> list[Frame]:
    return [Frame(0, "only", 0, np.zeros((48, 64, 3), np.uint8), None)]


def case(source) -> Case:
    return Case("a note", source, Demand.REFUSE, frozenset({Code.TOO_FEW_VIEWS}))


def test_a_trial_ends_whatever_happens_in_it():
    run = partial(run_trial, row=4, name="single", seed=0, method="splatnode")
    refused = run(case(one_frame), timeout_s=60.0)
    assert (refused.verdict, refused.outcome, refused.right) == ("TOO_FEW_VIEWS", "refused", True)
    assert refused.seconds is not None and refused.peak_rss_mb is not None
    hangs = run(case(hang), timeout_s=0.5)
    assert (hangs.verdict, hangs.outcome, hangs.message) == ("FAILED", "failed", "stopped after 0.5 s")
    crashes = run(case(partial(os._exit, 9)), timeout_s=60.0)
    assert crashes.outcome == "failed" and "ended with code 9" in crashes.message
    raises = run(case(partial(int, "x")), timeout_s=60.0)
    assert raises.outcome == "failed" and "ValueError" in raises.message


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path, places, monkeypatch):
    tried = []

    def fake(case, row, name, seed, method, timeout_s):
        tried.append((row, seed))
        return Trial(
            row=row,
            name=name,
            seed=seed,
            method=method,
            note=case.note,
            demand="refuse",
            expected=("TOO_FEW_VIEWS",),
            verdict="TOO_FEW_VIEWS",
            published=False,
            right=True,
            outcome="refused",
        )

    monkeypatch.setattr(campaign, "run_trial", fake)
    rows = tuple(Row(number, "quick", lambda sampler: case(one_frame)) for number in (1, 2))
    run_campaign(Plan(rows, (0,), ("splatnode",)), places, tmp_path, "command")
    assert tried == [(1, 0), (2, 0)]
    trials = run_campaign(Plan(rows, (0, 1), ("splatnode",), jobs=2), places, tmp_path, "command")
    assert sorted(tried[2:]) == [(1, 1), (2, 1)] and len(trials) == 4
    content = json.loads((tmp_path / "stability.json").read_text())
    assert [(t["row"], t["seed"]) for t in content["trials"]] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert content["false_accept_rate"] == 0.0 and content["false_refuse_rate"] is None
    elsewhere = Places(places.walked[:1])
    with pytest.raises(ValueError, match="is of the scenes east, south, west, now there are east"):
        run_campaign(Plan(rows, (0,), ("splatnode",)), elsewhere, tmp_path, "command")


def test_command_line():
    parse = build_parser().parse_args
    args = parse(
        ["stability", "a", "b", "--rows", "1,7", "--seeds", "2", "--methods", "splatnode,colmap", "--out", "o"]
    )
    assert (args.scenes, args.rows, args.seeds) == ([Path("a"), Path("b")], (1, 7), 2)
    assert args.methods == ("splatnode", "colmap") and args.jobs == 1
    assert isinstance(args, argparse.Namespace)
    with pytest.raises(ValueError, match="no method 'magic'; there are: splatnode, colmap, glomap"):
        by_name("magic")
