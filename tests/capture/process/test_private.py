"""Folders and files of one user: private whatever the umask, and nothing that another one put there is taken."""

from __future__ import annotations

import logging
import os
import re
import stat
import tempfile

import pytest

from splatnode.capture.process.files import (
    NotOwnerOnly,
    StrayFile,
    check_owner_only,
    check_way,
    exclusive,
    list_own_files,
    make_owner_only_folder,
    open_itself,
    read_own,
    temporary_folder,
    write_atomically,
)
from tests.support.second_user import OTHER, as_other, shared_tmp  # noqa: F401  a fixture
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
    make_owner_only_folder(folder, INSTEAD, ours=False)
    assert mode(folder) == mode(folder.parent) == 0o700
    write_atomically(folder / "file", [b"content"])
    assert mode(folder / "file") == 0o600 and read_own(folder / "file", 7) == b"content"
    with exclusive(folder / "lock"):
        assert mode(folder / "lock") & 0o077 == 0


def test_a_folder_that_was_open_is_closed_if_it_is_ours_and_refused_if_somebody_named_it(tmp_path):
    folder = tmp_path / "spool"
    folder.mkdir()
    folder.chmod(0o755)
    with pytest.raises(NotOwnerOnly, match=f"chmod 700 {folder}.*set {INSTEAD}"):
        make_owner_only_folder(folder, INSTEAD, ours=False)
    assert mode(folder) == 0o755  # it may be /etc
    make_owner_only_folder(folder, INSTEAD, ours=True)
    assert mode(folder) == 0o700


def test_a_folder_into_which_everybody_could_write_is_looked_through_first(tmp_path):
    folder = tmp_path / "spool"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(NotOwnerOnly, match="chmod 700"):
        make_owner_only_folder(folder, INSTEAD, ours=True)
    folder.chmod(0o700)
    make_owner_only_folder(folder, INSTEAD, ours=True)


def test_a_way_that_everybody_may_change_is_no_way(tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(NotOwnerOnly, match=f"chmod go-w {tmp_path / 'open'}"):
        make_owner_only_folder(tmp_path / "open" / "spool", INSTEAD, ours=True)
    assert not list((tmp_path / "open").iterdir())
    (tmp_path / "open").chmod(0o1777)  # as /tmp is: nobody can rename what is another one's
    make_owner_only_folder(tmp_path / "open" / "spool", INSTEAD, ours=True)


MODES = {0o775: "chmod go-w", 0o757: "chmod go-w", 0o2770: "chmod go-w", 0o1777: None, 0o1775: None, 0o755: None}


@pytest.mark.parametrize("where", ["folder", "above a folder", "behind a link", "above what a link leads to"])
@pytest.mark.parametrize(("found", "remedy"), MODES.items(), ids=[f"{each:04o}" for each in MODES])
def test_a_way_is_taken_as_sshd_takes_one(tmp_path, where, found, remedy):
    """Every folder on it, and on that to which a link leads, is closed to a group and to others, or sticky."""
    way = tmp_path / "way"
    (way / "a" / "b").mkdir(parents=True, mode=0o700)
    (tmp_path / "link").symlink_to(way / "a")
    spool = (tmp_path / "link" / "b" if "link" in where else way / "a" / "b") / "spool"
    changed = {"folder": way / "a" / "b", "behind a link": way / "a"}.get(where, way)
    changed.chmod(found)
    uses = (
        lambda: make_owner_only_folder(spool, INSTEAD, ours=True),
        lambda: check_way(spool),
        lambda: check_owner_only(spool),
        lambda: read_own(spool / "file", 10, only_ours=True),
    )
    if remedy is None:
        uses[0]()
        write_atomically(spool / "file", [b"content"])
        for use in uses[1:]:
            use()
        return
    for use in uses:
        with pytest.raises(NotOwnerOnly, match=f"{changed} must be .* mode {found:04o}: .*run: {remedy} {changed}"):
            use()
    os.system(f"{remedy} {changed}")
    uses[0]()


def test_a_way_of_another_user_is_none(shared_tmp):  # noqa: F811
    as_other("os.mkdir(sys.argv[1], 0o755)", shared_tmp / "theirs")
    as_other("os.symlink(sys.argv[1], sys.argv[2])", "/", shared_tmp / "link")
    for name, remedy in {"theirs": "chown", "link": "chown -h"}.items():
        with pytest.raises(NotOwnerOnly, match=f"user {OTHER} .*run: {remedy} {os.geteuid()} {shared_tmp / name}"):
            make_owner_only_folder(shared_tmp / name / "tmp" / "spool", INSTEAD, ours=True)


def test_temporary_files_lie_where_nobody_else_can_change_them(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with temporary_folder("a-") as folder:
        assert mode(folder) == 0o700
    assert not folder.exists()
    tmp_path.chmod(0o777)
    with pytest.raises(NotOwnerOnly, match=r"chmod go-w.*\$TMPDIR"), temporary_folder("a-"):
        pass
    tmp_path.chmod(0o1777)
    with temporary_folder("a-") as folder:
        assert folder.is_dir()


@pytest.mark.parametrize("opens", ["wb", "a+b", "w"])
def test_a_link_is_not_written_through(tmp_path, opens):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    with pytest.raises(OSError, match="a link lies where this file belongs; remove it"):
        open_itself(tmp_path / "link", opens)
    with open_itself(tmp_path / "new", opens) as file:
        file.write("a" if opens == "w" else b"a")
    assert (tmp_path / "mine").read_text() == "mine" and (tmp_path / "new").read_text() == "a"


def test_own_links_are_followed(tmp_path):
    (tmp_path / "disk").mkdir(mode=0o700)
    (tmp_path / "state").symlink_to("disk")
    make_owner_only_folder(tmp_path / "state" / "spool", INSTEAD, ours=True)
    assert mode(tmp_path / "disk" / "spool") == 0o700
    (tmp_path / "here").symlink_to(tmp_path / "state")
    make_owner_only_folder(tmp_path / "here", INSTEAD, ours=False)
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(OSError):
        make_owner_only_folder(tmp_path / "circle", INSTEAD, ours=True)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        make_owner_only_folder(tmp_path / "file", INSTEAD, ours=True)


@pytest.mark.parametrize("stray", STRAYS.values(), ids=STRAYS)
def test_what_is_no_file_is_neither_read_nor_waited_for(tmp_path, stray, caplog):
    stray(tmp_path / "1.frame")
    with pytest.raises(StrayFile):
        read_own(tmp_path / "1.frame", 100)
    (tmp_path / "10.frame").write_bytes(b"a")
    (tmp_path / "2.frame").write_bytes(b"a")
    (tmp_path / "copy of 2.frame").write_bytes(b"a")
    with caplog.at_level(logging.WARNING):
        assert [path.name for path in list_own_files(tmp_path, re.compile(r"[0-9]+\.frame"), ".frame")] == [
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
