"""The configurations that come with the package are written into a folder, all of them or none."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from splatnode.capture import cli
from splatnode.capture.config import CaptureConfig
from splatnode.capture.process.config import load_config
from splatnode.command_line import main
from tests.conftest import ROOT


def content_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_each_is_listed_with_one_line(capsys):
    assert main(["config"]) == 0
    *lines, advice = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(cli.examples())
    assert all(len(line) < 130 and line.endswith(".") for line in lines)
    assert "splatnode config --write" in advice


@pytest.mark.parametrize("there", [False, True])
def test_all_are_written_into_a_new_or_empty_folder(tmp_path, there, capsys):
    folder = tmp_path / "above" / "mine"
    if there:
        folder.mkdir(parents=True)
    assert main(["config", "--write", str(folder)]) == 0
    assert content_of(folder) == content_of(ROOT / "configs") and len(content_of(folder)) >= 10
    assert capsys.readouterr().out.splitlines() == [str(folder / name) for name in cli.examples()]
    assert os.listdir(tmp_path) == ["above"] and os.listdir(tmp_path / "above") == ["mine"]
    assert load_config(folder / "replay.yaml", CaptureConfig, ["camera.folder=photos"]).camera.kind == "folder"


def test_others_may_read_them_as_far_as_the_umask_allows(tmp_path):
    """A service that runs as another user reads its configuration."""
    before = os.umask(0o022)
    try:
        cli.write(tmp_path / "mine", {"udev/a.rules": b"rule"})
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "mine", tmp_path / "mine" / "udev" / "a.rules")]
    assert modes == [0o755, 0o644]


def test_what_is_there_stays(tmp_path, capsys):
    (tmp_path / "webcam.yaml").write_text("mine")
    for folder in (tmp_path, tmp_path / "webcam.yaml", tmp_path / "."):
        assert main(["config", "--write", str(folder)]) == 2
        said = capsys.readouterr()
        assert f"{folder} is there already, and nothing was written" in said.err and "new or empty" in said.err
        assert said.out == ""
    assert content_of(tmp_path) == {"webcam.yaml": b"mine"}


@pytest.mark.parametrize("name", [".", ".."])
def test_the_folder_that_one_is_in_is_not_replaced(tmp_path, monkeypatch, name, capsys):
    within = tmp_path / "within"
    within.mkdir()
    monkeypatch.chdir(within)
    assert main(["config", "--write", name]) == 2
    assert f"{name} is there already" in capsys.readouterr().err
    assert content_of(tmp_path) == {} and os.listdir(tmp_path) == ["within"] and os.listdir() == []


@pytest.mark.parametrize("failing", ["fsync", "rename"])
def test_a_failure_leaves_nothing(tmp_path, monkeypatch, failing, capsys):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr(cli.os, failing, full)
    assert main(["config", "--write", str(tmp_path / "above" / "mine")]) == 74
    assert f"No space left on device: {tmp_path / 'above' / 'mine'}" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []
