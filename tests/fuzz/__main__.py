"""`./run fuzz`: attacks everything that reads, interrupts every write, besieges a node; by night, before a release.

    ./run fuzz                                    all campaigns; 5 000 000 cases over all boundaries
    ./run fuzz --seconds 900 --only boundaries    a quarter of an hour of cases
    ./run fuzz --replay out/fuzz/scene_ply-0-17.json

It ends with 1 where there is a defect. Each is a file in out/fuzz, with the command that shows it again. Ctrl-C ends
the run with what there is.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.conftest import ROOT
from tests.fuzz import boundaries, catalogue, reproducer, table

DEFECTS = Path("out", "fuzz")
_SECONDS = 3600.0  # of a campaign at most, unless told


def main(argv: list[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    if args.replay is not None:
        return replay(args.replay)
    chosen = [args.only] if args.only else list(catalogue.NAMES)
    absent = [name for name in chosen if name in catalogue.missing()]
    if absent:
        print(f"not in this checkout: {', '.join(absent)}", file=sys.stderr)
    results: dict[str, dict[str, Any]] = {}
    interrupted = False
    for name, module in catalogue.campaigns().items():
        if name not in chosen or interrupted:
            continue
        try:
            results[name] = _run(name, module, args)
        except KeyboardInterrupt:
            results[name] = {"defects": 0, "interrupted": True}
        interrupted = bool(results[name].get("interrupted"))
    return _tell(results, args, interrupted)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="./run fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=_SECONDS, help="that each campaign lasts at most")
    parser.add_argument("--cases", type=int, default=boundaries.CASES, help="over all boundaries, by their shares")
    parser.add_argument("--seed", type=int, default=0, help="another one draws other cases")
    parser.add_argument("--only", choices=catalogue.NAMES, help="this campaign alone")
    parser.add_argument("--boundary", nargs="+", default=[], metavar="NAME", help="of the boundaries these alone")
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER", help="of the first case of each boundary")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="counts as JSON")
    parser.add_argument("--defects", type=Path, default=DEFECTS, metavar="FOLDER", help="for reproducers")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="reads the case of a reproducer again")
    return parser


def _run(name: str, module: Any, args: argparse.Namespace) -> dict[str, Any]:
    if name != "boundaries":
        print(f"{name} ...", file=sys.stderr, flush=True)
        return module.main(args.seconds, args.seed)
    known = {each.name for each in boundaries.BOUNDARIES}
    if wrong := [each for each in args.boundary if each not in known]:
        raise SystemExit(f"no boundary {', '.join(wrong)}; there are: {', '.join(sorted(known))}")
    progress = _Progress(args.cases, _Saver(args.defects, _commit()))
    return module.main(args.seconds, args.seed, args.cases, args.boundary, progress, args.first)


class _Saver:
    """Writes the reproducer of each defect as soon as it is known: a night's run may be killed."""

    def __init__(self, folder: Path, commit: str) -> None:
        self._folder, self._commit = folder, commit
        self._saved: set[tuple[str, int]] = set()

    def __call__(self, rows: dict[str, boundaries.Row]) -> None:
        for defect in (defect for row in rows.values() for defect in row.kept):
            if (case := (defect.boundary, defect.number)) not in self._saved:
                self._saved.add(case)
                path = reproducer.save(defect, self._folder, self._commit)
                print(f"\n{_describe(defect, path)}", file=sys.stderr, flush=True)


def _describe(defect: reproducer.Defect, path: Path) -> str:
    return f"{defect.boundary}, case {defect.number}: {defect.problem}\n  {reproducer.REPLAY} {path}"


class _Progress:
    """One line that is written over, or on no terminal one every half minute; defects as they come."""

    def __init__(self, cases: int, save: _Saver) -> None:
        self._cases, self._save, self._started, self._told = cases, save, time.monotonic(), 0.0
        self._pace_s = 0.5 if sys.stderr.isatty() else 30.0

    def __call__(self, rows: dict[str, boundaries.Row]) -> None:
        self._save(rows)
        now = time.monotonic()
        if now < self._told + self._pace_s:
            return
        self._told = now
        done, defects = (sum(getattr(row, name) for row in rows.values()) for name in ("cases", "defects"))
        text = f"boundaries: {done} of {self._cases} cases, {defects} defects, {now - self._started:.0f} s"
        print(
            f"\r{text}\033[K" if sys.stderr.isatty() else text, end="" if sys.stderr.isatty() else "\n", file=sys.stderr
        )
        sys.stderr.flush()


def _tell(results: dict[str, dict[str, Any]], args: argparse.Namespace, interrupted: bool) -> int:
    if sys.stderr.isatty():
        print(file=sys.stderr)
    commit = _commit()
    for defect in results.get("boundaries", {}).pop("kept", []):
        print(_describe(defect, reproducer.save(defect, args.defects, commit)))
    print("\n".join(table.lines(results)))
    if args.out is not None:
        told = {"command": shlex.join(["./run", "fuzz", *sys.argv[1:]]), "seed": args.seed, "commit": commit}
        told |= {"cpus": len(os.sched_getaffinity(0)), "load_average": os.getloadavg()[0], "campaigns": results}
        args.out.write_text(json.dumps(told, indent=1) + "\n")
    if interrupted:
        return 130
    return int(any(_count(result.get("defects", 0)) for result in results.values()))


def _count(defects: Any) -> int:
    return defects if isinstance(defects, int) else len(defects)


def _commit() -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return found.stdout.strip()


def replay(path: Path) -> int:
    """Reads the case of a reproducer in this process; 1 where its defect is still there."""
    from tests.fuzz.attacker import reread

    defect = reproducer.load(path)
    with tempfile.TemporaryDirectory() as folder:
        problem = reread(defect, Path(folder))
    print(f"{defect.boundary}, case {defect.number}: {problem or 'read or refused as it should be'}")
    return int(bool(problem))


if __name__ == "__main__":
    sys.exit(main())
