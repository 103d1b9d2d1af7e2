"""The benchmark keeps what was measured, shares what methods have in common, and tells of what went wrong."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import pytest

from splatnode.capture.frame import Frame
from splatnode.recon.config import PRESETS, Config
from splatnode.recon.evaluate.bench import Entrants, Plan, Scoring, run_bench
from splatnode.recon.evaluate.process import run_alone
from splatnode.recon.evaluate.protocol import Row, Settings
from splatnode.recon.evaluate.start import Start, continued, find_start, foundation
from splatnode.recon.evaluate.truth import load_scene
from splatnode.recon.optimize.refinement import Config as Optimize
from splatnode.recon.pipeline import reconstruct as pipeline
from splatnode.recon.rasterize.cpu import rasterize
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.blobs import NO_NETWORKS, QUICK, SPLIT, perfect_snapshot, write_scene
from tests.support.synthetic import photographs


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "blobs"
    write_scene(folder)
    return folder


@pytest.fixture
def in_this_process(monkeypatch):
    """Starting a process takes seconds; what is tested with this is not."""
    monkeypatch.setattr("splatnode.recon.evaluate.process.in_own_process", lambda run, given, *_: run(*given))


def reconstruct(frames: Sequence[Frame], method: str, seed: int, start: Start | None = None) -> Iterator[Snapshot]:
    """Stands in for the pipeline, in the benchmark's own processes."""
    assert all(frame.intrinsics is None for frame in frames)
    if method == "broken":
        raise RuntimeError("this method is broken")
    if method == "killed":
        os._exit(7)
    verdict = Verdict(Code.NO_OVERLAP, "No.", "Add views.") if method == "refuses" else perfect_snapshot().verdict
    for iterations in (0, 100, 200, 300):
        final = iterations == 300
        seconds = {"poses": -1.0 if start is None else start.seconds}
        yield replace(
            perfect_snapshot(), verdict=verdict, iterations=iterations, final=final, sequence=seed, seconds=seconds
        )


def bench(plan: Plan, out: Path, *, resume: bool = False, settings: Settings = QUICK, shared: str = "") -> list[Row]:
    """Methods whose names begin with `shared`, if it is given, start from the same cameras and points."""
    entrants = Entrants(reconstruct, lambda name: Config() if shared and name.startswith(shared) else None)
    scoring = Scoring(rasterize, NO_NETWORKS, settings)
    return list(run_bench(plan, entrants, out, scoring=scoring, command="bench", resume=resume).rows)


def test_a_row_a_checkpoint_and_what_was_measured_is_kept(scene_folder, tmp_path):
    plan = Plan((scene_folder,), views=(3,), methods=("exact", "broken"), checkpoints=(50, 150, 100000))
    rows = bench(plan, tmp_path)
    assert [(row.method, row.checkpoint, row.iterations, row.final) for row in rows] == [
        ("exact", 50, 100, False),
        ("exact", 150, 200, False),
        ("exact", None, 300, True),
        ("broken", None, None, True),
    ]
    content = json.loads((tmp_path / "bench.json").read_text())
    assert content["command"] == "bench" and content["machine"]["threads"] >= 1
    assert content["settings"] == {
        "longer_side": 512,
        "alignment_steps": 20,
        "alignment_levels": 1,
        "continued_steps": 60,
        "start": "true",
        "best_gain": False,
    }
    exact, broken = content["rows"][2], content["rows"][3]
    assert exact["psnr"] > 50 and exact["seconds"]["total"] > 0 and exact["peak_rss_mb"] > 10
    assert exact["seconds"]["poses"] == -1.0 and exact["seconds"]["points"] is None
    assert broken["verdict"] == "FAILED" and broken["psnr"] is None and broken["num_gaussians"] is None
    assert "this method is broken" in broken["error"]
    table = list(csv.DictReader((tmp_path / "bench.csv").read_text().splitlines()))
    assert len(table) == 4 and table[3]["psnr"] == "" and float(table[2]["seconds_total"]) > 0
    report = (tmp_path / "report.md").read_text()
    assert "## 3 views" in report and "| exact | 1/1 |" in report and "| broken | 0/1 |" in report
    page = (tmp_path / "report.html").read_text()
    for picture in ("photograph.jpg", "exact-0.jpg"):
        assert (tmp_path / "renders" / "blobs-3" / "01" / picture).read_bytes().startswith(b"\xff\xd8")
        assert f'src="renders/blobs-3/01/{picture}"' in page


