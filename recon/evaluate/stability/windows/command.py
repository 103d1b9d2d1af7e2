"""`splatnode stability --windows`."""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from splatnode.capture.process.terminal import say
from splatnode.recon.evaluate.stability.methods import NAMES, find_method
from splatnode.recon.evaluate.stability.places import load_trial_scenes
from splatnode.recon.evaluate.stability.windows.campaign import FILE, Plan, run_windows
from splatnode.recon.evaluate.stability.windows.row import OURS, WindowOutcome, WindowRow
from splatnode.recon.evaluate.stability.windows.summary import (
    KINDS,
    group_by_angle,
    group_by_count,
    group_by_method,
    measure_coverage,
    tally_rows,
)
from splatnode.recon.evaluate.timing import explain_missing_seconds
from splatnode.recon.jobs.calls import engine as opened

logger = logging.getLogger(__name__)


def run_windows_verb(args: argparse.Namespace) -> int:
    """Runs the windows, writes windows.json and its charts, and prints the tables."""
    methods = args.methods or list_default_methods()
    for method in methods:
        find_method(method)
    plan = Plan(
        methods,
        per_kind=args.per_kind,
        counts=args.counts,
        told=args.told,
        fresh=args.fresh,
        timeout_s=args.timeout_s,
        max_memory_mb=args.max_memory,
    )
    command = shlex.join(["splatnode", *sys.argv[1:]])
    scenes, out = [Path(os.path.abspath(scene)) for scene in args.scenes], Path(os.path.abspath(args.out))
    with opened(args.cores, args.ray) as engine:  # other machines see the scenes, too, not this process's folder
        rows = run_windows(plan, load_trial_scenes(scenes, out), args.out, command, engine)
    drawn = _draw_charts(args.out, rows)
    print_report(rows)
    say(f"results: {args.out}/ ({', '.join((FILE, *drawn))})")
    return 0


def print_report(rows: Sequence[WindowRow]) -> None:
    """The tables, the windows without an answer with the reason, and of how many there are no seconds."""
    for line in format_report(rows):
        say(line)
    for row in rows:
        if row.outcome is WindowOutcome.FAILED:
            window = f"{row.scene}, {row.count} at stride {row.stride} from {row.start}, {row.method}"
            say(f"no answer: {window}: {row.message.strip().splitlines()[-1]}")
    if why := explain_missing_seconds([row.others for row in rows]):
        say(why)


def list_default_methods() -> tuple[str, ...]:
    """All methods that can run here."""
    return NAMES if importlib.util.find_spec("pycolmap") else (OURS,)


def format_report(rows: Sequence[WindowRow]) -> list[str]:
    """For people: the windows of each method by angle and by count, then the shares within the 95 % bounds."""
    head = f"{'':>26} {'sets':>5} {'right':>6} {'part':>5} {'between':>8} {'wrong':>6} {'refused':>8} {'no answer':>10}"
    lines = [head + f" {'own right':>10} {'published':>10}"]
    for method, mine in group_by_method(rows).items():
        groups = {
            "all": mine,
            **{f"{name} degrees": some for name, some in group_by_angle(mine).items()},
            **{f"{count} views": some for count, some in group_by_count(mine).items()},
        }
        for name, some in groups.items():
            t = tally_rows(some)
            own = t.own_right + t.own_right_part, t.own_right_published + t.own_right_part_published
            lines.append(
                f"{method:>10} {name:>15} {t.sets:>5} {t.right:>6} {t.right_part:>5} {t.between:>8} {t.wrong:>6} "
                f"{t.refused:>8} {t.failed:>10} {own[0]:>10} {own[1]:>10}"
            )
    for count, some in group_by_count([row for row in rows if row.method == OURS]).items():
        found = measure_coverage(some)
        shares = [f"{kind} {found.within[kind]:.0%}" for kind in KINDS if found.within[kind] is not None]
        if shares:
            lines.append(f"within the 95 % bounds, {count} views ({found.cameras} cameras): {', '.join(shares)}")
    return lines


def _draw_charts(out: Path, rows: Sequence[WindowRow]) -> list[str]:
    """The names of the charts that were drawn to `out`."""
    try:
        from splatnode.recon.evaluate.stability.windows import charts
    except ImportError:
        logger.warning("no charts: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
        return []
    return charts.draw(rows, out)
