"""Runs wait for what they need, which is made once, and is not kept longer than that."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from splatnode.extras.evaluate.runner import PlannedRun, Prerequisite, run_schedule
from splatnode.extras.jobs import Engine, Limits
from tests.support.calls import in_this_process


def fails() -> None:
    raise RuntimeError("no such thing")


def joined(name: str, *needed: bytes) -> partial:
    return partial("{}:{}".format, name, len(needed))


def planned(name: str, *needs: Prerequisite) -> PlannedRun:
    return PlannedRun(name, needs, partial(joined, name))


def test_runs_come_in_their_order_each_after_what_it_needs(tmp_path):
    made, lay = [], []
    one, other, lost = (
        Prerequisite("one", partial(abs, -1)),
        Prerequisite("other", partial(abs, -2)),
        Prerequisite("lost", fails),
    )

    def answers(take, limits: Limits, folder: Path):
        for about, answer in in_this_process().answers(take, limits, folder):
            made.append(about.key if isinstance(about, Prerequisite) else about.about)
            yield about, answer
            lay.append(len(list((tmp_path / "needs").iterdir())))

    runs = [planned("a", one), planned("b"), planned("c", lost, one), planned("d", one, other), planned("e")]
    found = list(run_schedule(runs, Engine(1, answers), Limits(), tmp_path))
    assert made == ["one", "a", "b", "lost", "other", "d", "e"]
    assert [(run.about, answer.reason or answer.value()) for run, answer in found] == [
        ("a", "a:1"),
        ("b", "b:0"),
        ("c", "no such thing"),
        ("d", "d:2"),
        ("e", "e:0"),
    ]
    assert lay == [1, 1, 1, 1, 2, 0, 0]


def test_what_is_under_way_keeps_no_other_run_waiting(tmp_path):
    asked = []

    def answers(take, limits: Limits, folder: Path):
        asked.extend(take().about for _ in range(3))
        yield from ()

    slow = Prerequisite("slow", partial(abs, -1))
    runs = [planned("a", slow), planned("b", slow), planned("c"), planned("d")]
    assert list(run_schedule(runs, Engine(1, answers), Limits(), tmp_path)) == []
    assert asked == [slow, runs[2], runs[3]]
