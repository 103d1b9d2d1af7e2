"""The benchmark keeps what was measured, shares what methods have in common, and tells of what went wrong."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import msgspec
import pytest

from splatnode.capture.frame import Frame
from splatnode.command_line import build_parser
from splatnode.extras.evaluate.methods import Start, continue_reconstruction, extract_start_config, find_start
from splatnode.extras.evaluate.protocol import Row, Settings, create_empty_networks
from splatnode.extras.evaluate.report import explain_missing_seconds
from splatnode.extras.evaluate.runner import MethodRunner, Plan, PlannedRun, Scoring, format_run, run_bench
from splatnode.extras.jobs import ALONE, Engine, Limits, engine, usable_cores
from splatnode.recon.config import PRESETS, ReconstructionConfig
from splatnode.recon.optimize.training import RefinementConfig as Optimize
from splatnode.recon.pipeline import reconstruct as pipeline
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.blobs import QUICK, perfect_snapshot, write_scene
from tests.support.calls import in_this_process
from tests.support.synthetic import photographs


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "blobs"
    write_scene(folder)
    return folder


@pytest.fixture
def alone(monkeypatch):
    """Other work on this machine is not seen, so that all seconds are reported."""
    monkeypatch.setattr("splatnode.extras.evaluate.report.others_share", lambda since, until: 0.0)


def reconstruct(frames: Sequence[Frame], method: str, seed: int, start: Start | None = None) -> Iterator[Snapshot]:
    """Stands in for the pipeline, in the benchmark's own processes."""
    assert all(frame.intrinsics is None for frame in frames)
    if method == "broken":
        raise RuntimeError("this method is broken")
    if method == "killed":
        os._exit(7)
    if method == "hangs":
        time.sleep(600)
    verdict = Verdict(Code.NO_OVERLAP, "No.", "Add views.") if method == "refuses" else perfect_snapshot().verdict
    for iterations in (0, 100, 200, 300):
        final = iterations == 300
        seconds = {"poses": -1.0 if start is None else start.seconds}
        if method == "odd" and final:
            seconds["poses"] = math.nan
        yield replace(
            perfect_snapshot(), verdict=verdict, iterations=iterations, final=final, sequence=seed, seconds=seconds
        )


def without_costs(row: Row) -> Row:
    """What of a row is the same each time."""
    return replace(row, seconds={}, peak_rss_mb=None, cores=None, processor=None, others=None)


def shared_by(beginning: str) -> Callable[[str], ReconstructionConfig | None]:
    """Methods whose names begin so start from the same cameras and points."""
    return lambda name: ReconstructionConfig() if beginning and name.startswith(beginning) else None


def bench(
    plan: Plan,
    out: Path,
    *,
    resume: bool = False,
    settings: Settings = QUICK,
    shared: str = "",
    on: Engine | None = None,
    by_region: bool = False,
    device: str = "cpu",
) -> list[Row]:
    """Methods whose names begin with `shared`, if it is given, start from the same cameras and points."""
    entrants = MethodRunner(reconstruct, shared_by(shared), device)
    scoring = Scoring(rasterize_on_cpu, create_empty_networks, settings, by_region)
    on = on or in_this_process()
    return list(run_bench(plan, entrants, out, scoring=scoring, command="bench", resume=resume, engine=on).rows)


