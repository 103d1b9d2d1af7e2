"""All trials of a plan, one after the other or some at a time; what is on the disk already is not run again."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec

from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.records import this_machine
from splatnode.recon.evaluate.stability.case import Row
from splatnode.recon.evaluate.stability.places import Places, Sampler
from splatnode.recon.evaluate.stability.summary import report
from splatnode.recon.evaluate.stability.trial import Trial, run_trial
from splatnode.recon.result.export.staged import json_bytes, write_file

logger = logging.getLogger(__name__)

Key = tuple[int, str, int, str]


@dataclass(frozen=True)
class Plan:
    rows: tuple[Row, ...]
    seeds: tuple[int, ...]
    methods: tuple[str, ...]
    jobs: int = 1  # trials at a time; more than 1 makes the seconds longer
    timeout_s: float = 120.0  # of one trial


def run_campaign(plan: Plan, places: Places, out: Path, command: str) -> list[dict]:
    """Runs what is missing in `out`/stability.json and returns all its trials; the file is rewritten after each.

    Raises ValueError where the file is of other scenes: rates over both would mean nothing.
    """
    path = out / "stability.json"
    scenes = [place.name for kind in (places.walked, places.forward, places.turned) for place in kind]
    trials = _resumed(path, scenes)
    present = {_key(trial) for trial in trials}
    todo = [job for job in _jobs(plan) if (job[0].number, job[0].name, *job[1:]) not in present]
    for trial in _results(plan, places, todo):
        trials.append(asdict(trial))
        ordered = sorted(trials, key=lambda t: (plan_order(plan, t["method"]), *_key(t)))
        content = {
            "trials": ordered,
            **report(ordered),
            "scenes": scenes,
            "machine": this_machine(),
            "command": command,
        }
        write_file(path, json_bytes(content))
        seconds = "no answer" if trial.seconds is None else f"{trial.seconds:.1f} s"
        logger.info(
            f"stability {len(trials)}/{len(present) + len(todo)}: row {trial.row} {trial.name}, seed {trial.seed}, "
            f"{trial.method}: {trial.verdict}, {trial.outcome}, {seconds}"
        )
    return trials


def plan_order(plan: Plan, method: str) -> int:
    """The methods in the order of the plan, those of earlier runs after them."""
    return plan.methods.index(method) if method in plan.methods else len(plan.methods)


def _jobs(plan: Plan) -> list[tuple[Row, int, str]]:
    """Seed after seed, so that a campaign that is stopped has tried every row."""
    return [(row, seed, method) for seed in plan.seeds for row in plan.rows for method in plan.methods]


def _results(plan: Plan, places: Places, todo: Sequence[tuple[Row, int, str]]) -> Iterator[Trial]:
    """Trials as they are done; at most `plan.jobs` sets of photographs are in memory."""
    waiting = iter(todo)
    with ThreadPoolExecutor(plan.jobs) as pool:
        running: set[Future[Trial]] = set()
        while True:
            for row, seed, method in waiting:
                running.add(pool.submit(_run, row, seed, method, places, plan.timeout_s))
                if len(running) >= plan.jobs:
                    break
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


def _run(row: Row, seed: int, method: str, places: Places, timeout_s: float) -> Trial:
    case = row.make(Sampler(places, row.name, seed))
    return run_trial(case, row.number, row.name, seed, method, timeout_s)


class _Trials(msgspec.Struct, frozen=True):
    scenes: list[str]
    trials: list[dict]


def _resumed(path: Path, scenes: Sequence[str]) -> list[dict]:
    if not path.exists():
        return []
    content = read_json(path, _Trials, "the stability.json of a campaign")
    if content.scenes != list(scenes):
        raise ValueError(
            f"{path} is of the scenes {', '.join(content.scenes)}, now there are {', '.join(scenes)}; "
            "give another folder with --out DIR, or the same scenes"
        )
    return content.trials


def _key(trial: Mapping) -> Key:
    return trial["row"], trial["name"], trial["seed"], trial["method"]
