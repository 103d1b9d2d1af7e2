"""`python -m tests.mutants`: puts one small fault after the other into a copy of this checkout, and runs the tests.

    python -m tests.mutants                                   all mutants of tests/mutants/table.py
    python -m tests.mutants --only "a rival model of two cameras is published"
    python -m tests.mutants --room scoring --out out/mutants.json
    python -m tests.mutants --resume                          goes on where out/mutants.json ends
    python -m tests.mutants --whole                           survivors meet all tests that are not long, too

A mutant meets the tests of `./run test` that are near to its file, up to the first that fails: first the one that found
it last time, then those that import or name its module, then those in the folder that mirrors its own. A test that
fails without the mutant, too, does not count. It ends with 1 where more than one mutant of ten survives.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from splatnode.recon.result.export.staged import json_bytes, write_file
from tests.conftest import ROOT
from tests.mutants.copy import Copy, make_copy
from tests.mutants.mutant import Mutant, order_tests
from tests.mutants.table import MUTANTS

RECORD = ROOT / "tests" / "bench" / "results" / "mutants.json"
LEAST_SHARE = 0.9  # of the mutants that tests must find


@dataclass(frozen=True)
class Fate:
    """What became of a mutant."""

    room: str
    name: str
    file: str
    digest: str
    killed: bool
    test: str | None  # that failed; None: none did
    seconds: float
    whole: bool = False  # whether all tests that are not long ran, where none failed


def main(argv: Sequence[str] | None = None) -> int:
    args = _make_parser().parse_args(argv)
    chosen = [each for each in MUTANTS if args.only in (None, each.name) and args.room in (None, each.room)]
    if not chosen:
        names = "\n  ".join(each.name for each in MUTANTS)
        print(f"no mutant {args.only or f'in {args.room}'!r}; there are:\n  {names}", file=sys.stderr)
        return 2
    fates = read_fates(args.out) if args.resume else {}
    killers = {fate.name: fate.test for fate in read_fates(RECORD).values() if fate.test is not None}
    with make_copy(ROOT) as copy:
        trial = Trial(copy, args.seconds, args.whole, killers)
        for mutant in chosen:
            known = fates.get(mutant.digest)
            if known is None or (args.whole and not known.killed and not known.whole):
                fates[mutant.digest] = trial.try_mutant(mutant)
                write_fates(args.out, list(fates.values()), copy.commit)
            print(describe_fate(fates[mutant.digest]), flush=True)
    found = [fates[mutant.digest] for mutant in chosen]
    print("\n".join(summarize(found)))
    return int(sum(fate.killed for fate in found) < LEAST_SHARE * len(found))


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutants", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", metavar="NAME", help="this mutant alone")
    parser.add_argument("--room", metavar="ROOM", help="the mutants of this room alone")
    parser.add_argument("--resume", action="store_true", help="leave out what --out has")
    parser.add_argument("--whole", action="store_true", help="let survivors meet all tests that are not long")
    parser.add_argument("--seconds", type=float, default=600.0, help="for the tests of one mutant (default: 600)")
    parser.add_argument("--out", type=Path, default=Path("out", "mutants.json"), metavar="FILE.json")
    return parser


class Trial:
    """Runs the tests of one mutant after the other, and remembers which of them fail without any."""

    def __init__(self, copy: Copy, timeout_s: float, whole: bool, killers: Mapping[str, str]) -> None:
        self._copy, self._timeout_s, self._whole, self._killers = copy, timeout_s, whole, killers
        self._fails_alone: dict[str, bool] = {}

    def try_mutant(self, mutant: Mutant) -> Fate:
        """What becomes of it; a mutant that makes tests hang survives, since nobody was told."""
        near, others = order_tests(self._copy.folder, mutant.file)
        first = [self._killers[mutant.name]] if mutant.name in self._killers else []
        rounds = [tests for tests in (first, near, others if self._whole else []) if tests]
        spent = 0.0
        for tests in rounds:
            test, seconds = self._find_killer(mutant, tests)
            spent += seconds
            if test is not None:
                return self._make_fate(mutant, test, spent)
        return self._make_fate(mutant, None, spent)

    def _find_killer(self, mutant: Mutant, tests: Sequence[str]) -> tuple[str | None, float]:
        """The first of the tests that fails because of the mutant, and the seconds that they took."""
        tests, spent = [each for each in tests if (self._copy.folder / each.split("::")[0]).exists()], 0.0
        while True:
            known = [test for test, fails in self._fails_alone.items() if fails]
            with self._copy.apply(mutant):
                run = self._copy.run_tests(tests, self._timeout_s - spent, known)
            spent += run.seconds
            if run.failed is None:
                return None, spent
            if run.failed not in self._fails_alone:
                alone = self._copy.run_tests([run.failed], self._timeout_s)
                self._fails_alone[run.failed] = alone.failed is not None
            if not self._fails_alone[run.failed]:
                return run.failed, spent

    def _make_fate(self, mutant: Mutant, test: str | None, seconds: float) -> Fate:
        told = mutant.room, mutant.name, mutant.file, mutant.digest
        return Fate(*told, test is not None, test, round(seconds, 1), self._whole and test is None)


def read_fates(path: Path) -> dict[str, Fate]:
    """The fates that a file has, by the digests of their mutants; none where there is no file."""
    if not path.exists():
        return {}
    return {record["digest"]: Fate(**record) for record in json.loads(path.read_text(encoding="utf-8"))["mutants"]}


def write_fates(path: Path, fates: Sequence[Fate], commit: str) -> None:
    """Writes whole files alone, so that an end at any time loses one mutant."""
    path.parent.mkdir(parents=True, exist_ok=True)
    command = shlex.join(["python", "-m", "tests.mutants", *(arg for arg in sys.argv[1:] if arg != "--resume")])
    told = {"command": command, "commit": commit, "cpus": len(os.sched_getaffinity(0))}
    write_file(path, json_bytes({**told, "mutants": [asdict(fate) for fate in fates]}))


def describe_fate(fate: Fate) -> str:
    """One line, such as `killed    4.2 s  scoring: the last pose, not the best  (tests/...)`."""
    by = f"  ({fate.test})" if fate.test is not None else ""
    return f"{'killed  ' if fate.killed else 'SURVIVED'} {fate.seconds:6.1f} s  {fate.room}: {fate.name}{by}"


def summarize(fates: Sequence[Fate]) -> list[str]:
    """Lines of a table: how many of the mutants of each room the tests found."""
    rooms = dict.fromkeys(fate.room for fate in fates)
    lines = []
    for room in rooms:
        own = [fate for fate in fates if fate.room == room]
        lines.append(f"{room:14} {sum(fate.killed for fate in own)} of {len(own)} killed")
    return [*lines, f"{'all':14} {sum(fate.killed for fate in fates)} of {len(fates)} killed"]


if __name__ == "__main__":
    sys.exit(main())
