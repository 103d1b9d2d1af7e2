"""The verb `stability`."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys

from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.report import explain_missing_seconds
from splatnode.extras.evaluate.stability.campaign import Plan, run_campaign
from splatnode.extras.evaluate.stability.matrix import select_rows
from splatnode.extras.evaluate.stability.perturbations import load_scenes_by_motion
from splatnode.extras.evaluate.stability.report import Rate, summarise
from splatnode.extras.evaluate.stability.trial import find_method
from splatnode.extras.evaluate.stability.windows.campaign import run_windows_verb
from splatnode.extras.jobs.calls import engine as opened

logger = logging.getLogger(__name__)


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
        from splatnode.extras.evaluate.stability import report
    except ImportError:
        logger.warning("no chart: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
    else:
        report.draw(args.out / "stability.json", args.out)
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
