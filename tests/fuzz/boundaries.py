"""Malformed input for everything that reads any: structured cases, in two processes, with one judgement for all.

Each boundary gets its share of the cases, batch by batch, so that a run that is cut short has attacked all of them. A
process that ends or hangs is a defect of the case that it was at; another one goes on behind it.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from tests.fuzz.attacker import Batch, work
from tests.fuzz.planted import PLANTED
from tests.fuzz.reproducer import Defect
from tests.support.adversary.boundaries import BOUNDARIES, Boundary

PROCESSES = 2
CASES = 5_000_000
BATCH_S = 2.0  # that a batch lasts, about
_FIRST = 32  # cases of a boundary's first batch, which tells how long one takes
_TURNS = 20  # in which a boundary has its share, at least
_HANGS_S = 120.0  # without an answer, beyond what a batch may last: much longer than any case may take
_ALIKE = 3  # defects of a boundary that are kept of one kind; all are counted


@dataclass
class Row:
    """What one boundary's cases came to."""

    cases: int = 0
    refused: int = 0
    accepted: int = 0
    defects: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    slowest_case: int = -1
    peak_mb: float = 0.0
    next: int = 0  # number of the first case that nobody has begun
    kept: list[Defect] = field(default_factory=list)

    def add(self, batch: Batch) -> None:
        for name in ("cases", "refused", "accepted", "defects", "seconds"):
            setattr(self, name, getattr(self, name) + getattr(batch, name))
        if batch.slowest_s > self.slowest_s:
            self.slowest_s, self.slowest_case = batch.slowest_s, batch.slowest_case
        self.peak_mb = max(self.peak_mb, batch.peak_mb)
        for defect in batch.kept:
            if sum(defect.kind == each.kind for each in self.kept) < _ALIKE:
                self.kept.append(defect)

    def record(self) -> dict[str, Any]:
        """Without the cases themselves."""
        told = {name: each for name, each in vars(self).items() if name not in ("kept", "next")}
        for name in ("seconds", "slowest_s", "peak_mb"):
            told[name] = round(told[name], 4)
        return told


Tell = Callable[[dict[str, Row]], None]


def main(
    seconds: float,
    seed: int,
    cases: int = CASES,
    names: Sequence[str] = (),
    tell: Tell = lambda rows: None,
    first: int = 0,
) -> dict[str, Any]:
    """Attacks until there were so many cases, or the time is up; all boundaries, or those of these names.

    The result has a row for each, and all defects that are kept. An interrupt ends it early with what there is.
    """
    chosen = [each for each in (*BOUNDARIES, *PLANTED) if (each.name in names if names else each in BOUNDARIES)]
    rows = {each.name: Row(next=first) for each in chosen}
    whole = sum(each.share for each in chosen)
    quotas = {each.name: max(1, round(cases * each.share / whole)) for each in chosen}
    started, interrupted = time.monotonic(), False
    attackers = [_Attacker() for _ in range(PROCESSES)]
    try:
        _attack(attackers, chosen, rows, quotas, seed, started + seconds, tell, first)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        for attacker in attackers:
            attacker.end()
    return {
        "cases": sum(row.cases for row in rows.values()),
        "defects": sum(row.defects for row in rows.values()),
        "seconds": round(time.monotonic() - started, 1),
        "interrupted": interrupted,
        "rows": {name: row.record() for name, row in rows.items()},
        "kept": [defect for row in rows.values() for defect in row.kept],
    }


def _attack(
    attackers: Sequence[_Attacker],
    chosen: Sequence[Boundary],
    rows: dict[str, Row],
    quotas: dict[str, int],
    seed: int,
    until: float,
    tell: Tell,
    first: int,
) -> None:
    """Gives each process that is free a batch of the boundary that is farthest behind its share."""
    while True:
        for attacker in attackers:
            open_ = [each for each in chosen if rows[each.name].next - first < quotas[each.name]]
            if attacker.job is None and open_ and time.monotonic() < until:
                behind = min(open_, key=lambda each: (rows[each.name].next - first) / quotas[each.name])
                row = rows[behind.name]
                end = min(row.next + _batch_size(row, quotas[behind.name]), first + quotas[behind.name])
                attacker.give(behind.name, seed, row.next, end, until)
                row.next = end
        if all(attacker.job is None for attacker in attackers):
            return
        for attacker in attackers:
            for batch in attacker.take():
                rows[batch.boundary].add(batch)
        tell(rows)


def _batch_size(row: Row, quota: int) -> int:
    """How many cases last BATCH_S, as far as is known, and a small part of them all: no boundary waits for another."""
    known = int(BATCH_S * row.cases / max(row.seconds, 1e-6))
    return _FIRST if not row.cases else max(8, min(known, quota // _TURNS))


class _Attacker:
    """A process that attacks, and the one that takes its place after it was lost."""

    def __init__(self) -> None:
        self.job: tuple[str, int, int, int, float] | None = None
        self._begin()

    def _begin(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._at = spawn.Value("q", -1, lock=False)
        self._link, theirs = spawn.Pipe()
        self._process = spawn.Process(target=work, args=(theirs, self._at), daemon=True)
        self._process.start()
        theirs.close()

    def give(self, name: str, seed: int, first: int, end: int, until: float) -> None:
        self.job = (name, seed, first, end, until)
        self._at.value = first
        self._given, self._seen = time.monotonic(), (first, time.monotonic())
        self._link.send(self.job)

    def take(self) -> list[Batch]:
        """What has come, waiting a moment for it; of a process that was lost, its defect."""
        if self.job is None:
            return []
        try:
            if self._link.poll(0.1):
                batch, self.job = self._link.recv(), None
                return [batch]
        except (EOFError, ConnectionResetError):
            self._process.join(5)
            return [self._lost(f"the process ended with {self._process.exitcode}")]
        if self._at.value != self._seen[0]:
            self._seen = self._at.value, time.monotonic()
        if time.monotonic() - self._seen[1] > _HANGS_S:
            return [self._lost(f"no answer for {_HANGS_S:g} s")]
        return []

    def _lost(self, why: str) -> Batch:
        """The batch as far as it went; its last case is the defect. The rest of it is left out."""
        name, seed, first, _, _ = self.job or ("", 0, 0, 0, 0.0)
        number = self._at.value
        self.end()
        self.job = None
        self._begin()
        return Batch(name, first, cases=max(1, number - first + 1), defects=1, kept=[Defect(name, seed, number, why)])

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self._link.close()
