"""Whether others took of the cores: by counts that are given, and beside a process that takes half of one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from splatnode.extras.jobs import ALONE, Moment, add_sibling_cores, now, others_share, usable_cores

SPINS = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nprint(flush=True)\nwhile True: pass"


def test_the_share_of_others_is_what_is_not_own():
    since = Moment(100.0, 5.0, 50.0, (0, 1))
    alone = Moment(110.0, 20.0, 65.0, (0, 1))  # 15 s of two cores, all own
    assert others_share(since, alone) == 0.0
    beside = Moment(110.0, 20.0, 69.05, (0, 1))
    assert others_share(since, beside) == pytest.approx(4.0 / 20.0)
    assert others_share(since, Moment(110.0, 20.0, None, (0, 1))) is None


def test_threads_of_one_physical_core_belong_together(tmp_path):
    for core, listed in ((0, "0,4"), (1, "1,5"), (2, "2-3")):
        topology = tmp_path / f"cpu{core}" / "topology"
        topology.mkdir(parents=True)
        (topology / "thread_siblings_list").write_text(f"{listed}\n")
    assert add_sibling_cores((0, 2), tmp_path) == {0, 2, 3, 4}
    assert add_sibling_cores((7,), tmp_path) == {7}  # the system does not tell


def test_a_process_on_the_same_core_is_seen():
    if now().busy_s is None:
        pytest.skip("this system does not tell what its cores do")
    before, core = os.sched_getaffinity(0), usable_cores()[-1]
    other = subprocess.Popen([sys.executable, "-c", SPINS, str(core)], stdout=subprocess.PIPE)
    try:
        os.sched_setaffinity(0, {core})
        assert other.stdout.readline()
        since = now()
        while time.monotonic() < since.at_s + 1.0:
            pass
        share = others_share(since, now())
    finally:
        os.sched_setaffinity(0, before)
        other.send_signal(signal.SIGKILL)
        other.wait()
        other.stdout.close()
    assert share > ALONE
