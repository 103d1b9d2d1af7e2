"""Who is let in by the web viewer, and where its key is kept."""

from __future__ import annotations

import errno
import os
import stat

import pytest

from splatnode.capture.process.files import NotOwnerOnly
from splatnode.viewer.web import Access, invitation, load_or_create_key, new_key, resolve_address

KEY = "k" * 43


@pytest.mark.parametrize("address", ["0.0.0.0", "192.168.1.5", "::", "fe80::1"])
def test_what_other_machines_can_reach_needs_a_key(address):
    with pytest.raises(ValueError, match="a key is needed"):
        Access(address, 8347, None)
    assert Access(address, 8347, KEY).key == KEY and resolve_address(address, 0, None).key


@pytest.mark.parametrize("host", ["127.0.0.1:8347", "localhost:9000", "LOCALHOST", "[::1]:8347", "127.0.0.2"])
def test_without_a_key_the_loopback_address_is_asked_by_its_names(host):
    assert Access("127.0.0.1", 8347, None).is_allowed_host(host)


@pytest.mark.parametrize(
    "host", [None, "", "evil.example:8347", "127.0.0.1.evil.example", "192.168.1.5", "[::1", "a:b:c"]
)
def test_and_by_no_other_name(host):
    assert not Access("127.0.0.1", 8347, None).is_allowed_host(host)
    assert Access("0.0.0.0", 8347, KEY).is_allowed_host(host)  # the key decides


def test_the_key_may_come_in_a_cookie_or_a_header_and_must_be_right():
    access = Access("0.0.0.0", 8347, KEY)
    assert access.is_authorized(None, f"other=1; splatnode_8347={KEY}")
    assert access.is_authorized(f"Bearer {KEY}", None) and access.is_authorized(f"bearer  {KEY}", None)
    for cookies in (None, "", "splatnode_8347=k", f"splatnode_1={KEY}", "=;\x00", f"a=splatnode_8347={KEY}"):
        assert not access.is_authorized(None, cookies)
    for authorization in ("Bearer ", f"Bearer {KEY[:-1]}é", KEY, f"Basic {KEY}"):
        assert not access.is_authorized(authorization, None)
    assert not access.is_key(None) and not Access("127.0.0.1", 1, None).is_key(None)


@pytest.mark.parametrize("others", ['prefs={"theme":"dark"}', "a=x y", "name@x=1", "path=/", "é=ü", "lonely"])
def test_cookies_of_other_programs_have_no_say(others):
    access = Access("0.0.0.0", 8347, KEY)
    for cookies in (f"{others}; splatnode_8347={KEY}", f"splatnode_8347={KEY}; {others}"):
        assert access.is_authorized(None, cookies)


def test_two_keys_differ_and_a_file_keeps_one_for_this_user_alone(tmp_path):
    assert new_key() != new_key() and len(new_key()) >= 43
    path = tmp_path / "web.key"
    key = load_or_create_key(path)
    assert load_or_create_key(path) == key and stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o640)
    with pytest.raises(NotOwnerOnly, match="chmod 600"):
        load_or_create_key(path)


def test_a_file_that_was_cut_to_nothing_gets_a_key(tmp_path):
    """By a full disk, a power cut, or a process that was killed before it wrote."""
    path = tmp_path / "web.key"
    path.touch(0o600)
    key = load_or_create_key(path)
    assert load_or_create_key(path) == key == path.read_text().strip() and stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]
    path.write_text("")
    path.chmod(0o644)
    with pytest.raises(NotOwnerOnly, match="chmod 600"):
        load_or_create_key(path)
    assert path.read_text() == ""


def test_a_key_that_the_disk_does_not_take_leaves_no_file(tmp_path, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        load_or_create_key(tmp_path / "web.key")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["short", "k" * 31, "k" * 200, "k" * 40 + " " + "k" * 5])
def test_a_file_without_a_key_is_refused(tmp_path, text):
    path = tmp_path / "web.key"
    with open(os.open(path, os.O_WRONLY | os.O_CREAT, 0o600), "w") as file:
        file.write(text)
    with pytest.raises(ValueError, match="remove it to get a new key"):
        load_or_create_key(path)


def test_the_invitation_names_ssh_on_loopback_and_says_what_a_network_means(tmp_path):
    alone = invitation(Access("127.0.0.1", 8347, None), None)
    assert "http://127.0.0.1:8347/ " in alone and "ssh -L 8347:127.0.0.1:8347 " in alone
    open_to_all = invitation(Access("192.168.1.5", 8347, KEY), None)
    assert f"http://192.168.1.5:8347/?key={KEY} " in open_to_all and "not encrypted" in open_to_all
    kept = invitation(Access("fe80::1", 8347, KEY), tmp_path / "web.key")
    assert KEY not in kept and "http://[fe80::1]:8347/?key=KEY " in kept and "web.key" in kept
