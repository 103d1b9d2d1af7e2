"""The verb batch."""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from splatnode.capture.process import python
from splatnode.capture.process.files import LOCK
from splatnode.capture.process.system import remedy
from splatnode.capture.process.terminal import (
    ProgressStep,
    Tell,
    clear_progress,
    format_times,
    is_interactive,
    say,
    show_progress,
    show_waiting,
)
from splatnode.capture.process.text import sanitize_text
from splatnode.extras.batch import remote
from splatnode.extras.batch.batch import (
    FAILED,
    LEDGER,
    BatchRecording,
    Ledger,
    Outcome,
    Plan,
    Work,
    recordings,
    remove_leftovers,
    run_all,
)
from splatnode.extras.batch.remote import Job
from splatnode.extras.batch.report import CSV, PAGE, PARQUET, write_back, write_csv, write_page, write_parquet
from splatnode.extras.jobs.calls import chosen_cores, own_version
from splatnode.extras.jobs.child import Limits
from splatnode.extras.verbs import replay_options
from splatnode.recon.result.export.staged import hold_result_folder

Run = Callable[[Sequence[BatchRecording]], Iterator[Outcome]]  # the outcomes as they come

EXIT_GOOD, EXIT_SOME_FAILED = 0, 65
_OWN_NAMES = frozenset((LEDGER, CSV, PARQUET, PAGE))


def batch(args: argparse.Namespace) -> int:
    """Reconstructs every recording of the sources; EXIT_GOOD where each has an answer, be it that there is no scene."""
    with show_waiting("looking for recordings"):
        found = recordings(args.sources, args.out, _OWN_NAMES)
    options = replay_options(args)
    if args.in_place and not args.write_back:
        raise ValueError("--in-place says how --write-back writes; give both")
    if args.results and args.ray is None:
        raise ValueError("--results says where the workers of a cluster write; give --ray, too")
    if args.results and args.write_back:
        raise ValueError("--write-back reads the results in --out; leave --results out")
    return run_batch(args, found, partial(replay, tuple(options)), ["splatnode", "replay", *options])


def replay(options: Sequence[str], recording: BatchRecording, folder: Path) -> Sequence[str]:
    """The command that reconstructs a recording, on whatever machine this is called."""
    return python.command("splatnode", "replay", recording.source, "--out", str(folder), *options)


def run_batch(args: argparse.Namespace, found: list[BatchRecording], work: Work, told_command: list[str]) -> int:
    """Runs `work` for the recordings that have not come to an end, then writes the tables of all.

    `args` has out, resume, retry, cores, max_memory, timeout_s, write_back, in_place, ray, results and json;
    `told_command` is what the ledger says of it.
    Raises ValueError, OtherBatch, OSError.
    """
    running = _run_locally(args, work) if args.ray is None else _run_on_ray(args, work)
    with hold_result_folder(args.out):
        _check_new(args.out, args.resume or args.retry)
        with Ledger(args.out, told_command) as ledger, running as run, show_progress(quiet=args.json) as tell:
            run_again = {None, FAILED} if args.retry else {None}
            todo = [recording for recording in found if ledger.verdict(recording) in run_again]
            if len(todo) < len(found):
                tell(f"{len(found) - len(todo)} of {len(found)} recordings came to an end before")
            for told in _run(todo, run, ledger, tell):
                if not args.json:
                    clear_progress()
                    say(told)
            tell(ProgressStep("writing the tables"))
            counts = _write_tables(args.out, found, ledger, tell)
            all_written = not args.write_back or _write_back(args, ledger.rows(found), tell)
    if args.json:
        print(json.dumps({"recordings": len(found), "verdicts": counts}))
    else:
        say("; ".join(f"{code}: {count}" for code, count in counts.items()))
        say(f"results: {args.out}/ ({PAGE}, {CSV}, {LEDGER}, a folder for each recording)")
    return EXIT_SOME_FAILED if counts.get(FAILED) or not all_written else EXIT_GOOD


