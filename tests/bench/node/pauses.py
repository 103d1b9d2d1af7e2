"""Faults of `tests.bench faults` in time: clocks that jump, processes that stop and go on, a recon that is absent."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ledger import StoredFrame
from tests.bench.node.shortages import problem_of
from tests.bench.node.trial import NotTried, Trial, expect, expect_scene, expect_whole, wait_for
from tests.support.disk_faults import SOURCE, compiled
from tests.support.node import Node, Viewer, running


def clocks_jump(trial: Trial) -> None:
    """Capture and recon each have a monotonic clock of their own, an hour and days off, with frames in flight."""
    if subprocess.run(["unshare", "-T", "--monotonic", "1000", "true"], capture_output=True).returncode:
        raise NotTried("no right to another clock (unshare -T)")
    with running(trial.node()) as node:
        node.start("recon", before=("unshare", "-T", "--monotonic", str(trial.chance.randrange(10**6))))
        node.start("capture", before=("unshare", "-T", "--monotonic", "3600"))
        trial.some_time(6.0)
        node.end("capture", signal.SIGKILL)
        node.start("capture")  # an hour back
        expect_whole(node)


def wall_clock_jumps(trial: Trial) -> None:
    """The time of day is set a year forth and ten years back while frames are in flight."""
    clock = trial.folder / "clock"
    library = compiled(trial.folder, SOURCE.with_name("wall_clock.c"))
    more = {"LD_PRELOAD": str(library), "WALL_CLOCK": str(clock)}
    with running(trial.node()) as node:
        clock.write_text("0")
        node.start("recon", **more)
        node.start("capture", **more)
        for years in (1, -10):
            trial.some_time(6.0)
            clock.write_text(str(years * 365 * 86400))
        expect_whole(node)
    year = time.gmtime(time.time() - 3650 * 86400).tm_year
    expect(f'time="{year}' in node.log("recon"), "the clock did not jump")


def stopped_for_a_minute(trial: Trial, verb: str) -> None:
    """SIGSTOP with frames in flight, SIGCONT a minute later."""
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        wait_for(lambda: "event=keyframe" in node.log("capture"), "keyframe")
        viewer = Viewer(node.network)
        trial.some_time(3.0)
        process = node.processes[verb]
        process.send_signal(signal.SIGSTOP)
        time.sleep(trial.pause_s)
        process.send_signal(signal.SIGCONT)
        viewer.close()
        expect_whole(node)


def recon_stopped_for_a_minute(trial: Trial) -> None:
    stopped_for_a_minute(trial, "recon")


def capture_stopped_for_a_minute(trial: Trial) -> None:
    stopped_for_a_minute(trial, "capture")


def viewer_stopped_for_a_minute(trial: Trial) -> None:
    """A real viewer, without a window, that stops and goes on: it shows the last scene, and nobody waited for it."""
    pictures = trial.folder / "pictures"
    with running(trial.node()) as node:
        node.start("recon")
        arguments = (str(node.folder / "recon.yaml"), "--headless", "--exit-when-final", "--out", str(pictures))
        (node.folder / "view.yaml").write_text(f'{{"network": {{"directory": "{node.folder / "run"}"}}}}')
        node.run("view", node.command("view", str(node.folder / "view.yaml"), *arguments[1:]))
        node.start("capture")
        wait_for(lambda: "event=keyframe" in node.log("capture"), "keyframe")
        trial.some_time(3.0)
        viewer = node.processes["view"]
        viewer.send_signal(signal.SIGSTOP)
        started = time.monotonic()
        expect_scene(node)
        time.sleep(max(0.0, trial.pause_s - (time.monotonic() - started)))
        viewer.send_signal(signal.SIGCONT)
        expect(viewer.wait(120) == 0 and any(pictures.iterdir()), "the viewer did not show the finished scene")
        node.processes.pop("view")
        expect_whole(node)


def recon_absent_for_an_hour(trial: Trial) -> None:
    """The spool is at its bound: the oldest keyframes are kept, and it is said that no more are taken."""
    spool = {"max_frames": 3}
    live = {"kind": "folder", "folder": str(trial.images), "fps": 20.0, "pace": "recorded", "loops": 200}
    with running(trial.node(live, spool=spool)) as node:
        node.start("capture")
        wait_for(lambda: "event=spool_full" in node.log("capture"), "line that tells of the bound")
        time.sleep(min(5.0, trial.pause_s))
        expect(node.spooled() == 3, f"{node.spooled()} keyframes are kept")
        kept = sorted(path.name for path in (node.folder / "spool").glob("*.frame"))
        expect([int(name.split("-")[0]) for name in kept] == [0, 1, 2], f"kept: {kept}")
        expect("is the bound" in problem_of(node, "capture"), f"status says {problem_of(node, 'capture')!r}")
        expect(node.log("capture").count("event=spool_full") == 1, "the log is filled")
        node.start("recon")
        expect_scene(node)
        wait_for(lambda: "event=spool_has_room" in node.log("capture"), "line that tells of room")
        names = {stored.frame.name for stored in stored_frames(node)}
        expect({f"view_{index:03d}.png" for index in range(3)} <= names, f"the oldest are not there: {names}")


def stored_frames(node: Node) -> list[StoredFrame]:
    """What the checkpoint holds when recon has ended, which this does."""
    node.end("recon")
    store = Store(Path(node.configs["recon"]["checkpoint"]))
    try:
        return list(store.frames())
    finally:
        store.close()
