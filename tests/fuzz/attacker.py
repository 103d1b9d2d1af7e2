"""The process that reads cases: it tells what each batch came to, and which case it is at, should it end."""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.confined import confined_to
from tests.fuzz.judgement import MOST_MB, MOST_SECONDS, problem_of_refusal, problem_of_value
from tests.fuzz.planted import PLANTED
from tests.fuzz.reproducer import Defect
from tests.support.adversary.boundaries import BOUNDARIES, Boundary, case_of, cases_of

WARM_UP = 40  # cases before the first that counts: they import what is loaded when it is needed
KEPT = 5  # defects of a batch that come with their case; all are counted
_ADDRESS_SPACE = 6 << 30  # bytes, so that what takes all there is does not take the machine's


@dataclass
class Batch:
    """What cases of one boundary came to."""

    boundary: str
    first: int
    cases: int = 0
    refused: int = 0
    accepted: int = 0
    defects: int = 0
    seconds: float = 0.0  # of processor time, with drawing
    slowest_s: float = 0.0  # of reading
    slowest_case: int = -1
    peak_mb: float = 0.0  # above the process itself
    kept: list[Defect] = field(default_factory=list)


class Attacker:
    """Reads cases in a folder of its own, in this process."""

    def __init__(self, folder: Path, at: Any = None) -> None:
        """`at`: shared memory for the number of the case that is being read."""
        self._folder, self._at = folder / "case", at
        self._outside = confined_to(folder)
        self._said = _divert_stderr(folder)
        self._warm: set[str] = set()
        self._idle_mb = 0.0

    def run(self, boundary: Boundary, seed: int, first: int, end: int, until: float = float("inf")) -> Batch:
        """Stops after `end`, or when the clock (time.monotonic) is at `until`."""
        if boundary.name not in self._warm:
            self._warm.add(boundary.name)
            self._batch(boundary, seed, -WARM_UP * (1 + boundary.mutants), 0, float("inf"))
            self._idle_mb = _most_mb()
        return self._batch(boundary, seed, first, end, until)

    def _batch(self, boundary: Boundary, seed: int, first: int, end: int, until: float) -> Batch:
        batch, started, alike = Batch(boundary.name, first), time.process_time(), Counter[str]()
        self._folder.mkdir(mode=0o700, exist_ok=True)
        for number, case in cases_of(boundary, seed, first, end):
            if self._at is not None:
                self._at.value = number
            problem = self._read(boundary, number, case, batch)
            batch.cases += 1
            if problem:
                batch.defects += 1
                defect = Defect(boundary.name, seed, number, problem, case)
                alike[defect.kind] += 1
                if alike[defect.kind] == 1 and len(batch.kept) < KEPT:
                    batch.kept.append(defect)
            if batch.cases % 16 == 0 and time.monotonic() > until:
                break
        self._empty(again=False)
        batch.seconds = time.process_time() - started
        return batch

    def _read(self, boundary: Boundary, number: int, case: Any, batch: Batch) -> str:
        """What is wrong with how the case was taken; empty where nothing is."""
        started = time.process_time()
        problem = ""
        try:
            found = boundary.read(case, self._folder)
            batch.accepted += 1
            problem = problem_of_value(found, boundary.printed)
        except boundary.reader.refusals as error:
            batch.refused += 1
            problem = problem_of_refusal(error)
        except BaseException as error:
            problem = f"{type(error).__name__}: {str(error)[:300]!a} at {_place(error)}"
        took = time.process_time() - started
        if took > batch.slowest_s:
            batch.slowest_s, batch.slowest_case = took, number
        taken = _most_mb() - self._idle_mb
        batch.peak_mb = max(batch.peak_mb, taken)
        if boundary.tidy:
            self._empty()
        if self._outside:
            problem = problem or self._outside[0]
            self._outside.clear()
        said = self._said()
        if problem:
            return problem
        if said:
            return f"said on stderr: {said[:300]!a}"
        if took > MOST_SECONDS:
            return f"took {took:.2f} s of processor time"
        if taken > MOST_MB and self._idle_mb:
            self._idle_mb = _most_mb()
            return f"took {taken:.0f} MB"
        return ""

    def problem_of(self, boundary: Boundary, number: int, case: Any) -> str:
        """Of one case."""
        self._folder.mkdir(mode=0o700, exist_ok=True)
        return self._read(boundary, number, case, Batch(boundary.name, number))

    def _empty(self, again: bool = True) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        if again:
            self._folder.mkdir(mode=0o700, exist_ok=True)


def _most_mb() -> float:
    """The most resident memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _place(error: BaseException) -> str:
    """The innermost line of ours, and that where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "splatnode" in frame.filename] or frames
    places = dict.fromkeys(f"{Path(frame.filename).name}:{frame.lineno}" for frame in (own[-1:] + frames[-1:]))
    return " ".join(places)


def _divert_stderr(folder: Path) -> Any:
    """From now on what is said on stderr, by decoders in C, too, is returned by the function that comes back."""
    path = folder / "stderr"
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(file, 2)
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115 - stays open as long as the process

    def said() -> str:
        size = os.lseek(file, 0, os.SEEK_END)
        if not size:
            return ""
        text = os.pread(file, min(size, 2000), 0).decode(errors="replace")
        os.ftruncate(file, 0)
        return text

    return said


def work(jobs: Any, at: Any) -> None:
    """The child of a campaign: takes (boundary, seed, first, end, until) from a pipe, and sends the batch back."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends it
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("always")
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    known = {boundary.name: boundary for boundary in (*BOUNDARIES, *PLANTED)}
    in_memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=in_memory, ignore_cleanup_errors=True) as folder:
        tempfile.tempdir = folder
        os.chdir(folder)
        attacker = Attacker(Path(folder), at)
        with contextlib.suppress(EOFError):
            while (job := jobs.recv()) is not None:
                name, seed, first, end, until = job
                jobs.send(attacker.run(known[name], seed, first, end, until))
    os._exit(0)  # sockets that are open need not be taken down


def reread(defect: Defect, folder: Path) -> str:
    """What is wrong with how the case of a defect is taken now, in this process; empty where nothing is."""
    (boundary,) = [each for each in (*BOUNDARIES, *PLANTED) if each.name == defect.boundary]
    case = case_of(boundary, defect.seed, defect.number) if defect.case is None else defect.case
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("always")
    tempfile.tempdir, stderr, before = str(folder), os.dup(2), sys.stderr
    try:
        attacker = Attacker(folder)
        attacker.run(boundary, defect.seed, 0, 1)  # loads what is loaded when it is needed
        return attacker.problem_of(boundary, defect.number, case)
    finally:
        logging.disable(logging.NOTSET)
        tempfile.tempdir, sys.stderr = None, before
        os.dup2(stderr, 2)
        os.close(stderr)
