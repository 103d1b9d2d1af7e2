"""A new camera is one new file in capture/cameras, and nothing elsewhere."""

from __future__ import annotations

import pytest

from splatnode import command_line
from splatnode.capture.config import CaptureConfig, camera_opener, is_live
from splatnode.capture.frame import Frame
from splatnode.capture.process.config import ConfigError, load_config
from tests.support.fake_camera import fake_camera

CAMERA = '''
"""Grey frames."""

import msgspec
import numpy as np

from splatnode.capture.frame import Frame

LIVE = True


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    count: int = 2


def stream(config):
    for index in range(config.count):
        yield Frame(index, f"{index}.png", index, np.full((48, 64, 3), 128, np.uint8), None)


def find():
    return [{"device": "grey-1", "description": "a camera for the test"}]
'''


@pytest.fixture
def config(tmp_path, monkeypatch):
    """A configuration of the new camera, whose file lies where the package's other cameras lie."""
    with fake_camera("grey", CAMERA, tmp_path, monkeypatch) as path:
        yield path


def test_its_frames_are_streamed_as_it_is_configured(config):
    camera = load_config(config, CaptureConfig, ["camera.count=3"]).camera
    names = [frame.name for frame in camera_opener(camera)() if isinstance(frame, Frame)]
    assert names == ["0.png", "1.png", "2.png"] and is_live(camera)


def test_its_configuration_is_checked_and_it_is_named_among_the_kinds(config):
    with pytest.raises(ConfigError, match=r"camera\.size: unknown key; allowed here: count"):
        load_config(config, CaptureConfig, ["camera.size=3"])
    with pytest.raises(ConfigError, match="expected one of .*folder, grey, .*synthetic.*got 'gray'"):
        load_config(config, CaptureConfig, ["camera.kind=gray"])


def test_the_command_line_finds_and_records_it(config, tmp_path, capsys):
    assert command_line.main(["list-cameras"]) == 0
    assert 'camera: {kind: grey, device: "grey-1"}  # a camera for the test' in capsys.readouterr().out
    assert command_line.main(["record", str(config), "--out", str(tmp_path / "out"), "--set", "camera.count=1"]) == 0
    assert "1 frame in" in capsys.readouterr().out
