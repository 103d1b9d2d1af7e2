"""The stability matrix: all trials of a plan, some at a time, their counts, and the verb."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import math
import shlex
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import read_json
from splatnode.extras.evaluate.report import check_same_cores, describe_machine, explain_missing_seconds
from splatnode.extras.evaluate.runner import Journal
from splatnode.extras.evaluate.stability import cases, degradations
from splatnode.extras.evaluate.stability.perturbations import Sampler, ScenesByMotion, load_scenes_by_motion
from splatnode.extras.evaluate.stability.trial import (
    FAILED,
    Demand,
    MatrixRow,
    Outcome,
    Trial,
    TrialCase,
    find_method,
    judge_trial,
    run_trial,
)
from splatnode.extras.evaluate.stability.window_campaign import run_windows_verb
from splatnode.extras.jobs import Engine, Limits, Task, pack_call, work_folder
from splatnode.extras.jobs import engine as opened
from splatnode.recon.result.export.staged import hold_result_folder, json_bytes, write_files

# The trials counted: how often a wrong scene was published, how often a right one refused.

_Z95 = 1.959963984540054  # normal quantile of a two-sided 95 % interval


@dataclass(frozen=True)
class Rate:
    """`count` of `of`, with the 95 % interval of the rate after Wilson (1927); None where nothing was tried."""

    count: int
    of: int
    rate: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Summary:
    """The counts and rates of one method. `confusion` counts outcomes by what was asked."""

    method: str
    trials: int
    confusion: Mapping[str, Mapping[str, int]]
    false_accept: Rate  # wrong scenes that were published, of all trials
    wrong_of_published: Rate  # the same, of the scenes that were published
    false_refuse: Rate  # no scene, of the trials that are enough for one
    other_code: Rate  # refusals for a reason that does not fit, of the refusals that were asked for or allowed
    missed_limits: Rate  # rows that measure something: how often it was outside their limits
    seconds_median: float | None
    refusal_seconds_median: float | None
    processor_seconds_mean: float | None


def compute_rate(count: int, of: int) -> Rate:
    """Wilson's interval: unlike the normal one it is right for rates near 0, which is where they should be."""
    if of == 0:
        return Rate(count, 0, None, None, None)
    share, z2 = count / of, _Z95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = _Z95 * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    low = 0.0 if count == 0 else max(0.0, middle - half)
    return Rate(count, of, share, low, 1.0 if count == of else min(1.0, middle + half))


def summarise(trials: Sequence[Mapping], method: str) -> Summary:
    """Summarises the records of stability.json that are of `method`."""
    mine = [trial for trial in trials if trial["method"] == method]
    confusion = {
        demand.value: {
            found.value: sum(t["demand"] == demand.value and t["outcome"] == found.value for t in mine)
            for found in Outcome
        }
        for demand in Demand
    }
    outcomes = {found: sum(by[found.value] for by in confusion.values()) for found in Outcome}
    asked = confusion[Demand.ACCEPT.value]
    published = outcomes[Outcome.ACCEPTED] + outcomes[Outcome.FALSE_ACCEPT]
    refused = outcomes[Outcome.REFUSED] + outcomes[Outcome.REFUSED_OTHERWISE]
    held = [trial["held"] for trial in mine if trial["held"] is not None]
    return Summary(
        method=method,
        trials=len(mine),
        confusion=confusion,
        false_accept=compute_rate(outcomes[Outcome.FALSE_ACCEPT], len(mine)),
        wrong_of_published=compute_rate(outcomes[Outcome.FALSE_ACCEPT], published),
        false_refuse=compute_rate(asked[Outcome.FALSE_REFUSE.value] + asked[Outcome.FAILED.value], sum(asked.values())),
        other_code=compute_rate(outcomes[Outcome.REFUSED_OTHERWISE], refused),
        missed_limits=compute_rate(held.count(False), len(held)),
        seconds_median=_median([t["seconds"] for t in mine]),
        refusal_seconds_median=_median([t["seconds"] for t in mine if not t["published"]]),
        processor_seconds_mean=_mean([t["processor_seconds"] for t in mine]),
    )


