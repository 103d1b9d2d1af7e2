"""Faults of `tests.bench faults` that take something away: the disk, the right to write, memory, descriptors."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.status import read_heartbeats
from tests.bench.node.trial import NotTried, Trial, expect, expect_scene, expect_whole, wait_for
from tests.support.disk_faults import compiled, environment
from tests.support.node import Node, running

MB = 1 << 20


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A disk of its own at `folder`. Raises NotTried."""
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], capture_output=True).returncode:
        raise NotTried("no right to mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def remounted(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True)


def problem_of(node: Node, verb: str = "recon") -> str:
    status = read_heartbeats(node.network)[verb]
    return "" if status is None else status["problem"] if verb == "recon" else status["why"]


def full_disk_under_checkpoint(trial: Trial) -> None:
    """There is room for the keyframes and not for what is computed: that costs time after a restart, and is told."""
    with (
        small_disk(trial.folder / "disk", "2200k") as disk,
        running(trial.node(checkpoint=f"{disk}/checkpoint")) as node,
    ):
        node.start("recon")
        node.start("capture")
        expect_scene(node)
        wait_for(lambda: "make room" in problem_of(node), "problem that tells of the full disk")
        remounted(disk, "size=200m")
        expect(node.end("recon") == 0, "recon did not end with 0")
        node.start("recon")
        expect_whole(node)


def full_disk_under_out(trial: Trial) -> None:
    """There is no room for the result: that is told, and the next start writes it."""
    with small_disk(trial.folder / "disk", "300k") as disk, running(trial.node(out=str(disk / "out"))) as node:
        node.start("recon")
        node.start("capture")
        expect_scene(node)
        wait_for(lambda: "cannot write" in node.log("recon"), "line that tells of the result")
        expect(not list(disk.rglob("*.ply")) and not list(disk.rglob("*.tmp")), "half a result")
        remounted(disk, "size=200m")
        expect(node.end("recon") == 0, "recon did not end with 0")
        node.start("recon")
        wait_for(lambda: any((disk / "out").glob("*/manifest.json")), "result")
        expect_whole(node)


def read_only_at_start(trial: Trial) -> None:
    """Folders that cannot be written: each process says which and ends at once; writable again, all is well."""
    with small_disk(trial.folder / "disk", "200m") as disk:
        node = trial.node(checkpoint=str(disk / "checkpoint"))
        (disk / "checkpoint").mkdir(mode=0o700)
        remounted(disk, "ro")
        with running(node):
            code = node.start("recon").wait(120)
            expect(code not in (0, 70), f"recon ended with {code}")
            said = node.log("recon").strip().splitlines()
            expect("Read-only file system" in said[-1] and str(disk) in said[-1], f"recon said {said[-1:]}")
            expect("Traceback" not in node.log("recon"), "recon ended with a traceback")
            remounted(disk, "rw")
            node.start("recon")
            node.start("capture")
            expect_whole(node)


def read_only_while_running(trial: Trial) -> None:
    """Spool, checkpoint and results become read-only, and writable again: nobody ends, nothing is lost."""
    waiting, frozen = trial.folder / "waiting", trial.folder / "frozen"
    trial.images.rename(waiting)
    trial.images.mkdir()
    node = trial.node({"kind": "watched", "folder": str(trial.images)})
    folders = [node.folder / name for name in ("spool", "checkpoint", "out")]
    more = environment(compiled(trial.folder), folders, read_only=frozen)
    with running(node):
        node.start("recon", **more)
        node.start("capture", **more)
        wait_for(lambda: "event=ready" in node.log("recon"), "recon that runs")
        files = sorted(waiting.iterdir())
        _show(trial, files[:2])
        wait_for(lambda: node.log("capture").count("event=keyframe") == 2, "two keyframes")
        frozen.touch()
        _show(trial, files[2:3])
        wait_for(lambda: "Read-only" in node.log("capture"), "line that tells of the disk")
        trial.some_time(6.0)
        for verb in ("capture", "recon"):
            expect(node.processes[verb].poll() is None, f"{verb} ended: {node.log(verb)[-500:]}")
        frozen.unlink()
        _show(trial, files[2:], again=True)
        expect_whole(node)


def _show(trial: Trial, files: list[Path], again: bool = False) -> None:
    """Puts photographs before the camera."""
    for path in files:
        name = f"again-{path.name}" if again and path is files[0] else path.name
        (trial.images / name).write_bytes(path.read_bytes())
        time.sleep(0.5)


def little_memory(trial: Trial) -> None:
    """recon may have a little more memory than it has, for a while: it tells so, goes on later, and loses nothing."""
    with running(trial.node()) as node:
        process = node.start("recon")
        wait_for(lambda: "event=ready" in node.log("recon"), "recon that runs")
        time.sleep(2.0)
        pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + trial.chance.randrange(40) * MB
        resource.prlimit(process.pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
        node.start("capture")
        deadline = time.monotonic() + 20
        while "do not suffice" not in node.log("recon") and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.1)
        if process.poll() is None:
            resource.prlimit(process.pid, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        else:  # libraries abort where they get none: the service manager starts it again
            node.processes.pop("recon")
            node.start("recon")
        expect_whole(node)


def killed_for_memory(trial: Trial) -> None:
    """The kernel ends recon for its memory, as a service's MemoryMax does; with more it goes on where it was."""
    with cgroup("memory", {"memory.limit_in_bytes": 120 * MB}) as group, running(trial.node()) as node:
        process = node.start("recon", before=group)
        node.start("capture")
        expect(process.wait(120) == -signal.SIGKILL, f"recon ended with {process.poll()}")
        node.start("recon")
        expect_whole(node)


@contextlib.contextmanager
def cgroup(controller: str, limits: dict[str, int]) -> Iterator[tuple[str, ...]]:
    """What to put before a command so that it runs within these limits. Raises NotTried."""
    folder = Path("/sys/fs/cgroup", controller, f"splatnode-{os.getpid()}")
    try:
        folder.mkdir()
        for name, value in limits.items():
            (folder / name).write_text(str(value))
    except OSError as error:
        raise NotTried(f"no right to make a cgroup ({error})") from error
    try:
        yield "sh", "-c", f'echo $$ > {folder}/cgroup.procs; exec "$@"', "sh"
    finally:
        for _ in range(50):
            with contextlib.suppress(OSError):
                folder.rmdir()
                break
            time.sleep(0.1)


def few_descriptors(trial: Trial) -> None:
    """Too few descriptors to start with: each process works, or says so and ends; with enough all is well."""
    for verb in ("capture", "recon"):
        for number in (8, 16, 24, 32, 64, 128, 160):
            _starts_or_says_so(trial, verb, number, ("prlimit", f"--nofile={number}:{number}"))
    with running(trial.node()) as node:
        node.start("recon", before=("prlimit", "--nofile=256:256"))
        node.start("capture", before=("prlimit", "--nofile=256:256"))
        expect_whole(node)


def few_threads(trial: Trial) -> None:
    """Too few processes and threads to start with: as with descriptors."""
    for verb in ("capture", "recon"):
        for number in (1, 2, 4, 8, 12, 16, 24, 32, 64):
            with cgroup("pids", {"pids.max": number}) as group:
                _starts_or_says_so(trial, verb, number, group)
    with running(trial.node()) as node:
        node.start("recon")
        node.start("capture")
        expect_whole(node)


def _starts_or_says_so(trial: Trial, verb: str, number: int, before: tuple[str, ...]) -> None:
    with running(trial.node(name=f"{verb}-{number}")) as node:
        process = node.start(verb, before=before)
        sign = "event=started" if verb == "capture" else "event=ready"
        deadline = time.monotonic() + 60
        while process.poll() is None and sign not in node.log(verb) and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(2.0 if process.poll() is None else 0.0)
        said, ended = node.log(verb), process.poll()
        expect(ended is None or ended > 0, f"{verb} of {number} was ended by signal {ended}: {said[-400:]}")
        expect(ended is not None or sign in said, f"{verb} of {number} neither runs nor ends: {said[-400:]}")
        expect(ended != 70 and "Traceback" not in said, f"{verb} of {number}: {said[-600:]}")
