"""Keyframes over a real link between two network namespaces that is slow, lossy and cut: each arrives once."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.capture.messaging import keys
from splatnode.capture.messaging.keyframes import KeyframeServer
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.spool import Config, Spool
from tests.conftest import ROOT

HERE, THERE = "10.213.7.1", "10.213.7.2"
FRAMES = 20
IMAGE = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)

RECON = """
import sys, pathlib
from splatnode.capture.messaging.keyframes import KeyframeClient
from splatnode.capture.messaging.network import Network
folder = pathlib.Path(sys.argv[1])
network = Network(directory=folder / "there", tcp=sys.argv[2], keys=folder / "laptop")
with KeyframeClient(network) as client:
    while True:
        if (received := client.receive(1.0)) is not None:
            print(received.sequence, flush=True)
            client.acknowledge(received)
"""


def sh(*command):
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture
def link():
    """The name of a namespace that is connected with this one, and of its cable's end here."""
    if shutil.which("ip") is None:
        pytest.skip("needs the program ip (Debian's iproute2)")
    name, here, there = f"splat{os.getpid()}", f"sa{os.getpid()}"[:15], f"sb{os.getpid()}"[:15]
    if sh("ip", "netns", "add", name).returncode != 0:
        pytest.skip("needs the right to make network namespaces")
    try:
        made = sh("ip", "link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
        if made.returncode != 0:
            pytest.skip(f"needs virtual cables: {made.stderr.strip()}")
        sh("ip", "addr", "add", f"{HERE}/24", "dev", here)
        sh("ip", "link", "set", here, "up")
        sh("ip", "-n", name, "addr", "add", f"{THERE}/24", "dev", there)
        sh("ip", "-n", name, "link", "set", there, "up")
        yield name, here
    finally:
        sh("ip", "link", "del", here)
        sh("ip", "netns", "del", name)


def networks(folder):
    """The robot's keys let the laptop in."""
    robot, laptop = keys.create_keys(folder / "robot"), keys.create_keys(folder / "laptop")
    keys.allow(folder / "robot", "laptop", laptop)
    keys.expect_server(folder / "laptop", robot)
    return Network(directory=folder / "here", tcp=HERE, keys=folder / "robot")


@contextlib.contextmanager
def recon(folder, name):
    command = ["ip", "netns", "exec", name, sys.executable, "-c", RECON, str(folder), HERE]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def serve(server, until, seconds):
    deadline = time.monotonic() + seconds
    while not until() and time.monotonic() < deadline:
        server.serve(0.02)
    assert until()


@pytest.mark.netns
def test_a_link_that_is_cut_loses_and_doubles_nothing(tmp_path, link):
    name, cable = link
    network = networks(tmp_path)
    with KeyframeServer(network, Spool(Config(tmp_path / "state"))) as server, recon(tmp_path, name) as process:
        for index in range(FRAMES // 2):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        serve(server, lambda: server.acknowledged >= 3, 20)
        sh("ip", "link", "set", cable, "down")
        for index in range(FRAMES // 2, FRAMES):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        waited = time.monotonic() + 6  # longer than it takes to give the connection up
        serve(server, lambda: time.monotonic() > waited, 10)
        assert server.queued > 0
        sh("ip", "link", "set", cable, "up")
        serve(server, lambda: server.queued == 0, 30)
        process.kill()
        assert [int(line) for line in process.communicate()[0].splitlines()] == list(range(FRAMES))


@pytest.mark.netns
def test_a_slow_and_lossy_link_loses_and_doubles_nothing(tmp_path, link):
    name, cable = link
    made = sh("tc", "qdisc", "add", "dev", cable, "root", "netem", "delay", "40ms", "10ms", "loss", "5%")
    if made.returncode != 0:
        pytest.skip(f"needs the kernel's netem: {made.stderr.strip()}")
    with (
        KeyframeServer(networks(tmp_path), Spool(Config(tmp_path / "state"))) as server,
        recon(tmp_path, name) as process,
    ):
        for index in range(FRAMES):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        serve(server, lambda: server.queued == 0, 60)
        process.kill()
        assert [int(line) for line in process.communicate()[0].splitlines()] == list(range(FRAMES))
