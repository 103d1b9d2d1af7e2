"""The verb `stability`."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys

from splatnode.capture.process.terminal import say
from splatnode.recon.evaluate.stability.campaign import Plan, run_campaign
from splatnode.recon.evaluate.stability.matrix import chosen
from splatnode.recon.evaluate.stability.methods import by_name
from splatnode.recon.evaluate.stability.places import load_places
from splatnode.recon.evaluate.stability.summary import Rate, summarise
from splatnode.recon.evaluate.stability.windows.command import windows
from splatnode.recon.evaluate.timing import untimed
from splatnode.recon.jobs.calls import engine as opened

logger = logging.getLogger(__name__)


def stability(args: argparse.Namespace) -> int:
    """Runs the matrix, writes stability.json and stability.png, and prints the rates; or the windows, where asked."""
    if args.windows:
        return windows(args)
    plan = Plan(
        rows=chosen(args.rows),
        seeds=tuple(range(args.seeds)),
        methods=args.methods or ("splatnode",),
        timeout_s=args.timeout_s,
        max_memory_mb=args.max_memory,
    )
    for method in plan.methods:
        by_name(method)
    command = shlex.join(["splatnode", *sys.argv[1:]])
    with opened(args.cores, args.ray) as engine:
        trials = run_campaign(plan, load_places(args.scenes, args.out), args.out, command, engine)
    try:
        from splatnode.recon.evaluate.stability import chart
    except ImportError:
        logger.warning("no chart: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
    else:
        chart.draw(args.out / "stability.json", args.out)
    for trial in trials:
        if trial["outcome"] in ("false_accept", "false_refuse", "failed"):
            which = f"row {trial['row']} {trial['name']}, seed {trial['seed']}, {trial['method']}"
            reason = trial["message"].strip().splitlines()[-1]
            say(f"{trial['outcome']}: {which}: {trial['verdict']}; {trial['note']}; {reason}")
    for method in dict.fromkeys(trial["method"] for trial in trials):
        summary = summarise(trials, method)
        say(
            f"{method}: {summary.trials} trials, false accepts {_rate_text(summary.false_accept)}, "
            f"false refusals {_rate_text(summary.false_refuse)}, other codes {_rate_text(summary.other_code)}"
        )
    if why := untimed([trial.get("others") for trial in trials]):
        say(why)
    say(f"results: {args.out}/ (stability.json, stability.png)")
    return 0


def _rate_text(rate: Rate) -> str:
    if rate.rate is None or rate.low is None or rate.high is None:
        return "not tried"
    return f"{rate.count}/{rate.of} = {rate.rate:.1%} ({rate.low:.1%} to {rate.high:.1%})"
