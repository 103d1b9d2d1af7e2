"""Free space on a disk, asked of a small one where the machine lets us mount it."""

from __future__ import annotations

import os
import shutil
import subprocess
from types import SimpleNamespace

import pytest

from splatnode.capture.process.files import shortage


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("needs the right to mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_small_disk_has_room_for_little(small_disk):
    assert shortage(small_disk / "not" / "yet", 500_000, "it") == ""
    (small_disk / "file").write_bytes(bytes(400 << 10))
    assert shortage(small_disk / "a", 500_000, "it") == f"0.2 MB are free in {small_disk / 'a'}, and it may take 0.5 MB"


def test_a_file_system_that_does_not_tell_its_size_has_room(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=0, free=0))
    assert shortage(tmp_path, 1, "it") == ""
