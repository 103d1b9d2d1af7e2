"""`splatnode recon --finish`: all that came is in final scenes, the scenes of a map are merged, and the node ends."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading

from msgspec.structs import replace

from splatnode.recon.daemon import node
from splatnode.recon.daemon.node import Daemon
from tests.conftest import ROOT
from tests.recon.daemon.test_daemon import PATIENCE_S, config, index, peer, report  # noqa: F401  (fixtures)
from tests.support.synthetic import photographs


def run_in_thread(config, finish: bool) -> tuple[threading.Thread, list[Daemon]]:  # noqa: F811
    made: list[Daemon] = []
    opened = threading.Event()

    def run() -> None:
        with Daemon(config, threading.Event(), finish) as daemon:
            made.append(daemon)
            opened.set()
            daemon.run()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert opened.wait(PATIENCE_S)
    return thread, made


def serve_until(peer, thread: threading.Thread) -> None:  # noqa: F811
    """Sends what capture keeps until the node has ended."""
    while thread.is_alive():
        peer.server.serve(0.02)


def test_a_node_that_finishes_works_in_what_waits_merges_the_map_and_ends(config, peer):  # noqa: F811
    """A scene that is full goes on as the next one: both are one map."""
    frames = photographs()[:7]
    for frame in frames:
        peer.server.offer(frame)
    thread, (daemon,) = run_in_thread(replace(config, max_views=4), finish=True)
    serve_until(peer, thread)
    assert daemon.left == "" and peer.server.num_queued == 0
    places = index(config)
    assert len(places) == 2 and {place["state"] for place in places} <= {"here", "finished"}
    merged = report(config.out / "map-scene-0001")
    assert len(merged["scenes"]) == 2 and not merged["scenes_left_out"]
    cameras = json.loads((config.out / "map-scene-0001" / "cameras.json").read_text())["cameras"]
    assert {camera["name"] for camera in cameras} == {frame.name for frame in frames}


def test_a_running_node_is_asked_to_finish_and_waited_for(config, peer, tmp_path, monkeypatch, capsys):  # noqa: F811
    for frame in photographs()[:3]:
        peer.server.offer(frame)
    thread, (daemon,) = run_in_thread(config, finish=False)
    monkeypatch.setattr(node, "load_config", lambda path, kind: config)
    found: list[int] = []
    asking = threading.Thread(target=lambda: found.append(node._wait_for_running_node(config, threading.Event())))
    asking.start()
    serve_until(peer, thread)
    asking.join(PATIENCE_S)
    assert found == [0] and daemon.left == ""
    assert not index(config)[0]["provisional"]
    assert not list(config.out.glob("map-*"))  # one scene is its own map


def test_what_cannot_be_finished_is_told(config, peer, monkeypatch):  # noqa: F811
    """The disk takes no result: the node ends, and does not say that all is done."""

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    for frame in photographs()[:3]:
        peer.server.offer(frame)
    monkeypatch.setattr("splatnode.recon.daemon.output.write_result_folder", fail)
    thread, (daemon,) = run_in_thread(config, finish=True)
    serve_until(peer, thread)
    assert "No space left" in daemon.left


def test_an_empty_checkpoint_is_no_scene(tmp_path):
    (tmp_path / "run").mkdir(mode=0o700)
    settings = f"network: {{directory: {tmp_path}/run}}\ncheckpoint: {tmp_path}/none\nout: {tmp_path}/out\n"
    (tmp_path / "recon.yaml").write_text(settings)
    command = [sys.executable, "-m", "splatnode", "recon", str(tmp_path / "recon.yaml"), "--finish"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 65 and "no scene lies in" in ended.stderr


def test_flags_of_another_node_are_named():
    args = argparse.Namespace(checkpoint=None, out="elsewhere", marker=None, frame="upright", gravity=None)
    assert node._list_own_flags(args) == ["--out", "--frame"]
    assert node._list_own_flags(argparse.Namespace(**{**vars(args), "out": None, "frame": None})) == []
