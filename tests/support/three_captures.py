"""A camera for several captures beside one recon, as a package of its own, and the half of recon that receives."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

from splatnode.capture.messaging.network import Network
from splatnode.capture.process.terminal import Problems
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import ingest
from splatnode.recon.daemon.checkpoint import Store

STEP_NS = 200_000_000  # five frames a second
CAMERA = f'''
"""Frames of noise at {1_000_000_000 // STEP_NS} a second, at the same times in every process."""

import time

import msgspec
import numpy as np
from splatnode.capture.frame import Clock, Frame, Stamp

LIVE = True
STEP_NS = {STEP_NS}


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    until_s: float
    seed: int = 0


def stream(config):
    number = time.time_ns() // STEP_NS
    while (number := number + 1) * STEP_NS < config.until_s * 1e9:
        time.sleep(max(0, number * STEP_NS - time.time_ns()) / 1e9)
        noise = np.random.default_rng([number, config.seed]).integers(0, 256, (24, 32, 3)).astype(np.uint8)
        image = np.kron(noise, np.ones((5, 5, 1), np.uint8))
        at = Stamp(number * STEP_NS, Clock.UTC)
        yield Frame(0, f"{{number}}", time.monotonic_ns(), image, None, captured_at=at)
    while True:
        time.sleep(0.2)
        yield Frame(0, "the last", time.monotonic_ns(), np.zeros((120, 160, 3), np.uint8), None)
'''


def install_camera(folder: Path) -> None:
    """Installs the camera `grid` as a package in the folder, which is to be on PYTHONPATH."""
    about = folder / "grid_camera-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "grid_camera.py").write_text(CAMERA)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: grid-camera\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[splatnode.cameras]\ngrid = grid_camera\n")


def receive(run: Path, checkpoint: Path) -> None:
    """Stores and acknowledges keyframes as recon does, until the process is ended."""
    ingest.prepare = lambda frame, _: frame
    inbox, stopping = ingest.Inbox(), threading.Event()
    network = Network(directory=run)
    taking = ingest.Intake(network, ReconstructionConfig(), Store(checkpoint), inbox, Problems(), stopping)
    threading.Thread(target=taking.run, daemon=True).start()
    while True:
        inbox.dequeue(0.2)
        time.sleep(0.01)


if __name__ == "__main__":
    receive(Path(sys.argv[1]), Path(sys.argv[2]))
