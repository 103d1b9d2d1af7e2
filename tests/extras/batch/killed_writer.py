"""Batches that write into a log in place and kill themselves on the way: `... OUT LOG CAMERAS SHARE ...`.

CAMERAS is the folder with the result of the log's topic, which is copied in place of a reconstruction. First a batch
comes to its end, twice, and its calls, of whatever functions, are counted once all modules are loaded. Then, for each
SHARE of them, a batch is killed with -9 when it has made so many; and two are killed just after and just before the new
file takes the place of the log. Each finds the log as it was at first, and leaves a copy of it as LOG.0, LOG.1 and so
on. Their exit codes are printed, the first of the whole batch. What the last one had begun stays beside the log.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from splatnode.extras.batch import BatchRecording, command, recordings
from splatnode.extras.batch.command import WriteBackOutcome, write_back
from tests.support.recordings import options

NEVER, BEFORE, AFTER = 0, -1, -2  # moments; any other is the number of a call


def copied(result: str, _: BatchRecording, folder: Path) -> list[str]:
    return ["cp", "-r", result, str(folder)]


class Watched:
    """`write_back` as a batch calls it, which ends the process at its moment."""

    def __init__(self, moment: int) -> None:
        self.moment, self.calls = moment, 0

    def __call__(self, *arguments: Any) -> Iterator[WriteBackOutcome]:
        sys.setprofile(self.look)
        try:
            yield from write_back(*arguments)
        finally:
            sys.setprofile(None)

    def look(self, _: Any, event: str, what: Any) -> None:
        self.calls += 1
        replaces = {"c_call": BEFORE, "c_return": AFTER}.get(event) if what is os.replace else None
        if self.moment and self.moment in (self.calls, replaces):
            os.kill(os.getpid(), signal.SIGKILL)


def run(out: Path, log: Path, result: str, moment: int) -> tuple[int, int]:
    """The exit code of the batch, and how many calls it made while it wrote back."""
    command.write_back = watched = Watched(moment)
    args = options(out, write_back=True, in_place=True, resume=True)
    return command.run_batch(args, recordings([log], None), partial(copied, result), ["act"]), watched.calls


def main() -> None:
    out, log, result, shares = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], map(float, sys.argv[4:])
    before = log.read_bytes()
    run(out, log, result, NEVER)
    log.write_bytes(before)
    code, calls = run(out, log, result, NEVER)
    codes = [code]
    shutil.copy(log, f"{log}.0")
    for number, moment in enumerate([*(1 + int(share * calls) for share in shares), AFTER, BEFORE], start=1):
        log.write_bytes(before)
        child = os.fork()
        if child == 0:
            os._exit(run(out, log, result, moment)[0])
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        shutil.copy(log, f"{log}.{number}")
    print(*codes)


if __name__ == "__main__":
    main()