def test_an_interrupted_benchmark_goes_on(scene_folder, tmp_path, in_this_process, monkeypatch):
    plan = Plan((scene_folder,), (3,), ("exact",))
    first = bench(plan, tmp_path)
    rows = bench(replace(plan, methods=("exact", "refuses")), tmp_path, resume=True)
    assert rows[:1] == first  # not run again: its seconds are the same
    assert [(row.method, row.verdict, row.psnr) for row in rows[1:]] == [("refuses", "NO_OVERLAP", None)]
    with monkeypatch.context() as patch:
        patch.setattr("splatnode.recon.evaluate.bench._run", None)  # nothing is left to run
        assert bench(replace(plan, methods=("refuses", "exact")), tmp_path, resume=True) == rows
    with pytest.raises(ValueError, match="resume into another folder"):
        bench(plan, tmp_path, resume=True, settings=replace(QUICK, alignment_steps=1))
    assert bench(plan, tmp_path) != first  # without it everything is measured


def test_methods_that_share_cameras_and_points_have_them_found_once(
    scene_folder, tmp_path, monkeypatch, in_this_process
):
    calls = []

    def find(frames: Sequence[Frame], config: Config) -> Start:
        calls.append((len(frames), config.seed))
        return find_start(frames, config)

    monkeypatch.setattr("splatnode.recon.evaluate.bench.find_start", find)
    plan = Plan((scene_folder,), (3,), ("shared-a", "own", "shared-b"), seeds=(4,))
    rows = {row.method: row for row in bench(plan, tmp_path, shared="shared")}
    assert calls == [(3, 4)]
    a, b = (rows[name].seconds["poses"] for name in ("shared-a", "shared-b"))
    assert a == b and a is not None and a > 0 and rows["own"].seconds["poses"] == -1.0
    total = rows["shared-a"].seconds["total"]
    assert total is not None and total >= a  # what was shared counts in the total of each


def test_a_start_that_fails_fails_the_methods_that_need_it(scene_folder, tmp_path, monkeypatch, in_this_process):
    def fail(work: object, timeout_s: float) -> Start:
        raise RuntimeError("out of memory")

    monkeypatch.setattr("splatnode.recon.evaluate.bench.call_alone", fail)
    rows = bench(Plan((scene_folder,), (3,), ("shared", "own")), tmp_path, shared="shared")
    assert [row.verdict for row in rows] == ["FAILED", "OK"] and rows[0].error == "out of memory"


def test_what_goes_on_from_shared_points_is_what_would_have_been_found_alone():
    frames = list(photographs()[:4])
    short = Optimize(iterations=10, checkpoints=(5,))
    config = msgspec.structs.replace(PRESETS["balanced"], size=160, optimize=short, seed=3)
    found = foundation(config)
    assert found == msgspec.structs.replace(Config(), size=160)
    start = find_start(frames, msgspec.structs.replace(found, seed=3))
    alone, shared = list(pipeline(frames, config)), list(continued(start, config))
    assert [s.iterations for s in shared] == [0, 5, 10, 10] and [s.iterations for s in alone] == [0, 0, 5, 10, 10]
    for mine, other in zip(shared, alone[1:], strict=True):  # who begins from the photographs shows a first look
        assert (mine.gaussians.means == other.gaussians.means).all() and mine.final == other.final
    assert shared[0].seconds["total"] >= start.seconds > 0


def test_bench_of_refusals_is_a_result_without_renders(scene_folder, tmp_path, in_this_process):
    rows = bench(Plan((scene_folder,), views=(3,), methods=("refuses",)), tmp_path)
    assert [(row.verdict, row.psnr) for row in rows] == [("NO_OVERLAP", None)]
    assert {path.name for path in tmp_path.iterdir()} == {"bench.json", "bench.csv", "report.md", "report.html"}


def test_process_that_dies_or_takes_too_long_is_told(scene_folder):
    frames = load_scene(scene_folder).frames(SPLIT.train)
    dead = run_alone(partial(reconstruct, frames, "killed", 0), (), timeout_s=60)
    assert dead.snapshots == () and dead.error is not None and "code 7" in dead.error
    late = run_alone(partial(reconstruct, frames, "exact", 0), (), timeout_s=0.05)
    assert late.error == "stopped after 0.05 s"


def test_scene_that_is_not_there_stops_the_bench_before_it_starts(tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold the scene's images"):
        bench(Plan((tmp_path / "absent",), (3,), ("exact",)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
