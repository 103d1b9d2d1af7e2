"""Processes that run some at a time, on cores of their own; what is to be done may grow while it is done."""

from __future__ import annotations

import os
import sys
from collections import deque

from splatnode.extras.jobs import Child, Limits, run_processes

CORES = tuple(sorted(os.sched_getaffinity(0)))


def test_what_an_end_adds_is_run_too(tmp_path):
    todo = deque(["first"])
    order = []
    take = lambda: todo.popleft() if todo else None  # noqa: E731
    for name, end in run_processes(
        take, lambda name, cores: Child.start(["true"], tmp_path / name, cores), [CORES[:1]], Limits()
    ):
        order.append(name)
        assert end.exit_code == 0
        if name == "first":
            todo.extend(["second", "third"])
    assert order == ["first", "second", "third"]


def test_a_place_may_have_several_cores(tmp_path):
    told = [sys.executable, "-c", "import os; print(sorted(os.sched_getaffinity(0)))"]
    todo = iter(["all"])
    (found,) = run_processes(
        lambda: next(todo, None), lambda name, cores: Child.start(told, tmp_path / name, cores), [CORES], Limits()
    )
    assert found[1].exit_code == 0 and (tmp_path / "all").read_text().strip() == str(list(CORES))
