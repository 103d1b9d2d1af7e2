"""The engine: each recording's end is its own, and what it leaves is whole or not there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatnode.capture.process.system import SHORT_OF_MEMORY
from splatnode.extras.batch import LOG, BatchRecording, Plan, make_failed_outcome, run_all
from splatnode.extras.jobs import NOT_RUN, Limits
from tests.conftest import ROOT
from tests.support.recordings import GOOD, REFUSED, simulated

UNLIMITED = Limits()
CORES = tuple(sorted(os.sched_getaffinity(0)))


def outcomes(out: Path, limits: Limits = UNLIMITED, cores: tuple[int, ...] = CORES[:1], **commands: str):
    todo = [BatchRecording(name, command) for name, command in commands.items()]
    return {found.name: found for found in run_all(todo, simulated, Plan(out, cores, limits))}


def test_a_result_is_read_kept_and_has_its_log(tmp_path):
    found = outcomes(tmp_path, good=f"echo told; {GOOD}", refused=REFUSED)
    good = found["good"]
    assert (good.verdict, good.published, good.photographs, good.left_out, good.gaussians) == ("OK", True, 3, 0, 1000)
    assert (good.rotation_deg, good.centre_percent, good.reconstruction_s) == (0.1234, 1.5, 0.5)
    assert good.memory_mb >= 12.5 and good.exit_code == 0
    assert (found["refused"].verdict, found["refused"].published, found["refused"].has_failed) == (
        "NO_OVERLAP",
        False,
        False,
    )
    assert (tmp_path / "good" / LOG).read_text() == "told\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good", "refused"]


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("echo noise; echo 'splatnode: no photographs here; give some' >&2; echo after; exit 2", "no photographs here"),
        ("echo the last line; exit 70", "the last line"),
        ("exit 3", "exit code 3 and said nothing"),
        ("exit 0", "exit code 0, but report.json"),
        ('mkdir "$OUT"; echo "{" > "$OUT/report.json"', "exit code 0, but report.json"),
        ("kill -9 $$", "was killed (SIGKILL): mostly memory has run out"),
        ("kill -SEGV $$", "was ended by SIGSEGV"),
    ],
)
def test_a_failure_has_its_reason_and_costs_only_itself(tmp_path, command, said):
    found = outcomes(tmp_path, bad=f'mkdir "$OUT".x; {command}', good=GOOD)
    assert found["bad"].has_failed and said in found["bad"].message
    assert found["good"].verdict == "OK"
    assert {path.name for path in tmp_path.iterdir() if path.name[0] != "."} == {"bad.log", "good"}


def test_what_cannot_be_run_is_told(tmp_path):
    plan = Plan(tmp_path, CORES[:1], Limits())
    (found,) = run_all([BatchRecording("a", "b")], lambda recording, folder: ["/nowhere/at/all"], plan)
    assert found.message == "/nowhere/at/all cannot be run: No such file or directory"


def test_a_recording_that_hangs_is_ended_with_all_that_it_started(tmp_path):
    pids = tmp_path / "pids"
    hanging = f"sleep 60 & echo $! > '{pids}'; wait"
    began_s = time.monotonic()
    found = outcomes(tmp_path, Limits(timeout_s=0.5), hanging=hanging, good=GOOD)
    assert time.monotonic() - began_s < 20
    assert found["hanging"].message == "took longer than the 0.5 s that --timeout-s allows"
    assert found["hanging"].exit_code is None and found["good"].verdict == "OK"
    assert not _runs(int(pids.read_text()))


def test_a_recording_that_takes_too_much_memory_is_ended_alone(tmp_path):
    taking = f"exec {sys.executable} -c 'import time; kept = bytearray(300_000_000); time.sleep(60)'"
    in_a_helper = taking.removeprefix("exec ") + "; true"
    found = outcomes(tmp_path, Limits(memory_mb=200, timeout_s=50), taking=taking, helper=in_a_helper, good=GOOD)
    for name in ("taking", "helper"):
        assert "MB of memory; --max-memory allows 200" in found[name].message and found[name].memory_mb > 200
    assert found["good"].verdict == "OK"


def test_what_a_batch_can_do_about_a_want_of_memory_is_told(tmp_path):
    short = f"echo 'splatnode: {SHORT_OF_MEMORY} (MemoryError)'; exit 70"
    found = outcomes(tmp_path, short=short, killed="kill -9 $$")
    assert found["short"].message.startswith(SHORT_OF_MEMORY)
    assert all("fewer --cores, or --max-memory, leave more" in each.message for each in found.values())
    lost = make_failed_outcome(
        BatchRecording("a", "b"), NOT_RUN, "its worker was lost 6 times: the node is running low on memory"
    )
    assert lost.message.endswith("in a batch fewer --cores, or --max-memory, leave more of it")


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_each_recording_at_a_time_has_a_core_of_its_own(tmp_path):
    allowed = f"{sys.executable} -c 'import os; print(*os.sched_getaffinity(0))' && sleep 1"
    began_s = time.monotonic()
    outcomes(tmp_path, cores=CORES[:2], first=f"{allowed}; {GOOD}", second=f"{allowed}; {GOOD}")
    assert time.monotonic() - began_s < 1.9
    used = [(tmp_path / name / LOG).read_text().split() for name in ("first", "second")]
    assert sorted(used) == sorted([[str(core)] for core in CORES[:2]])


def test_a_result_that_is_made_again_takes_the_place_of_the_old_one(tmp_path):
    outcomes(tmp_path, same=f'{GOOD}; touch "$OUT/old"')
    outcomes(tmp_path, same=f'{GOOD}; touch "$OUT/new"')
    assert {path.name for path in (tmp_path / "same").iterdir()} == {"report.json", "new", LOG}
    outcomes(tmp_path, same="exit 9")
    assert (tmp_path / "same" / "new").exists(), "a failure takes nothing away"


def test_who_stops_reading_ends_what_runs_and_leaves_nothing(tmp_path):
    todo = [BatchRecording("a", GOOD), BatchRecording("b", 'mkdir "$OUT"; echo $$ > "$OUT/pid"; exec sleep 60')]
    plan = Plan(tmp_path, CORES[:1], Limits())
    running = run_all(todo, simulated, plan)
    assert next(running).name == "a"
    running.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_recordings_end_with_a_driver_that_is_killed(tmp_path):
    pid_file = tmp_path / "pid"
    program = (
        "from pathlib import Path\n"
        "from tests.extras.batch.test_engine import outcomes\n"
        f"outcomes(Path({str(tmp_path)!r}), waiting='echo $$ > {pid_file}.new; mv {pid_file}.new {pid_file}; "
        "exec sleep 60')\n"
    )
    driver = subprocess.Popen([sys.executable, "-c", program], cwd=ROOT)
    try:
        assert _within(30, pid_file.exists), "the recording must begin"
    finally:
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    assert _within(10, lambda: not _runs(int(pid_file.read_text()))), "its process must end with the driver"
    outcomes(tmp_path, other=GOOD)
    assert {path.name for path in tmp_path.iterdir()} == {"pid", "other"}


def _within(seconds: float, holds) -> bool:
    end_s = time.monotonic() + seconds
    while not (held := holds()) and time.monotonic() < end_s:
        time.sleep(0.05)
    return held


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
