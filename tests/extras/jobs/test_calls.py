"""Calls in processes: what a function returns comes back, and one that fails costs only itself."""

from __future__ import annotations

import os
import signal
import stat
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from splatnode.capture.process import python
from splatnode.extras.jobs import (
    ANSWER,
    CALL,
    NOT_RUN,
    Answer,
    Child,
    Engine,
    Limits,
    Task,
    engine,
    make_serial_engine,
    own_version,
    pack_call,
    run_here,
    start_call,
    usable_cores,
    wait_for_end,
    work_folder,
    write_call,
)
from tests.support.second_user import OTHER, as_other, shared_tmp  # noqa: F401  a fixture


def answers(on: Engine, folder: Path, limits: Limits, **works: Callable[[], object]) -> dict[str, Answer]:
    tasks = iter([Task(name, pack_call(work)) for name, work in works.items()])
    return dict(on.answers(lambda: next(tasks, None), limits, folder))


def takes_memory() -> int:
    held = bytearray(400_000_000)
    time.sleep(60)
    return len(held)


def started_a_helper() -> None:
    os.spawnlp(os.P_NOWAIT, "sleep", "sleep", "60")
    time.sleep(60)


def test_each_call_has_its_answer_or_its_reason(tmp_path):
    with engine(1, None) as on:
        found = answers(
            on,
            tmp_path / "calls",
            Limits(memory_mb=200.0, timeout_s=20.0),
            good=partial(divmod, 7, 2),
            raises=partial(divmod, 7, 0),
            dies=partial(os._exit, 9),
            silent=partial(os._exit, 0),
            greedy=takes_memory,
            last=partial(os.sched_getaffinity, 0),
        )
    assert list(found) == ["good", "raises", "dies", "silent", "greedy", "last"]
    assert found["good"].value() == (3, 1) and found["last"].value() == {usable_cores()[0]}
    assert "ZeroDivisionError" in found["raises"].reason and "template.py" in found["raises"].reason
    assert found["dies"].reason == "ended with exit code 9 and said nothing"
    assert found["silent"].reason == "ended with exit code 0 and said nothing"
    assert "MB of memory; --max-memory allows 200" in found["greedy"].reason
    with pytest.raises(RuntimeError, match="exit code 9"):
        found["dies"].value()
    assert not any((tmp_path / "calls").iterdir())


def test_a_call_that_hangs_is_ended_with_what_it_started(tmp_path):
    began_s = time.monotonic()
    found = answers(make_serial_engine(), tmp_path / "calls", Limits(timeout_s=1.0), hangs=started_a_helper)
    assert found["hangs"].reason == "took longer than the 1 s that --timeout-s allows"
    assert time.monotonic() - began_s < 30.0


def ends_its_template() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)


def test_calls_are_copies_of_one_process_and_go_on_where_that_is_ended(tmp_path):
    found = answers(
        make_serial_engine(),
        tmp_path / "calls",
        Limits(),
        one=os.getppid,
        two=os.getppid,
        ends=ends_its_template,
        three=os.getppid,
    )
    templates = [found[name].value() for name in ("one", "two", "three")]
    assert templates[0] == templates[1] != templates[2]
    assert "was killed (SIGKILL)" in found["ends"].reason


def test_one_at_a_time_has_all_cores(tmp_path):
    on = make_serial_engine()
    found = answers(on, tmp_path / "calls", Limits(), cores=partial(os.sched_getaffinity, 0))
    assert found["cores"].value() == set(usable_cores()) and on.cores_each == len(usable_cores())


def test_what_a_killed_driver_left_is_removed(tmp_path):
    left = tmp_path / ".calls" / "0"
    left.mkdir(parents=True)
    (left / "answer").write_bytes(b"old")
    with work_folder(tmp_path) as folder:
        assert answers(make_serial_engine(), folder, Limits(), new=partial(abs, -1))["new"].value() == 1
    assert not any(tmp_path.iterdir())


def evil(trace: Path) -> bytes:
    return pack_call(partial(trace.write_text, "run"))


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o2775])
def test_where_others_may_change_the_results_calls_lie_elsewhere(tmp_path, mode):
    """A member of the folder's group has put a call where calls were made before, and an answer."""
    out, trace = tmp_path / "out", tmp_path / "trace"
    for planted in (out / ".calls" / "0", out / ".calls" / "calls" / "0"):
        planted.mkdir(parents=True)
        (planted / CALL).write_bytes(evil(trace))
        (planted / ANSWER).write_bytes(evil(trace))
    out.chmod(mode)
    with work_folder(out) as folder, engine(1, None) as on:
        assert not folder.is_relative_to(out) and stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert answers(on, folder / "calls", Limits(), good=partial(divmod, 7, 2))["good"].value() == (3, 1)
    assert not folder.exists() and not trace.exists()


def test_calls_lie_among_the_results_where_nobody_else_may_change_them(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / ".calls").symlink_to("elsewhere")
    before = os.umask(0)
    try:
        with work_folder(tmp_path) as folder, engine(1, None) as on:
            assert folder == tmp_path / ".calls" and not folder.is_symlink()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            assert answers(on, folder / "calls", Limits(), good=partial(divmod, 7, 2))["good"].value() == (3, 1)
    finally:
        os.umask(before)
    assert not any((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("open_to", [".", ".."])
def test_a_call_that_another_user_could_have_put_there_is_not_made(tmp_path, open_to):
    trace, folder = tmp_path / "trace", write_call(evil(tmp_path / "trace"), tmp_path / "calls" / "0")
    os.chmod(folder / open_to, 0o770)
    end = wait_for_end(start_call(folder, usable_cores()), Limits())
    assert end.exit_code != 0 and "chmod go-w" in end.reason and not trace.exists()


def test_a_call_of_another_user_is_not_made(shared_tmp):  # noqa: F811
    folder, trace = shared_tmp / "0", shared_tmp / "trace"
    plants = "os.mkdir(sys.argv[1], 0o755); open(sys.argv[1] + '/call', 'wb').write(bytes.fromhex(sys.argv[2]))"
    assert as_other(plants, folder, evil(trace).hex()).returncode == 0
    end = wait_for_end(
        Child.start(python.command("splatnode.extras.jobs.template", str(folder)), shared_tmp / "log", usable_cores()),
        Limits(),
    )
    assert end.exit_code != 0 and f"of user {OTHER}" in end.reason and not trace.exists()


def test_more_cores_than_there_are_are_refused():
    with pytest.raises(ValueError, match=f"--cores must be at most {len(usable_cores())}"), engine(1000, None):
        pass


def test_a_worker_with_another_version_says_so():
    call = pack_call(partial(sum, (1, 2)))
    other = run_here(call, Limits(), "0.0.1")
    assert other.end == NOT_RUN and "the work was begun with 0.0.1" in other.reason
    assert run_here(call, Limits(), own_version()).value() == 3


def test_modules_are_found_where_the_driver_finds_them(tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("def answer():\n    return 42\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    work = __import__("only_here").answer
    assert answers(make_serial_engine(), tmp_path / "calls", Limits(), work=work)["work"].value() == 42
