"""A camera that another package brings by an entry point is configured, found and recorded as one of ours."""

from __future__ import annotations

import sys

import pytest

from splatnode import command_line
from splatnode.capture.config import CaptureConfig, camera_opener, is_live
from splatnode.capture.frame import Frame
from splatnode.capture.process.config import ConfigError, load_config
from tests.capture.cameras.test_new_camera import CAMERA


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a package, robot-eyes, whose module robot_eyes has this text; returns a configuration of its camera."""

    def write(source, name="eyes"):
        (tmp_path / "robot_eyes.py").write_text(source)
        about = tmp_path / "robot_eyes-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: robot-eyes\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[splatnode.cameras]\n{name} = robot_eyes\n")
        config = tmp_path / "camera.yaml"
        config.write_text(f"camera: {{kind: {name}}}")
        return config

    monkeypatch.syspath_prepend(str(tmp_path))
    yield write
    sys.modules.pop("robot_eyes", None)


def test_it_streams_as_it_is_configured_and_its_configuration_is_checked(install):
    config = install(CAMERA)
    camera = load_config(config, CaptureConfig, ["camera.count=3"]).camera
    names = [frame.name for frame in camera_opener(camera)() if isinstance(frame, Frame)]
    assert names == ["0.png", "1.png", "2.png"] and is_live(camera)
    with pytest.raises(ConfigError, match=r"camera\.size: unknown key; allowed here: count"):
        load_config(config, CaptureConfig, ["camera.size=3"])
    with pytest.raises(ConfigError, match=r"camera\.kind: expected one of .*watched, eyes, got 'ears'"):
        load_config(config, CaptureConfig, ["camera.kind=ears"])


def test_the_command_line_finds_and_records_it(install, tmp_path, capsys):
    config = install(CAMERA)
    assert command_line.main(["find"]) == 0
    assert 'camera: {kind: eyes, device: "grey-1"}  # a camera for the test' in capsys.readouterr().out
    assert command_line.main(["record", str(config), "--out", str(tmp_path / "out"), "--set", "camera.count=1"]) == 0
    assert "1 frame in" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("import no_such_driver", r"robot_eyes of robot-eyes does not load \(ModuleNotFoundError: .*no_such_driver"),
        ("1 / 0", r"does not load \(ZeroDivisionError: .*install that package anew, or choose another kind"),
        ("class Config: pass", "has no stream; it must be a module that has both"),
        ("", "has no Config and no stream"),
    ],
)
def test_one_that_does_not_load_is_named_and_ends_nothing_else(install, source, told, capsys):
    config = install(source)
    with pytest.raises(ConfigError, match=rf"camera\.kind: eyes: the plug-in .*{told}"):
        load_config(config, CaptureConfig)
    assert command_line.main(["find"]) == 0 and "eyes: the plug-in robot_eyes" in capsys.readouterr().err


def test_ours_counts_where_both_have_a_name(install):
    config = install(CAMERA, name="synthetic")
    assert load_config(config, CaptureConfig).camera.module.__name__ == "splatnode.capture.cameras.synthetic"
