"""A recording on a worker: its result, whoever else makes it, in a folder or in a store; and what is refused."""

from __future__ import annotations

import argparse
import os
import pickle
import threading
from functools import partial
from pathlib import Path

import pytest

from splatnode.extras.batch import BatchRecording, Job, command, run_recording
from splatnode.extras.jobs import Limits, free_core, own_version
from tests.support.recordings import GOOD, REFUSED, options, simulated


def job(results: object, **limits: float) -> Job:
    return Job(simulated, str(results), Limits(**limits), own_version())


def visible(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_result_is_in_the_folder_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    assert run_recording(BatchRecording("good", f"echo told; {GOOD}"), job(out)).verdict == "OK"
    assert run_recording(BatchRecording("no", REFUSED), job(out)).verdict == "NO_OVERLAP"
    failed = run_recording(BatchRecording("bad", "echo why >&2; exit 9"), job(out))
    assert (failed.verdict, failed.message) == ("FAILED", "why")
    assert visible(out) == ["bad.log", "good/replay.log", "good/report.json", "no/replay.log", "no/report.json"]


def test_a_recording_that_is_run_again_has_one_whole_result(tmp_path):
    runs = [BatchRecording("same", f"sleep 0.{number}; {GOOD}") for number in range(4)]
    outcomes = []
    threads = [
        threading.Thread(target=lambda each=each: outcomes.append(run_recording(each, job(tmp_path)))) for each in runs
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [each.verdict for each in outcomes] == ["OK"] * 4
    assert visible(tmp_path) == ["same/replay.log", "same/report.json"]


def test_limits_hold_on_a_worker(tmp_path):
    found = run_recording(BatchRecording("slow", "sleep 60"), job(tmp_path, timeout_s=0.3))
    assert found.message == "took longer than the 0.3 s that --timeout-s allows"


def test_results_go_to_a_store(tmp_path):
    store = f"file://{tmp_path / 'bucket' / 'run'}"
    assert run_recording(
        BatchRecording("good", f'{GOOD}; mkdir "$OUT/colmap"; touch "$OUT/colmap/a"'), job(store)
    ).published
    assert run_recording(BatchRecording("bad", "exit 9"), job(store)).has_failed
    there = visible(tmp_path / "bucket" / "run")
    assert there == ["bad.log", "good/colmap/a", "good/replay.log", "good/report.json"]


def test_a_worker_with_another_splatnode_says_so(tmp_path):
    other = Job(simulated, str(tmp_path), Limits(), "0.0.1 (12345678)")
    found = run_recording(BatchRecording("a", GOOD), other)
    assert found.has_failed and f"has splatnode {own_version()}, the work was begun with 0.0.1" in found.message
    assert found.message.endswith("install the same on all machines") and not visible(tmp_path)


def test_each_recording_has_a_core_while_there_are_some():
    cores = os.sched_getaffinity(0)
    with free_core() as first, free_core() as second:
        assert {first, second} <= cores and (first != second or len(cores) == 1)
    with free_core() as again:
        assert again == first


def test_what_is_sent_to_a_worker_can_be_pickled():
    sent = Job(partial(command.replay, ("--views", "6")), "s3://bucket/run", Limits(500, None), own_version())
    command_line = pickle.loads(pickle.dumps(sent)).work(BatchRecording("a", "/b"), Path("/c"))
    assert command_line[-7:] == ["splatnode", "replay", "/b", "--out", "/c", "--views", "6"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"results": "s3://bucket/run"}, "--results says where the workers of a cluster write; give --ray, too"),
        ({"results": "s3://b/r", "ray": "", "write_back": True}, "--write-back reads the results in --out"),
    ],
)
def test_options_that_do_not_go_together_are_told(tmp_path, given, said):
    (tmp_path / "a.mp4").touch()
    args = argparse.Namespace(**{**vars(options(tmp_path / "out")), "sources": [tmp_path / "a.mp4"], **given})
    args = argparse.Namespace(
        **{**dict.fromkeys(_OF_REPLAY), **vars(args), "no_fallbacks": False, "multi_view_only": False}
    )
    args.every_frame = False
    with pytest.raises(ValueError, match=said):
        command.batch(args)


_OF_REPLAY = (
    "config", "preset", "prior", "device", "size", "budget_s", "max_position_error", "max_gaussians", "max_mb", "seed",
    "views", "marker", "frame", "gravity",
)  # fmt: skip
