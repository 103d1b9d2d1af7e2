"""The configurations that come with the project can be read, and the services do what they say."""

from __future__ import annotations

import configparser

import pytest

from splatnode import command_line
from splatnode.capture.config import CaptureConfig
from splatnode.capture.process.config import ConfigError, load_config, parse_config, read_yaml
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.daemon.config import DaemonConfig as Daemon
from tests.conftest import ROOT

CAMERAS = [path for path in sorted((ROOT / "configs").glob("*.yaml")) if "camera" in read_yaml(path)]
SERVICES = sorted((ROOT / "configs" / "systemd").glob("*.service"))


def test_there_is_one_for_each_way_to_begin():
    assert {"oak.yaml", "remote.yaml", "replay.yaml", "webcam.yaml"} <= {path.name for path in CAMERAS}


def test_those_of_the_reconstruction_can_be_read():
    configs = ROOT / "configs"
    assert load_config(configs / "small_scene.yaml", Reconstruction).max_gaussians == 20000
    assert load_config(configs / "recon.yaml", Daemon) == Daemon()  # it shows the defaults
    network = load_config(configs / "remote_recon.yaml", Daemon).network
    assert network == load_config(configs / "remote.yaml", CaptureConfig).network
    assert {path.name for path in configs.glob("*.yaml")} == {
        *(path.name for path in CAMERAS),
        "recon.yaml",
        "remote_recon.yaml",
        "small_scene.yaml",
    }


@pytest.mark.parametrize(
    ("name", "schema", "said"),
    [
        ("webcam.yaml", Daemon, "camera: unknown key, which is of the configuration of splatnode capture; allowed"),
        (
            "recon.yaml",
            Reconstruction,
            "reconstruction: unknown key, which is of the configuration of splatnode recon",
        ),
        ("small_scene.yaml", Daemon, "size: unknown key, which belongs under reconstruction; allowed here"),
    ],
)
def test_one_that_is_of_another_verb_is_told(name, schema, said):
    with pytest.raises(ConfigError, match=said):
        load_config(ROOT / "configs" / name, schema)


@pytest.mark.parametrize("path", CAMERAS, ids=lambda path: path.name)
def test_configurations_can_be_read(path):
    config = load_config(path, CaptureConfig)
    assert config.camera.module.stream


def test_the_commented_calibration_can_be_used(tmp_path):
    text = (ROOT / "configs" / "webcam.yaml").read_text()
    line = next(line for line in text.splitlines() if "# intrinsics:" in line)
    path = tmp_path / "webcam.yaml"
    path.write_text(text.replace(line, line.replace("# ", "", 1)))
    assert load_config(path, CaptureConfig).camera.config.intrinsics.distortion == (0.1, -0.2, 0, 0, 0)


@pytest.mark.parametrize("rate", [0, 1e-300, float("inf")])
@pytest.mark.parametrize("kind", ["building", "depthai", "synthetic", "v4l2"])
def test_a_rate_that_no_camera_has_is_refused(kind, rate):
    with pytest.raises(ConfigError, match="camera.fps: expected float"):
        parse_config({"camera": {"kind": kind, "fps": rate}}, CaptureConfig)


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_services_run_a_verb_under_a_watchdog(path):
    unit = configparser.ConfigParser(interpolation=None)
    unit.read(path)
    service = unit["Service"]
    program, verb, *_ = service["ExecStart"].split()
    assert program.endswith("/splatnode") and verb in {verb.name for verb in command_line.list_verbs()}
    assert service["Type"] == "notify" and int(service["WatchdogSec"]) > 0
    assert service["RuntimeDirectoryMode"] == "0700"  # or the sockets would be refused
    assert service["MemoryMax"]  # the only bound on what a peer with a key can send
    assert service["Restart"] == "on-failure" and "2" in service["RestartPreventExitStatus"].split()
