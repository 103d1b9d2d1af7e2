"""One configuration with several cameras: a process for each, of which one may die without the others."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from splatnode import command_line
from splatnode.capture import cli
from splatnode.capture.config import CaptureConfig
from splatnode.capture.frame import Frame
from splatnode.capture.messaging.keyframe_queue import KeyframeClient
from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import ConfigError, parse_config
from tests.capture.messaging.test_sockets import wait_for
from tests.conftest import ROOT

CAMERAS = {"left": {"kind": "synthetic", "views": 2}, "right": {"kind": "synthetic", "views": 3, "body_mask": "m.png"}}


def test_each_camera_has_a_configuration_of_its_own():
    raw = {"cameras": CAMERAS, "selection": {"every_frame": True}}
    assert cli.list_cameras(raw) == ["left", "right"] and cli.list_cameras({"camera": {}}) == []
    chosen = parse_config(cli.choose_camera(raw, "right"), CaptureConfig)
    assert (chosen.camera_id, chosen.camera.config.views, str(chosen.body_mask)) == ("right", 3, "m.png")
    assert chosen.selection.every_frame


@pytest.mark.parametrize(
    ("raw", "told"),
    [
        ({"cameras": []}, "cameras: expected a camera for each camera id"),
        ({"cameras": {"left": "v4l2"}}, "cameras: expected a camera for each camera id"),
        ({"cameras": {"a/b": CAMERAS["left"]}}, "letters, digits, - or _; got 'a/b'"),
        ({"cameras": CAMERAS, "camera": {}}, "camera: unknown key beside cameras"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_refused(raw, told):
    with pytest.raises(ConfigError, match=told):
        cli.list_cameras(raw)


def test_an_unknown_camera_id_is_refused_with_those_that_there_are(tmp_path, capsys):
    config = tmp_path / "cameras.yaml"
    config.write_text("cameras: {left: {kind: synthetic}, right: {kind: synthetic, wheels: 4}}\n")
    assert command_line.main(["capture", str(config), "--camera-id", "up"]) == 2
    assert "--camera-id: expected one of left, right, got 'up'" in capsys.readouterr().err
    assert command_line.main(["capture", str(config)]) == 2  # before any process is started
    assert "camera.wheels: unknown key" in capsys.readouterr().err


def test_a_camera_whose_process_fails_is_started_again_and_the_others_go_on(monkeypatch, tmp_path):
    monkeypatch.setattr(cli, "RESTART_S", 0.1)
    program = (
        "import pathlib, sys; p = pathlib.Path(sys.argv[1]); n = len(p.read_text()) if p.exists() else 0;"
        "p.write_text('x' * (n + 1)); sys.exit(0 if n else 69)"
    )
    monkeypatch.setattr(cli.python, "command", lambda *parts: [sys.executable, "-c", program, str(tmp_path / parts[4])])
    assert cli.run_captures(tmp_path, ["left", "right"]) == 0
    assert [(tmp_path / each).read_text() for each in ("left", "right")] == ["xx", "xx"]


def test_both_cameras_frames_come_and_ctrl_c_ends_all(tmp_path):
    config = tmp_path / "cameras.yaml"
    config.write_text(
        "cameras:\n  left: {kind: synthetic, views: 1, width: 160, height: 120}\n"
        "  right: {kind: synthetic, views: 1, width: 160, height: 120}\nselection: {every_frame: true}\n"
        f"spool: {{directory: {tmp_path / 'state'}}}\nnetwork: {{directory: {tmp_path / 'run'}}}\n"
    )
    process = subprocess.Popen([sys.executable, "-m", "splatnode", "capture", str(config)], cwd=ROOT)
    network = Network(directory=tmp_path / "run")
    try:
        for each in ("left", "right"):
            with KeyframeClient(network, camera_id=each) as client:
                received = wait_for(lambda client=client: client.receive(0.05))
                assert (
                    isinstance(received.frame, Frame)
                    and received.frame.camera_id == each
                    and received.frame.name.startswith(f"{each}_")
                )
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert not [path for path in (tmp_path / "run").iterdir() if path.is_socket()]
    finally:
        process.kill()
