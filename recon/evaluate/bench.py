"""The benchmark: every method on every scene, each run in a process of its own so that its time and memory are its own.

The reconstruction is an argument, `reconstruct(frames, method, seed) -> Iterator[Snapshot]`; it is sent to the new
process, so it must be a function of a module (or a functools.partial of one).
"""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import logging
import multiprocessing
import os
import pickle
import platform
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.frame import Frame
from recon.evaluate.appearance import Rasterize
from recon.evaluate.protocol import STAGES, Networks, Row, Run, Settings, evaluate
from recon.evaluate.splits import Split, load_split
from recon.evaluate.summary import markdown
from recon.evaluate.truth import EvaluationScene, load_scene
from recon.export.staged import json_bytes, write_file, write_files
from recon.report import peak_rss_mb, versions
from recon.snapshot import Snapshot

Reconstruct = Callable[[Sequence[Frame], str, int], Iterator[Snapshot]]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """What is run. `checkpoints` are iterations at which a run is scored on its way, besides its end."""

    scenes: tuple[Path, ...]
    views: tuple[int, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    checkpoints: tuple[int, ...] = ()
    timeout_s: float = 3600.0  # of one run


def run_bench(
    plan: Plan,
    reconstruct: Reconstruct,
    out_dir: Path,
    *,
    rasterize: Rasterize,
    networks: Networks,
    settings: Settings,
    command: str,
) -> list[Row]:
    """Runs the plan and returns its rows.

    bench.json, bench.csv and report.md are rewritten after every row, so an
    interrupted benchmark keeps what it has measured; the charts are drawn at the end.

    A run that fails, or exceeds the time, becomes a row with the verdict "FAILED" and the reason. Raises ValueError or
    FileNotFoundError for a scene or split that is not there, before anything is run.
    """
    scenes = [(load_scene(folder), folder) for folder in plan.scenes]
    jobs = [
        (scene, load_split(folder, list(scene.paths), views), method, seed)
        for (scene, folder), views, method, seed in itertools.product(scenes, plan.views, plan.methods, plan.seeds)
    ]
    rows: list[Row] = []
    for number, (scene, split, method, seed) in enumerate(jobs, 1):
        outcome = run_alone(reconstruct, scene.frames(split.train), method, seed, plan.checkpoints, plan.timeout_s)
        for moment in outcome.moments:
            run = Run(method, seed, moment.checkpoint, moment.seconds, moment.peak_rss_mb)
            rows.append(
                evaluate(moment.snapshot, scene, split, run, rasterize=rasterize, networks=networks, settings=settings)
            )
            write_bench(rows, settings, out_dir, command)
        if outcome.error is not None:
            rows.append(_failed_row(scene, split, method, seed, outcome.error))
            write_bench(rows, settings, out_dir, command)
        logger.info("bench %d/%d: %s, %d views, %s, seed %d: %s", number, len(jobs), *_told(rows[-1]))
    _draw_charts(rows, out_dir)
    return rows


def _draw_charts(rows: Sequence[Row], out_dir: Path) -> None:
    """speed_accuracy.png and parsimony.png, where there is a score to draw and matplotlib to draw it."""
    if all(row.psnr is None for row in rows):
        logger.warning("no charts: no run published a scene that could be scored")
        return
    try:
        from recon.evaluate import charts
    except ImportError:
        logger.warning("no charts: matplotlib is not installed. Run: pip install 'splatnode[bench]'")
        return
    charts.draw(out_dir / "bench.json", out_dir)


def write_bench(rows: Sequence[Row], settings: Settings, out_dir: Path, command: str) -> None:
    """bench.json, bench.csv and report.md, all or none of them."""
    records = [dataclasses.asdict(row) for row in rows]
    content = {
        "rows": records,
        "settings": dataclasses.asdict(settings),
        "machine": machine(),
        "command": command,
    }
    files = {"bench.json": json_bytes(content), "bench.csv": _csv(records), "report.md": markdown(content).encode()}
    write_files(out_dir, files)


def machine() -> dict[str, object]:
    """What the seconds were measured on."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": _processor(), "threads": affinity, **versions()}


@dataclass(frozen=True, eq=False)
class Moment:
    """A snapshot that is to be scored, with what the run had cost by then."""

    snapshot: Snapshot
    checkpoint: int | None  # None: the end of the run
    seconds: Mapping[str, float | None]
    peak_rss_mb: float | None


@dataclass(frozen=True, eq=False)
class Outcome:
    moments: tuple[Moment, ...]
    seconds: float  # wall time of the whole process
    error: str | None


def run_alone(
    reconstruct: Reconstruct,
    frames: Sequence[Frame],
    method: str,
    seed: int,
    checkpoints: Sequence[int],
    timeout_s: float,
) -> Outcome:
    """One reconstruction in a fresh process. The clock runs only while the reconstruction works, not while it is saved.

    The process leaves its moments in a temporary folder and they are read once it has ended, so that nothing else works
    on this machine's processors meanwhile.
    """
    context = multiprocessing.get_context("spawn")
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="splatnode-bench-") as folder:
        arguments = (reconstruct, frames, method, seed, tuple(checkpoints), folder)
        process = context.Process(target=_run_and_save, args=arguments)
        process.start()
        try:
            process.join(timeout_s)
            timed_out = process.is_alive()
        finally:
            if process.is_alive():
                process.kill()
                process.join()
        seconds = time.perf_counter() - started
        moments = tuple(pickle.loads(path.read_bytes()) for path in sorted(Path(folder).glob("*.moment")))
        told = Path(folder) / "error.txt"
        if timed_out:
            error = f"stopped after {timeout_s:g} s"
        elif told.exists():
            error = told.read_text()
        elif process.exitcode != 0:
            error = f"the process ended with code {process.exitcode}; -9 mostly means that the memory was used up"
        else:
            error = None if moments else "the reconstruction gave no snapshot"
    return Outcome(moments, seconds, error)


def _run_and_save(
    reconstruct: Reconstruct, frames: Sequence[Frame], method: str, seed: int, checkpoints: Sequence[int], folder: str
) -> None:
    """The other process: saves the first snapshot at or beyond each checkpoint, and the last of all."""
    try:
        waiting = sorted(checkpoints)
        seconds, saved, snapshot = 0.0, 0, None
        started = time.perf_counter()
        for snapshot in reconstruct(frames, method, seed):
            seconds += time.perf_counter() - started
            while waiting and snapshot.iterations >= waiting[0]:
                checkpoint = waiting.pop(0)
                if not waiting or snapshot.iterations < waiting[0]:
                    _save(folder, saved, snapshot, checkpoint, seconds)
                    saved += 1
            started = time.perf_counter()
        seconds += time.perf_counter() - started
        if snapshot is not None:
            _save(folder, saved, snapshot, None, seconds)
    except Exception:
        write_file(Path(folder) / "error.txt", traceback.format_exc().encode())


def _save(folder: str, number: int, snapshot: Snapshot, checkpoint: int | None, total: float) -> None:
    peak = peak_rss_mb()
    stages: dict[str, float | None] = {stage: snapshot.seconds.get(stage) for stage in STAGES}
    moment = Moment(snapshot, checkpoint, {**stages, "total": total}, peak)
    write_file(Path(folder) / f"{number:04d}.moment", pickle.dumps(moment))


def _failed_row(scene: EvaluationScene, split: Split, method: str, seed: int, error: str) -> Row:
    return Row(
        scene=scene.name,
        views=len(split.train),
        method=method,
        seed=seed,
        checkpoint=None,
        final=True,
        seconds={**dict.fromkeys(STAGES), "total": None},
        peak_rss_mb=None,
        verdict="FAILED",
        error=error,
    )


def _told(row: Row) -> tuple[str, int, str, int, str]:
    score = "not scored" if row.psnr is None else f"{row.psnr:.2f} dB"
    return row.scene, row.views, row.method, row.seed, f"{row.verdict}, {score}, {row.seconds.get('total')} s"


def _csv(records: Sequence[Mapping]) -> bytes:
    """The rows with their seconds as columns of their own; empty where not measured."""
    flat = []
    for record in records:
        seconds = {f"seconds_{stage}": value for stage, value in record["seconds"].items()}
        flat.append({name: value for name, value in record.items() if name != "seconds"} | seconds)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(flat[0]) if flat else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue().encode()


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
