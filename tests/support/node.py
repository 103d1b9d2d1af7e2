"""The node's real processes in a folder of their own, and somebody who looks on."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_SCENE, Network
from splatnode.capture.messaging.pubsub import StateClient
from splatnode.capture.process.config import parse_config
from splatnode.recon.daemon import ReconState, ReconStatus
from splatnode.recon.result.message import LiveScene, SceneHeader, decode_snapshot, make_camera_record
from splatnode.recon.result.snapshot import CameraEstimate
from tests.conftest import ROOT

PATIENCE_S = 300.0


class Node:
    """Starts and ends `splatnode capture` and `splatnode recon`; all that they write lies in `folder`."""

    def __init__(
        self,
        folder: Path,
        camera: dict[str, Any],
        recon: dict[str, Any] | None = None,
        network: dict[str, Any] | None = None,
    ) -> None:
        self.folder = folder
        (folder / "run").mkdir(mode=0o700, parents=True)
        network = {"directory": str(folder / "run")} | (network or {})
        self.network = parse_config(network, Network)
        self.configs = {
            "capture": {"network": network, "spool": {"directory": str(folder)}} | camera,
            "recon": {
                "network": network,
                "checkpoint": str(folder / "checkpoint"),
                "out": str(folder / "out"),
            }
            | (recon or {}),
        }
        for verb, config in self.configs.items():
            (folder / f"{verb}.yaml").write_text(yaml.safe_dump(config))
        self.processes: dict[str, subprocess.Popen] = {}

    def start(self, verb: str, *, name: str | None = None, before: Sequence[str] = (), **more: str) -> subprocess.Popen:
        """Starts the process of `verb`; `name` tells it from another one, `before` is put before its command.

        `more`: environment variables.
        """
        return self.run(name or verb, [*before, *self.command(verb)], **more)

    def command(self, verb: str, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "splatnode", verb, *(arguments or (str(self.folder / f"{verb}.yaml"),))]

    def run(self, name: str, command: Sequence[str], **more: str) -> subprocess.Popen:
        """Starts any process as one of this node."""
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_WAIT_POLICY": "passive"} | more
        with open(self.folder / f"{name.split()[-1]}.log", "ab") as log:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env=environment,
                stdout=log,
                stderr=log,
            )
        self.processes[name] = process
        return process

    def end(self, name: str, number: int = signal.SIGTERM, patience_s: float = 120.0) -> int:
        """The exit code, after the signal."""
        process = self.processes.pop(name)
        if process.poll() is None:
            process.send_signal(number)
        return process.wait(patience_s)

    def log(self, verb: str) -> str:
        return (self.folder / f"{verb}.log").read_text()

    def spooled(self) -> int:
        """Keyframes that capture still keeps."""
        return len(list(Path(self.configs["capture"]["spool"]["directory"], "spool").glob("*.frame")))

    @property
    def out(self) -> Path:
        return Path(self.configs["recon"]["out"])

    @property
    def half_written(self) -> list[Path]:
        """Temporary files in all folders that the node writes."""
        folders = {self.folder, self.out, *self.folder.parent.glob("disk")}
        return [path for folder in folders for path in folder.rglob(".*") if path.suffix in (".tmp", ".renaming")]

    def close(self) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
            process.wait(10)


@contextlib.contextmanager
def running(node: Node) -> Iterator[Node]:
    """Ends what is still running when the block ends."""
    try:
        yield node
    finally:
        node.close()


class Viewer:
    """Hears the scenes of a node."""

    def __init__(self, network: Network) -> None:
        self._client = StateClient(RECON_SCENE, network, SceneHeader)

    def close(self) -> None:
        self._client.close()

    def hear(self, timeout_s: float) -> LiveScene | None:
        message = self._client.poll(timeout_s)
        return None if message is None else decode_snapshot(message)

    def wait(self, until: Callable[[LiveScene], bool], patience_s: float = PATIENCE_S) -> LiveScene | None:
        """The first scene for which `until` holds; None where none comes in time."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            scene = self.hear(0.2)
            if scene is not None and until(scene):
                return scene
        return None


def taken(capture: Mapping[str, Any] | None) -> bool:
    """Whether the camera has shown all, and recon has it, by capture's heartbeat; None: it has ended."""
    return capture is None or (capture["state"] == "finished" and not capture["waiting"])


def at_rest(recon: Mapping[str, Any]) -> bool:
    """Whether there is nothing to do for recon, by its heartbeat."""
    return recon["state"] == "idle" and not recon["unfinished"] and not recon["queue"]


def processor_s(pid: int) -> float:
    """Seconds of processor time that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def descriptors(pid: int) -> int:
    """Open files and sockets of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def finished(views: int) -> Callable[[LiveScene], bool]:
    """Whether a scene of at least so many views is as good as it gets."""
    return lambda scene: scene.snapshot.final and len(scene.snapshot.cameras) >= views


def heartbeat(numbering: Numbering, tracked: CameraEstimate | None) -> ReconStatus:
    """Of a daemon whose scene is finished, with the live camera `tracked`."""
    return ReconStatus(
        **numbering.next(), state=ReconState.IDLE, uptime_s=1.0, scene_id="place", keyframe=2, queue=0, keyframes=2,
        num_gaussians=225, iterations=500, final=True, verdict="OK", message="", bounds="", keyframe_s=None,
        delay_s=0.0, delay="", unfinished=0, scenes=0, maps=0, loops=0, newest_places=(), refused=0,
        duplicates=0, rss_mb=100.0,
        camera_moved=None, moved="", problem="", tracked=make_camera_record(tracked) if tracked else None,
    )  # fmt: skip
