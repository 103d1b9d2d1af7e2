"""The release command: what it says of what it saw. `./run release` itself takes minutes, and the network."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from splatnode.recon.core import release
from splatnode.recon.core.release import Row, Trial, TrialFailed

REPORT = {
    "verdict": {"code": "OK", "message": "exact", "publishable": True},
    "held_out": {"psnr": 33.14},
    "seconds": {"total": 20.4},
}


def test_the_table_has_a_line_for_each_artefact_in_columns():
    rows = [
        Row("a.whl", 1_800_000, Trial(1_104_000_000, 61.2, "OK, 33.1 dB, 20 s"), "", good=True),
        Row("another.whl", 900_000, None, "not for this machine", good=True),
    ]
    assert release.table(rows).splitlines() == [
        "artefact     size    installed  in    demo",
        "a.whl        1.8 MB  1104 MB    61 s  OK, 33.1 dB, 20 s",
        "another.whl  0.9 MB  -          -     not for this machine",
    ]


def test_a_scene_that_is_not_published_or_not_measured_fails_the_trial():
    assert release.format_verdict(REPORT) == "OK, 33.1 dB, 20 s"
    refused = {"verdict": {"code": "TOO_FEW", "message": "of one", "publishable": False}}
    with pytest.raises(TrialFailed, match="the demo's verdict is TOO_FEW: of one"):
        release.format_verdict({**REPORT, **refused})
    with pytest.raises(TrialFailed, match="OK"):
        release.format_verdict({key: value for key, value in REPORT.items() if key != "held_out"})


def test_nothing_of_this_environment_reaches_the_trial():
    here = {
        "PATH": "/usr/bin",
        "PYTHONPATH": "/checkout",
        "VIRTUAL_ENV": "/venv",
        "SPLATNODE_ISA": "avx2",
        "CXX": "g++",
    }
    assert release.clean_environment(here, None) == {"PATH": "/usr/bin", "CXX": "g++"}
    assert release.clean_environment(here, Path("/e/bin")) == {"PATH": "/e/bin"}


def test_links_count_as_themselves(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_bytes(bytes(1000))
    (tmp_path / "link").symlink_to("folder")
    assert release.size_of(tmp_path) == 1000 + len("folder")


SAID = """
splatnode-0.1.0-py3-none-manylinux_2_17_x86_64.whl is consistent with
the following platform tag: "{}".

The wheel references external versioned symbols
"""


def test_the_tag_that_a_wheel_deserves_is_read_across_line_breaks():
    assert release.find_required_platform(SAID.format("manylinux_2_17_x86_64")) == "manylinux_2_17_x86_64"
    with pytest.raises(RuntimeError, match="does not say"):
        release.find_required_platform("nothing of the kind")


def test_a_wheel_that_needs_a_newer_system_than_its_name_says_is_refused(monkeypatch, tmp_path):
    deserved = "manylinux_2_34_x86_64"
    answer = subprocess.CompletedProcess([], 0, SAID.format(deserved), "")
    monkeypatch.setattr(release.subprocess, "run", lambda *_, **__: answer)
    with pytest.raises(RuntimeError, match="manylinux_2_17_x86_64.whl needs manylinux_2_34_x86_64"):
        release.check_tag(tmp_path / "splatnode-0.1.0-py3-none-manylinux_2_17_x86_64.whl")
    release.check_tag(tmp_path / f"splatnode-0.1.0-py3-none-{deserved}.whl")


def test_an_artefact_that_does_not_install_fails_loudly(monkeypatch, tmp_path, capsys):
    """The real trial, of a file that is no wheel: pip refuses it at once."""
    wheel = tmp_path / "splatnode-0.1.0-py3-none-any.whl"
    wheel.write_bytes(b"no wheel")
    row = release.run_trial(wheel.name, wheel)
    assert not row.good and row.cells == (wheel.name, "0.0 MB", "-", "-", "FAILED")
    assert "pip install" in capsys.readouterr().err


def test_whatever_fails_is_named_and_so_is_the_exit(monkeypatch, tmp_path, capsys):
    def refused(target: str, _: Path) -> Path:
        raise RuntimeError(f"no compiler for {target}")

    monkeypatch.setattr(release, "build_wheel", refused)
    monkeypatch.setattr(release, "_sdist_rows", lambda _: [Row("s.tar.gz", 1, None, "fine", good=True)])
    assert release.main(["--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "wheel for linux-x86_64: no compiler for linux-x86_64" in said.err and "NOT GOOD: wheel for" in said.err
    monkeypatch.setattr(release, "_wheel_row", lambda target, _: Row(target, 1, None, "fine", good=True))
    capsys.readouterr()
    assert release.main(["--out", str(tmp_path), "macos-arm64"]) == 0
    assert "macos-arm64" in (said := capsys.readouterr().out) and "linux" not in said and "all good" in said
    with pytest.raises(SystemExit):
        release.main(["atari"])


@pytest.mark.skipif(sys.platform != "linux", reason="names of Linux on x86-64 and aarch64")
def test_this_machine_can_run_one_target_at_most(monkeypatch):
    for family, target in (("x86_64", "linux-x86_64"), ("aarch64", "linux-aarch64"), ("riscv64", None)):
        monkeypatch.setattr(release, "machine", lambda family=family: family)
        assert release.target_here() == target