def make_report(trials: Sequence[Mapping]) -> dict[str, Any]:
    """Returns what stability.json holds besides its trials; the top rates are the first method's."""
    methods = list(dict.fromkeys(trial["method"] for trial in trials))
    summaries = [summarise(trials, method) for method in methods]
    first = summaries[0] if summaries else summarise(trials, "")
    return {
        "false_accept_rate": first.false_accept.rate,
        "false_accept_interval": [first.false_accept.low, first.false_accept.high],
        "false_refuse_rate": first.false_refuse.rate,
        "false_refuse_interval": [first.false_refuse.low, first.false_refuse.high],
        "methods": [asdict(summary) for summary in summaries],
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = sorted(value for value in values if value is not None)
    middle = len(known) // 2
    if not known:
        return None
    return known[middle] if len(known) % 2 else 0.5 * (known[middle - 1] + known[middle])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


# All trials of a plan, some at a time; what is on the disk already is not run again; and its verb.
#
# The matrix has all rows, by number: every `MatrixRow` of the modules in `_FAMILIES`. A new row is one function in one
# of these files; a new file of rows is that file and its name in `_FAMILIES`. Those of `degradations.ROWS` are made
# from its kinds.

_FAMILIES = (cases, degradations)

ROWS: tuple[MatrixRow, ...] = tuple(
    sorted(
        (
            *(found for family in _FAMILIES for found in vars(family).values() if isinstance(found, MatrixRow)),
            *degradations.ROWS,
        ),
        key=lambda r: r.number,
    )
)


def select_rows(numbers: Collection[int]) -> tuple[MatrixRow, ...]:
    """The rows with these numbers; all, where there are none. Raises ValueError for a number that no row has."""
    known = {found.number for found in ROWS}
    unknown = sorted(set(numbers) - known)
    if unknown:
        raise ValueError(f"no row {', '.join(map(str, unknown))}; there are {min(known)} to {max(known)}")
    return tuple(found for found in ROWS if not numbers or found.number in numbers)


logger = logging.getLogger(__name__)

Key = tuple[int, str, int, str]


@dataclass(frozen=True)
class Plan:
    rows: tuple[MatrixRow, ...]
    seeds: tuple[int, ...]
    methods: tuple[str, ...]
    timeout_s: float = 120.0  # of one trial, from the start of its process on
    max_memory_mb: float | None = None  # of one trial


@dataclass(frozen=True, eq=False)
class _TrialContext:
    """A trial that is under way; its case is without photographs."""

    row: int
    name: str
    seed: int
    method: str
    case: TrialCase


def run_campaign(plan: Plan, places: ScenesByMotion, out: Path, command: str, engine: Engine) -> list[dict]:
    """Runs what is missing in `out`/stability.json and returns all its trials.

    What came to an end is on the disk at once, in a journal beside the file, which is rewritten every few seconds.
    Raises ValueError where the file is of other scenes, or of trials with another number of cores: rates and seconds
    over both would mean nothing.
    """
    path = out / "stability.json"
    scenes = [place.name for kind in (places.walked, places.forward, places.turned) for place in kind]
    trials = _resume_trials(path, scenes, engine.cores_each)
    whole = partial(_write, path, plan, trials, {"scenes": scenes, "machine": describe_machine(), "command": command})
    with hold_result_folder(out), work_folder(out) as folder:
        if not path.exists():
            whole()  # which scenes the journal is of
        with Journal(out / "stability.jsonl", whole) as kept:
            known = set(map(_make_key, trials))
            trials += [trial for trial in kept.recover_records() if _make_key(trial) not in known]
            present = set(map(_make_key, trials))
            todo = [job for job in _list_jobs(plan) if (job[0].number, job[0].name, *job[1:]) not in present]
            for trial in _run_jobs(plan, places, todo, engine, folder):
                trials.append(asdict(trial))
                kept.add(trials[-1])
                logger.info(f"stability {len(trials)}/{len(present) + len(todo)}: {_format_trial(trial)}")
    return trials


def _write(path: Path, plan: Plan, trials: Sequence[Mapping], circumstances: Mapping) -> None:
    ordered = sorted(trials, key=lambda t: (plan_order(plan, t["method"]), *_make_key(t)))
    write_files(path.parent, {path.name: json_bytes({"trials": ordered, **make_report(ordered), **circumstances})})


def _format_trial(trial: Trial) -> str:
    took = "not timed" if trial.seconds is None else f"{trial.seconds:.1f} s"
    answered = f"{trial.verdict}, {trial.outcome}, {'no answer' if trial.verdict == FAILED else took}"
    return f"row {trial.row} {trial.name}, seed {trial.seed}, {trial.method}: {answered}"


def plan_order(plan: Plan, method: str) -> int:
    """The methods in the order of the plan, those of earlier runs after them."""
    return plan.methods.index(method) if method in plan.methods else len(plan.methods)


def _list_jobs(plan: Plan) -> list[tuple[MatrixRow, int, str]]:
    """Seed after seed, so that a campaign that is stopped has tried every row."""
    return [(row, seed, method) for seed in plan.seeds for row in plan.rows for method in plan.methods]


def _run_jobs(
    plan: Plan, places: ScenesByMotion, todo: Sequence[tuple[MatrixRow, int, str]], engine: Engine, folder: Path
) -> Iterator[Trial]:
    """Trials as they are done."""
    tasks = (_make_task(places, *job) for job in todo)
    limits = Limits(plan.max_memory_mb, plan.timeout_s)
    for about, answer in engine.answers(partial(next, tasks, None), limits, folder):
        yield judge_trial(about.case, about.row, about.name, about.seed, about.method, answer)


def _make_task(places: ScenesByMotion, row: MatrixRow, seed: int, method: str) -> Task:
    """The photographs go to the process, and the truth stays here."""
    case = row.make(Sampler(places, row.name, seed))
    call = pack_call(partial(run_trial, dataclasses.replace(case, worlds=()), method))
    return Task(
        _TrialContext(row.number, row.name, seed, method, dataclasses.replace(case, source=list, probe=None)), call
    )


class _Trials(msgspec.Struct, frozen=True):
    scenes: list[str]
    trials: list[dict]
    machine: dict


def _resume_trials(path: Path, scenes: Sequence[str], cores_each: int) -> list[dict]:
    if not path.exists():
        return []
    content = read_json(path, _Trials, "the stability.json of a campaign")
    if content.scenes != list(scenes):
        raise ValueError(
            f"{path} is of the scenes {', '.join(content.scenes)}, now there are {', '.join(scenes)}; "
            "give another folder with --out DIR, or the same scenes"
        )
    before = content.machine.get("threads")  # on which each trial ran, before a trial said so itself
    known = [trial.get("cores") or before for trial in content.trials if trial.get("seconds") is not None]
    check_same_cores([cores for cores in known if cores], cores_each, path)
    return content.trials


def _make_key(trial: Mapping) -> Key:
    return trial["row"], trial["name"], trial["seed"], trial["method"]


def stability(args: argparse.Namespace) -> int:
    """Runs the matrix, writes stability.json and stability.png, and prints the rates; or the windows, where asked."""
    if args.windows:
        return run_windows_verb(args)
    plan = Plan(
        rows=select_rows(args.rows),
        seeds=tuple(range(args.seeds)),
        methods=args.methods or ("splatnode",),
        timeout_s=args.timeout_s,
        max_memory_mb=args.max_memory,
    )
    for method in plan.methods:
        find_method(method)
    command = shlex.join(["splatnode", *sys.argv[1:]])
    with opened(args.cores, args.ray) as engine:
        trials = run_campaign(plan, load_scenes_by_motion(args.scenes, args.out), args.out, command, engine)
    try:
        from splatnode.extras.evaluate.charts import draw_stability
    except ImportError:
        logger.warning("no chart: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
    else:
        draw_stability(args.out / "stability.json", args.out)
    for trial in trials:
        if trial["outcome"] in ("false_accept", "false_refuse", "failed"):
            which = f"row {trial['row']} {trial['name']}, seed {trial['seed']}, {trial['method']}"
            reason = trial["message"].strip().splitlines()[-1]
            say(f"{trial['outcome']}: {which}: {trial['verdict']}; {trial['note']}; {reason}")
    for method in dict.fromkeys(trial["method"] for trial in trials):
        summary = summarise(trials, method)
        say(
            f"{method}: {summary.trials} trials, false accepts {_format_rate(summary.false_accept)}, "
            f"false refusals {_format_rate(summary.false_refuse)}, other codes {_format_rate(summary.other_code)}"
        )
    if why := explain_missing_seconds([trial.get("others") for trial in trials]):
        say(why)
    say(f"results: {args.out}/ (stability.json, stability.png)")
    return 0


def _format_rate(rate: Rate) -> str:
    if rate.rate is None or rate.low is None or rate.high is None:
        return "not tried"
    return f"{rate.count}/{rate.of} = {rate.rate:.1%} ({rate.low:.1%} to {rate.high:.1%})"
