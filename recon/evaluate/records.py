"""bench.json: what a benchmark has measured, and on what. Everything that is drawn or told comes from it."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.process.printable import cell
from splatnode.recon.evaluate.json_file import read_json
from splatnode.recon.evaluate.protocol import FAILED, Row, Settings
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.timing import describe_processor
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.report import collect_versions


class Bench(msgspec.Struct, frozen=True):
    rows: tuple[Row, ...]
    settings: Settings
    machine: dict[str, Any]
    command: str
    # How runs are made, the same for all; None in files of older versions, which did not say so
    by_region: bool | None = None
    checkpoints: tuple[int, ...] | None = None
    device: str | None = None
    splits: dict[str, Split] = {}  # by `format_set_name`

    def final_runs(self) -> set[tuple[str, int, str, int]]:
        """The runs (scene, views, method, seed) that have come to their end, or failed."""
        return {make_run_key(row) for row in self.rows if row.final}

    def successful_runs(self) -> set[tuple[str, int, str, int]]:
        """Those that need not be run again: they have not failed."""
        return {make_run_key(row) for row in self.rows if row.final and row.verdict != FAILED}


def make_run_key(row: Row) -> tuple[str, int, str, int]:
    return row.scene, row.views, row.method, row.seed


def format_set_name(scene: str, views: int) -> str:
    return f"{scene}, {views} views"


def read_bench(path: Path) -> Bench:
    """Raises FileNotFoundError, or EvaluationFileError where the file holds something else."""
    return read_json(path, Bench, "the bench.json of a benchmark")


def merge_benches(benches: Sequence[Bench]) -> Bench:
    """The runs of several benchmarks, each run as the last of them has it. Raises ValueError if they scored otherwise.

    Machine and command are all that were named.
    """
    if len({bench.settings for bench in benches}) != 1:
        settings = [dataclasses.asdict(bench.settings) for bench in benches]
        raise ValueError(f"benchmarks can be put together if their views were scored alike, got settings {settings}")
    last = {run: number for number, bench in enumerate(benches) for run in bench.final_runs()}
    rows = tuple(
        row for number, bench in enumerate(benches) for row in bench.rows if last.get(make_run_key(row)) == number
    )
    machine = {key: value for bench in benches for key, value in bench.machine.items()}
    commands = dict.fromkeys(bench.command for bench in benches)
    common: dict[str, Any] = {}
    for name in ("by_region", "checkpoints", "device"):
        told = {getattr(bench, name) for bench in benches}
        common[name] = told.pop() if len(told) == 1 else None
    splits = {key: split for bench in benches for key, split in bench.splits.items()}
    return Bench(rows, benches[0].settings, machine, "; ".join(commands), **common, splits=splits)


def make_bench_files(bench: Bench) -> dict[str, bytes]:
    """bench.json and bench.csv."""
    rows = [dataclasses.asdict(row) for row in bench.rows]  # msgspec leaves out what an older file did not have
    content = {
        "rows": rows,
        "settings": dataclasses.asdict(bench.settings),
        "machine": bench.machine,
        "command": bench.command,
        "by_region": bench.by_region,
        "checkpoints": bench.checkpoints,
        "device": bench.device,
        "splits": {key: dataclasses.asdict(split) for key, split in bench.splits.items()},
    }
    return {"bench.json": json_bytes(content), "bench.csv": _format_csv(rows)}


def describe_machine() -> dict[str, Any]:
    """Describes the machine on which the seconds were measured."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": describe_processor(), "threads": affinity, **collect_versions()}


def _format_csv(records: Sequence[Mapping[str, Any]]) -> bytes:
    """The rows with their seconds and regions as columns of their own; empty where not measured."""
    flat = []
    for record in records:
        seconds = {f"seconds_{stage}": value for stage, value in record["seconds"].items()}
        regions = {
            f"{region}_{measure}": value
            for region, scores in record["regions"].items()
            for measure, value in scores.items()
        }
        plain = {name: value for name, value in record.items() if name not in ("seconds", "regions")}
        flat.append(plain | seconds | regions)
    text = io.StringIO()
    columns = dict.fromkeys(name for row in flat for name in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: cell(value) for name, value in row.items()} for row in flat)
    return text.getvalue().encode()