@contextlib.contextmanager
def _run_locally(args: argparse.Namespace, work: Work) -> Iterator[Run]:
    plan = Plan(args.out, chosen_cores(args.cores), Limits(args.max_memory, args.timeout_s))
    yield lambda todo: run_all(todo, work, plan)


@contextlib.contextmanager
def _run_on_ray(args: argparse.Namespace, work: Work) -> Iterator[Run]:
    """Raises NoCluster; ValueError where a Ray of this machine has too little memory; ModuleNotFoundError."""
    from splatnode.extras.jobs import ray  # takes a second, and is an extra

    results = args.results or str(args.out.resolve())
    job = Job(work, results, Limits(args.max_memory, args.timeout_s), own_version())
    try:
        with ray.join_cluster(args.ray, None if args.ray else len(chosen_cores(args.cores))):
            remove_leftovers(args.out)
            if (why := remote.shortage(args.max_memory)) is not None and not args.ray:
                raise ValueError(why)
            if why is not None and not args.json:
                say(f"{why}, or recordings wait until one that has joins", error=True)
            yield lambda todo: remote.run_all(todo, job, args.cores)
    finally:
        remove_leftovers(args.out)


def _run(todo: Sequence[BatchRecording], run: Run, ledger: Ledger, tell: Tell) -> Iterator[str]:
    """A line for each recording that has come to its end and has been written down."""
    doing, began_s = "reconstructing", time.monotonic()
    if todo:
        tell(ProgressStep(doing, 0, len(todo), "recording"))
    for done, found in enumerate(run(todo), start=1):
        ledger.append(found)
        step = ProgressStep(doing, done, len(todo), "recording")
        left = "" if is_interactive() else f"{done} of {len(todo)} ({format_times(step, time.monotonic() - began_s)}): "
        yield f"{left}{found.name}: {found.verdict}, {found.seconds:.1f} s{f': {found.message}' * found.has_failed}"
        tell(step)


def _write_back(args: argparse.Namespace, rows: Iterator[Outcome], tell: Tell) -> bool:
    """Whether the cameras lie in or beside all data sets and logs that they are of."""
    tell(ProgressStep("writing the cameras back"))
    written = list(write_back(rows, args.out, args.in_place))
    for each in written:
        tell(each.sentence)
    if not written:
        tell("nothing to write back to: no recording is of a data set or an MCAP file")
    return not any(each.failed for each in written)


def _write_tables(out: Path, found: Sequence[BatchRecording], ledger: Ledger, tell: Tell) -> dict[str, int]:
    """How many recordings have which verdict, the most frequent first; the tables are in the order of these."""
    verdicts = {recording: verdict for recording in found if (verdict := ledger.verdict(recording)) is not None}
    counts = dict(sorted(Counter(verdicts.values()).items(), key=lambda each: (-each[1], each[0])))
    places = {code: place for place, code in enumerate(counts)}
    ended = sorted(verdicts, key=lambda recording: (places[verdicts[recording]], recording.name))
    write_csv(out / CSV, ledger.rows(ended))
    try:
        write_parquet(out / PARQUET, ledger.rows(ended))
    except ModuleNotFoundError as error:
        (out / PARQUET).unlink(missing_ok=True)  # an earlier one, which is not of these recordings
        tell(f"no {PARQUET}: {error.name} is not installed. {remedy(error.name or '')}")
    write_page(out / PAGE, ledger.rows(ended), counts)
    return counts


def _check_new(out: Path, goes_on: bool) -> None:
    """Raises ValueError where `out` holds anything, unless it is a batch that goes on."""
    if (out / LEDGER).exists():
        if not goes_on:
            raise ValueError(f"{out} holds a batch already; --resume goes on with it, or give another --out")
    elif strangers := sorted(path.name for path in out.iterdir() if path.name != LOCK):
        raise ValueError(
            f"--out must be a new or an empty folder, {out} holds {sanitize_text(strangers[0])}; give another"
        )
