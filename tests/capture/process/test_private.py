"""Folders and files of one user: private whatever the umask, and nothing that another one put there is taken."""

from __future__ import annotations

import logging
import os
import re
import stat

import pytest

from splatnode.capture.process.durable import write_whole
from splatnode.capture.process.lock import exclusive
from splatnode.capture.process.private import NotPrivate, StrayFile, own_files, private_folder, read_own
from tests.support.strays import STRAYS

INSTEAD = "network.directory"


def mode(path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


@pytest.fixture(params=[0o000, 0o022, 0o077, 0o777], ids=oct)
def umask(request):
    before = os.umask(request.param)
    yield
    os.umask(before)


def test_folders_and_files_are_private_whatever_the_umask(tmp_path, umask):
    folder = tmp_path / "a" / "b"
    private_folder(folder, INSTEAD, ours=False)
    assert mode(folder) == mode(folder.parent) == 0o700
    write_whole(folder / "file", [b"content"])
    assert mode(folder / "file") == 0o600 and read_own(folder / "file", 7) == b"content"
    with exclusive(folder / "lock"):
        assert mode(folder / "lock") & 0o077 == 0


def test_a_folder_that_was_open_is_closed_if_it_is_ours_and_refused_if_somebody_named_it(tmp_path):
    folder = tmp_path / "spool"
    folder.mkdir()
    folder.chmod(0o755)
    with pytest.raises(NotPrivate, match=f"chmod 700 {folder}.*set {INSTEAD}"):
        private_folder(folder, INSTEAD, ours=False)
    assert mode(folder) == 0o755  # it may be /etc
    private_folder(folder, INSTEAD, ours=True)
    assert mode(folder) == 0o700


def test_a_folder_into_which_everybody_could_write_is_looked_through_first(tmp_path):
    folder = tmp_path / "spool"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(NotPrivate, match="chmod 700"):
        private_folder(folder, INSTEAD, ours=True)
    folder.chmod(0o700)
    private_folder(folder, INSTEAD, ours=True)


def test_a_way_that_everybody_may_change_is_no_way(tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(NotPrivate, match=f"chmod o-w {tmp_path / 'open'}"):
        private_folder(tmp_path / "open" / "spool", INSTEAD, ours=True)
    assert not list((tmp_path / "open").iterdir())
    (tmp_path / "open").chmod(0o1777)  # as /tmp is: nobody can rename what is another one's
    private_folder(tmp_path / "open" / "spool", INSTEAD, ours=True)


def test_own_links_are_followed(tmp_path):
    (tmp_path / "disk").mkdir(mode=0o700)
    (tmp_path / "state").symlink_to("disk")
    private_folder(tmp_path / "state" / "spool", INSTEAD, ours=True)
    assert mode(tmp_path / "disk" / "spool") == 0o700
    (tmp_path / "here").symlink_to(tmp_path / "state")
    private_folder(tmp_path / "here", INSTEAD, ours=False)
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(OSError):
        private_folder(tmp_path / "circle", INSTEAD, ours=True)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        private_folder(tmp_path / "file", INSTEAD, ours=True)


@pytest.mark.parametrize("stray", STRAYS.values(), ids=STRAYS)
def test_what_is_no_file_is_neither_read_nor_waited_for(tmp_path, stray, caplog):
    stray(tmp_path / "1.frame")
    with pytest.raises(StrayFile):
        read_own(tmp_path / "1.frame", 100)
    (tmp_path / "10.frame").write_bytes(b"a")
    (tmp_path / "2.frame").write_bytes(b"a")
    (tmp_path / "copy of 2.frame").write_bytes(b"a")
    with caplog.at_level(logging.WARNING):
        assert [path.name for path in own_files(tmp_path, re.compile(r"[0-9]+\.frame"), ".frame")] == [
            "2.frame",
            "10.frame",
        ]
    (said,) = caplog.messages
    assert "files=2" in said and "1.frame, copy of 2.frame" in said
    with pytest.raises(OSError), exclusive(tmp_path / "1.frame"):
        pass


def test_a_file_is_not_read_where_it_is_larger_than_any_that_is_written(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(10 << 30)  # it takes no room on the disk
    with pytest.raises(StrayFile, match="10737418240 bytes; at most 1000"):
        read_own(tmp_path / "large", 1000)
