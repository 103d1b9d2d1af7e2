"""Keyframes over a real link between two network namespaces that is slow, lossy and cut: each arrives once.

A connection over a link that is cut is given up on both ends, whether data is on its way or nothing is said over it.
"""

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
from splatnode.capture.messaging import network as keys
from splatnode.capture.messaging import network as network_module
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.network import CAPTURE_KEYFRAMES, CAPTURE_PREVIEW, Network
from splatnode.capture.messaging.pubsub import Publisher
from tests.conftest import ROOT

HERE, THERE = "10.213.7.1", "10.213.7.2"
FRAMES = 20
ESTABLISHED = "01"  # in /proc/net/tcp
IMAGE = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)

DEAD_LINK_S = 3

RECON = f"""
import sys, pathlib
from splatnode.capture.messaging import network
from splatnode.capture.messaging.pubsub import Subscriber
from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import CAPTURE_PREVIEW
from splatnode.capture.messaging.messages import Header
network._DEAD_LINK_S = {DEAD_LINK_S}
folder = pathlib.Path(sys.argv[1])
network = network.Network(directory=folder / "there", tcp=sys.argv[2], keys=folder / "laptop")
with KeyframeClient(network) as client, Subscriber(CAPTURE_PREVIEW, network, Header):
    while True:
        if (received := client.receive(1.0)) is not None:
            print(received.sequence, flush=True)
            client.acknowledge(received)
"""


def sh(*command):
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(network_module, "_DEAD_LINK_S", DEAD_LINK_S)


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


def connections(name=None):
    """How many connections of the port of keyframes, and of that of previews, the kernel holds, here or in `name`."""
    there = ("ip", "netns", "exec", name) if name else ()
    found = sh(*there, "cat", "/proc/net/tcp").stdout.splitlines()[1:]
    ends = [(local.split(":")[1], other.split(":")[1]) for _, local, other, state, *_ in map(str.split, found)
            if state == ESTABLISHED]  # fmt: skip
    first = Network().first_port
    ports = (f"{first + service.tcp_port:04X}" for service in (CAPTURE_KEYFRAMES, CAPTURE_PREVIEW))
    return [sum(port in pair for pair in ends) for port in ports]


@pytest.mark.netns
@pytest.mark.parametrize("end", ["here", "there"])
def test_a_link_that_is_cut_loses_and_doubles_nothing(tmp_path, link, end):
    name, cable = link
    network = networks(tmp_path)
    cut = ("ip", "link", "set", cable) if end == "here" else ("ip", "-n", name, "link", "set", f"sb{os.getpid()}"[:15])
    with (
        KeyframeServer(network, Spool(SpoolConfig(tmp_path / "state"))) as server,
        Publisher(CAPTURE_PREVIEW, network),
        recon(tmp_path, name) as process,
    ):
        for index in range(FRAMES // 2):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        serve(server, lambda: server.acknowledged >= 3 and connections() == connections(name) == [1, 1], 20)
        sh(*cut, "down")
        for index in range(FRAMES // 2, FRAMES):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        serve(server, lambda: connections() == connections(name) == [0, 0], 3 * DEAD_LINK_S)
        assert server.num_queued > 0
        sh(*cut, "up")
        serve(server, lambda: server.num_queued == 0, 30)
        process.kill()
        assert [int(line) for line in process.communicate()[0].splitlines()] == list(range(FRAMES))


@pytest.mark.netns
def test_a_frame_that_takes_longer_than_a_dead_link_arrives_at_once(tmp_path, link):
    name, cable = link
    made = sh("tc", "qdisc", "add", "dev", cable, "root", "tbf", "rate", "300kbit", "burst", "16kb", "latency", "1s")
    if made.returncode != 0:
        pytest.skip(f"needs the kernel's tbf: {made.stderr.strip()}")
    with (
        KeyframeServer(networks(tmp_path), Spool(SpoolConfig(tmp_path / "state"))) as server,
        recon(tmp_path, name) as process,
    ):
        server.offer(Frame(0, "0.png", 0, IMAGE, None))
        began = time.monotonic()
        serve(server, lambda: server.num_queued == 0, 20)
        assert time.monotonic() - began > DEAD_LINK_S + 1
        process.kill()
        assert process.communicate()[0].split() == ["0"]
        sent = sh("tc", "-s", "qdisc", "show", "dev", cable).stdout.split("Sent ")[1].split()[0]
        assert int(sent) < 1.3 * IMAGE.nbytes


@pytest.mark.netns
def test_a_slow_and_lossy_link_loses_and_doubles_nothing(tmp_path, link):
    name, cable = link
    made = sh("tc", "qdisc", "add", "dev", cable, "root", "netem", "delay", "40ms", "10ms", "loss", "5%")
    if made.returncode != 0:
        pytest.skip(f"needs the kernel's netem: {made.stderr.strip()}")
    with (
        KeyframeServer(networks(tmp_path), Spool(SpoolConfig(tmp_path / "state"))) as server,
        recon(tmp_path, name) as process,
    ):
        for index in range(FRAMES):
            server.offer(Frame(index, f"{index}.png", index, IMAGE, None))
        serve(server, lambda: server.num_queued == 0, 60)
        process.kill()
        assert [int(line) for line in process.communicate()[0].splitlines()] == list(range(FRAMES))
