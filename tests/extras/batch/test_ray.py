"""Batches on a Ray of this machine; `python -m tests.bench batch_ray` has a cluster that loses a worker and a node."""

from __future__ import annotations

import os
import socket
from importlib import import_module
from pathlib import Path

import pytest

from splatnode.batch import reconstruct_dataset, recordings
from splatnode.extras.batch import BatchRecording, Job, run_recording
from splatnode.extras.batch.command import EXIT_SOME_FAILED, run_batch
from splatnode.extras.jobs import Limits, Task, engine, pack_call
from tests.support.hostile_folder import make_hostile
from tests.support.recordings import GOOD, REFUSED, options, simulated
from tests.support.synthetic import photographs

ray = pytest.importorskip("ray", reason="needs ray")
FOUND = [BatchRecording("good", GOOD), BatchRecording("no", REFUSED), BatchRecording("bad", "echo why; exit 9")]


def test_a_batch_is_as_on_one_machine(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_batch(options(out, ray="", cores=1), FOUND, simulated, ["act"]) == EXIT_SOME_FAILED
    assert "FAILED: 1; NO_OVERLAP: 1; OK: 1" in capsys.readouterr().out
    there = {path.name for path in out.iterdir()}
    assert there == {"good", "no", "bad.log", "batch.csv", "batch.jsonl", "batch.parquet", "index.html"}


def test_workers_run_no_module_of_the_current_folder(tmp_path, monkeypatch):
    """Ray adds the driver's folder to the places of modules of its workers."""
    trace = make_hostile(tmp_path / "photos")
    monkeypatch.chdir(tmp_path / "photos")
    tasks = iter([Task("cwd", pack_call(os.getcwd))])
    with engine(1, "") as on:
        ((_, answer),) = on.answers(lambda: next(tasks, None), Limits(), tmp_path / "calls")
    assert answer.value() == str(tmp_path / "photos") and not trace.exists()


def test_more_memory_than_a_machine_has_is_told_in_place_of_waiting(tmp_path):
    with pytest.raises(ValueError, match="has the 1e.09 MB that --max-memory sets aside .*: give less"):
        run_batch(options(tmp_path / "out", ray="", cores=1, max_memory=1e9), FOUND, simulated, ["act"])


def test_a_cluster_that_cannot_be_reached_is_told(tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        said = f"no Ray cluster can be reached at {address} .*refused.* `ray start --head`"
        with pytest.raises(ConnectionError, match=said):
            run_batch(options(tmp_path / "out", ray=address), FOUND, simulated, ["act"])


def test_a_dataset_gets_what_came_of_its_rows(tmp_path):
    import cv2

    folder = tmp_path / "in" / "place"
    folder.mkdir(parents=True)
    for frame in photographs()[:2]:
        cv2.imwrite(str(folder / frame.name), frame.image[:, :, ::-1])
    (tmp_path / "in" / "film.mp4").write_bytes(b"no film")
    with import_module("splatnode.extras.jobs.ray").joined("", 1):
        rows = [{**row, "station": 7} for row in recordings([tmp_path / "in"])]
        done = reconstruct_dataset(ray.data.from_items(rows), tmp_path / "out", options=("--preset", "preview"))
        found = {row["name"]: row for row in done.take_all()}
    assert found["film"]["verdict"] == "FAILED" and "no video" in found["film"]["message"]
    assert found["place"]["station"] == 7 and found["place"]["verdict"] != "FAILED"
    assert (Path(tmp_path) / "out" / "place" / "report.json").is_file()


def test_what_goes_to_a_worker_is_a_value():
    cloudpickle = import_module("ray.cloudpickle")
    job = Job(simulated, "/results", Limits(), "0.1.0")
    sent, given = cloudpickle.loads(cloudpickle.dumps((run_recording, job)))
    assert sent is run_recording and given == job