def test_a_row_a_checkpoint_and_what_was_measured_is_kept(scene_folder, tmp_path):
    plan = Plan((scene_folder,), views=(3,), methods=("exact", "broken", "killed"), checkpoints=(50, 150, 100000))
    with engine(1, None) as on:
        rows = bench(plan, tmp_path, on=on)
    assert [(row.method, row.checkpoint, row.iterations, row.final) for row in rows] == [
        ("exact", 50, 100, False),
        ("exact", 150, 200, False),
        ("exact", None, 300, True),
        ("broken", None, None, True),
        ("killed", None, None, True),
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
    exact, broken, killed = content["rows"][2:]
    assert exact["psnr"] > 50 and exact["peak_rss_mb"] > 10
    assert exact["cores"] == 1 and exact["processor"] == content["machine"]["processor"]
    reported = exact["others"] is None or exact["others"] <= ALONE
    assert (exact["seconds"]["total"] is not None) == (exact["seconds"]["poses"] == -1.0) == reported
    assert exact["seconds"]["points"] is None
    assert killed["verdict"] == "FAILED" and killed["error"] == "ended with exit code 7 and said nothing"
    assert broken["verdict"] == "FAILED" and broken["psnr"] is None and broken["num_gaussians"] is None
    assert "this method is broken" in broken["error"]
    table = list(csv.DictReader((tmp_path / "bench.csv").read_text().splitlines()))
    assert len(table) == 5 and table[3]["psnr"] == "" and table[2]["seconds_total"] == _text(exact["seconds"]["total"])
    report = (tmp_path / "report.md").read_text()
    assert "## 3 views" in report and "| exact | 1/1 |" in report and "| broken | 0/1 |" in report
    page = (tmp_path / "report.html").read_text()
    for picture in ("photograph.jpg", "exact-0.jpg"):
        assert (tmp_path / "renders" / "blobs-3" / "01" / picture).read_bytes().startswith(b"\xff\xd8")
        assert f'src="renders/blobs-3/01/{picture}"' in page


def _text(seconds: float | None) -> str:
    return "" if seconds is None else str(seconds)


def test_a_run_that_hangs_costs_only_itself(scene_folder, tmp_path):
    with engine(1, None) as on:
        (row,) = bench(Plan((scene_folder,), (3,), ("hangs",), timeout_s=1.0), tmp_path, on=on)
    assert (row.verdict, row.error) == ("FAILED", "took longer than the 1 s that --timeout-s allows")


def test_a_number_that_is_not_finite_costs_only_its_run(scene_folder, tmp_path, alone):
    plan = Plan((scene_folder,), (3,), ("odd", "exact"), checkpoints=(150,))
    rows = bench(plan, tmp_path)
    assert [(row.method, row.checkpoint, row.verdict) for row in rows] == [
        ("odd", 150, "OK"),
        ("odd", None, "FAILED"),
        ("exact", 150, "OK"),
        ("exact", None, "OK"),
    ]
    assert rows[1].error == "seconds is not finite at the end"
    assert json.loads((tmp_path / "bench.json").read_text())["rows"][1]["psnr"] is None


def test_an_interrupted_benchmark_goes_on(scene_folder, tmp_path, alone):
    plan = Plan((scene_folder,), (3,), ("exact",))
    first = bench(plan, tmp_path)
    rows = bench(replace(plan, methods=("exact", "refuses")), tmp_path, resume=True)
    assert rows[:1] == first  # not run again: its seconds are the same
    assert first[0].seconds["total"] is not None and first[0].others == 0.0
    assert [(row.method, row.verdict, row.psnr) for row in rows[1:]] == [("refuses", "NO_OVERLAP", None)]
    again = bench(
        replace(plan, methods=("refuses", "exact")), tmp_path, resume=True, on=nothing_is_left(first[0].cores)
    )
    assert again == rows
    with pytest.raises(ValueError, match="resume into another folder"):
        bench(plan, tmp_path, resume=True, settings=replace(QUICK, alignment_steps=1))
    with pytest.raises(ValueError, match="now each would have 99 cores, and their seconds would be mixed"):
        bench(plan, tmp_path, resume=True, on=in_this_process(cores_each=99))
    assert bench(plan, tmp_path) != first  # without it everything is measured


def test_what_failed_is_run_again_when_a_benchmark_goes_on(scene_folder, tmp_path, monkeypatch, alone):
    plan = Plan((scene_folder,), (3,), ("shared", "exact", "broken"), checkpoints=(150,))

    def fail(frames: object, config: object) -> Start:
        raise RuntimeError("no memory was left")

    with monkeypatch.context() as patch:
        patch.setattr("splatnode.extras.evaluate.runner.find_start", fail)
        first = bench(plan, tmp_path, shared="shared")
    ends = [("shared", None, "FAILED"), ("exact", 150, "OK"), ("exact", None, "OK"), ("broken", None, "FAILED")]
    assert [(row.method, row.checkpoint, row.verdict) for row in first] == ends
    other = bench(replace(plan, methods=("exact",)), tmp_path, resume=True, on=nothing_is_left(first[1].cores))
    assert other == first  # what failed is not of this plan
    shutil.copytree(tmp_path, tmp_path / "killed")
    content = json.loads((tmp_path / "killed" / "bench.json").read_text())
    journal = [[row] for row in content["rows"] if row["method"] == "broken"]
    (tmp_path / "killed" / "bench.json").write_text(json.dumps(content | {"rows": []}))
    (tmp_path / "killed" / "bench.jsonl").write_text("".join(f"{json.dumps(rows)}\n" for rows in journal))
    for out in (tmp_path, tmp_path / "killed"):
        rows = bench(replace(plan, methods=("shared", "exact")), out, shared="shared", resume=True)
        verdicts = {(row.method, row.checkpoint, row.verdict) for row in rows}
        assert verdicts == {
            ("broken", None, "FAILED"),
            *((name, at, "OK") for name in ("shared", "exact") for at in (150, None)),
        }
        assert len(rows) == 5


def test_a_benchmark_goes_on_as_it_began(scene_folder, tmp_path, alone):
    here = tmp_path / scene_folder.name
    shutil.copytree(scene_folder, here)
    shutil.copy(scene_folder.parent / "splits.json", tmp_path)
    plan, out = Plan((here,), (3,), ("refuses",), checkpoints=(300, 150)), tmp_path / "out"
    first = bench(plan, out)
    content = json.loads((out / "bench.json").read_text())
    assert (content["by_region"], content["checkpoints"], content["device"]) == (False, [150, 300], "cpu")
    with pytest.raises(ValueError, match="holds runs with by_region False, now True"):
        bench(plan, out, resume=True, by_region=True)
    with pytest.raises(ValueError, match=r"holds runs with checkpoints \(150, 300\), now \(150,\)"):
        bench(replace(plan, checkpoints=(150,)), out, resume=True)
    with pytest.raises(ValueError, match="holds runs with device cpu, now cuda"):
        bench(plan, out, resume=True, device="cuda")
    splits = json.loads((tmp_path / "splits.json").read_text())
    splits["blobs"]["train3"][0] = "02.png"
    (tmp_path / "splits.json").write_text(json.dumps(splits))
    with pytest.raises(ValueError, match="holds runs of blobs, 3 views, with another split"):
        bench(plan, out, resume=True)
    assert json.loads((out / "bench.json").read_text()) == content
    for name in ("by_region", "checkpoints", "device", "splits"):
        del content[name]  # an older version did not say so
    (out / "bench.json").write_text(json.dumps(content))
    assert bench(plan, out, resume=True, on=nothing_is_left(first[0].cores)) == first


def nothing_is_left(cores: int) -> Engine:
    def answers(take, limits: Limits, folder: Path):
        assert take() is None
        yield from ()

    return Engine(cores, answers)


def test_a_driver_that_is_killed_loses_no_run_that_ended(scene_folder, tmp_path, alone):
    plan, here = Plan((scene_folder,), (3,), ("exact", "shared-a", "shared-b", "refuses")), in_this_process()
    methods = []

    def answers(take, limits: Limits, folder: Path):
        for about, answer in here.answers(take, limits, folder):
            if isinstance(about, PlannedRun) and about.about.method == "shared-b":
                shutil.copytree(tmp_path / "out", tmp_path / "killed")  # what is on the disk as this run works
            yield about, answer

    def noted(take, limits: Limits, folder: Path):
        for about, answer in here.answers(take, limits, folder):
            methods.append(about.about.method if isinstance(about, PlannedRun) else "start")
            yield about, answer

    whole = bench(plan, tmp_path / "out", shared="shared", on=Engine(here.cores_each, answers))
    (tmp_path / "killed" / ".splatnode.lock").unlink()  # of a process that still lives
    resumed = bench(plan, tmp_path / "killed", shared="shared", on=Engine(here.cores_each, noted), resume=True)
    assert methods == ["start", "shared-b", "refuses"]
    assert resumed[:2] == whole[:2] and [row.method for row in resumed] == list(plan.methods)
    assert {path.name for path in (tmp_path / "killed").iterdir()} == {
        path.name for path in (tmp_path / "out").iterdir()
    }


def test_methods_that_share_cameras_and_points_have_them_found_once(scene_folder, tmp_path, monkeypatch, alone):
    calls = []

    def find(frames: Sequence[Frame], config: ReconstructionConfig) -> Start:
        calls.append((len(frames), config.seed))
        return find_start(frames, config)

    monkeypatch.setattr("splatnode.extras.evaluate.runner.find_start", find)
    plan = Plan((scene_folder,), (3,), ("shared-a", "own", "shared-b"), seeds=(4,))
    rows = {row.method: row for row in bench(plan, tmp_path, shared="shared")}
    assert calls == [(3, 4)] and list(rows) == ["shared-a", "own", "shared-b"]
    a, b = (rows[name].seconds["poses"] for name in ("shared-a", "shared-b"))
    assert a == b and a is not None and a > 0 and rows["own"].seconds["poses"] == -1.0
    total = rows["shared-a"].seconds["total"]
    assert total is not None and total >= a  # what was shared counts in the total of each


def test_seconds_are_those_of_runs_that_had_their_cores_alone(scene_folder, tmp_path, monkeypatch):
    shares = iter([0.3, 0.0, 0.0, 0.0])  # of the start of two, of each of them, of one that needs no start
    monkeypatch.setattr("splatnode.extras.evaluate.report.others_share", lambda since, until: next(shares))
    rows = bench(Plan((scene_folder,), (3,), ("shared-a", "shared-b", "own")), tmp_path, shared="shared")
    assert [row.others for row in rows] == [0.3, 0.3, 0.0]
    assert [row.seconds["total"] is None for row in rows] == [True, True, False]
    assert rows[0].seconds.keys() == rows[2].seconds.keys() and rows[0].psnr is not None
    assert "seconds not reported: others took 30% of its cores" in format_run(rows[0])
    said = explain_missing_seconds([row.others for row in rows])
    assert said.startswith("seconds are not reported of 2 of 3 runs: others took more than 5% of")
    monkeypatch.setattr("splatnode.extras.evaluate.report.others_share", lambda since, until: 0.0)
    (row,) = bench(Plan((scene_folder,), (3,), ("own",), timed=False), tmp_path / "gpu")
    assert row.seconds["total"] is None


def test_a_start_that_fails_fails_the_methods_that_need_it(scene_folder, tmp_path, monkeypatch):
    def fail(frames: object, config: object) -> Start:
        raise RuntimeError("out of memory")

    monkeypatch.setattr("splatnode.extras.evaluate.runner.find_start", fail)
    rows = bench(Plan((scene_folder,), (3,), ("shared", "own")), tmp_path, shared="shared")
    assert [row.verdict for row in rows] == ["FAILED", "OK"] and rows[0].error == "out of memory"


def test_one_core_and_two_give_the_same(scene_folder, tmp_path):
    if len(usable_cores()) < 2:
        pytest.skip("needs two cores")
    plan = Plan((scene_folder,), (3,), ("shared", "exact"), checkpoints=(150,))
    found = []
    for cores in (1, 2):
        with engine(cores, None) as on:
            rows = bench(plan, tmp_path / str(cores), shared="shared", on=on, by_region=True)
        found.append([asdict(without_costs(row)) for row in rows])
    assert found[0] == found[1] and [row["psnr"] > 50 for row in found[0]] == [True] * 4


def test_what_goes_on_from_shared_points_is_what_would_have_been_found_alone():
    frames = list(photographs()[:4])
    short = Optimize(iterations=10, checkpoints=(5,))
    config = msgspec.structs.replace(PRESETS["balanced"], size=160, optimize=short, seed=3)
    found = extract_start_config(config)
    assert found == msgspec.structs.replace(ReconstructionConfig(), size=160)
    start = find_start(frames, msgspec.structs.replace(found, seed=3))
    alone, shared = list(pipeline(frames, config)), list(continue_reconstruction(start, config))
    assert [s.iterations for s in shared] == [0, 5, 10, 10] and [s.iterations for s in alone] == [0, 0, 5, 10, 10]
    for mine, other in zip(shared, alone[1:], strict=True):  # who begins from the photographs shows a first look
        assert (mine.gaussians.means == other.gaussians.means).all() and mine.final == other.final
    assert shared[0].seconds["total"] >= start.seconds > 0


def test_bench_of_refusals_is_a_result_without_renders(scene_folder, tmp_path):
    rows = bench(Plan((scene_folder,), views=(3,), methods=("refuses",)), tmp_path)
    assert [(row.verdict, row.psnr) for row in rows] == [("NO_OVERLAP", None)]
    assert {path.name for path in tmp_path.iterdir()} == {"bench.json", "bench.csv", "report.md", "report.html"}


def test_scene_that_is_not_there_stops_the_bench_before_it_starts(tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold the scene's images"):
        bench(Plan((tmp_path / "absent",), (3,), ("exact",)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_sets_that_rows_could_not_tell_apart_stop_the_bench_before_it_starts(scene_folder, tmp_path):
    other = tmp_path / "other" / scene_folder.name
    shutil.copytree(scene_folder, other)
    for twice, said in ((other, "are both called 'blobs'"), (scene_folder / "24_views" / "..", "are one scene")):
        with pytest.raises(ValueError, match=said) as error:
            bench(Plan((scene_folder, twice), (3,), ("exact",)), tmp_path / "out")
        assert str(scene_folder) in str(error.value) and str(twice) in str(error.value)
    with pytest.raises(ValueError, match="are one scene"):
        bench(Plan((scene_folder, scene_folder), (3,), ("exact",)), tmp_path / "out")
    (other.parent / "splits.json").write_text(
        json.dumps({"blobs": {"train3": ["00.png"], "train4": ["04.png"], "test": ["01.png"]}})
    )
    with pytest.raises(ValueError, match="blobs has 2 splits with 1 training views"):
        bench(Plan((other,), (3, 4), ("exact",)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_command_line():
    parse = build_parser().parse_args
    args = parse(["bench", "a", "--cores", "2", "--ray", "--max-memory", "900", "--timeout-s", "5", "--out", "o"])
    assert (args.cores, args.ray, args.max_memory, args.timeout_s) == (2, "", 900.0, 5.0)
    args = parse(["bench", "a", "--out", "o"])
    assert (args.cores, args.ray, args.max_memory, args.timeout_s) == (None, None, None, 3600.0)
