"""CURVE keys: this machine's pair, the keys of clients that may connect, and the key of the server.

A folder holds `secret.key` (0600) and `public.key` of this machine, `allowed/NAME.key` with the public keys of other
machines that may connect here, and, where this machine connects to another one, that one's public key as `server.key`.
Processes on one machine share the folder; its own key is always let in. A key is 40 characters of Z85 text.
"""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path

import zmq

from splatnode.capture.process.files import (
    NotOwnerOnly,
    StrayFile,
    check_owner_only,
    read_own,
    remove_leftovers,
    write_atomically,
)
from splatnode.capture.process.system import outlast
from splatnode.capture.process.text import guard_untrusted

log = logging.getLogger(__name__)

SECRET, PUBLIC, SERVER, ALLOWED = "secret.key", "public.key", "server.key", "allowed"
_KEY_BYTES = 40
_LARGEST = 1000  # bytes of a key's file
_READ_S = 1.0  # that a handshake waits where a key's file cannot be opened
_MOST_SAID = 100  # refused keys and connections
_Z85 = re.compile(rb"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


class KeyFileError(PermissionError):
    """The keys cannot be used; the text names the file and what to do."""


@dataclass(frozen=True)
class Keys:
    public: bytes
    secret: bytes
    server: bytes  # of the machine whose services are connected to


def create_keys(folder: Path) -> bytes:
    """A new pair in `folder`, whose public key is returned; a secret key that was cut short is replaced, and said.

    Raises KeyFileError where there is a secret key already, NotPrivate where others could change what is there.
    """
    _make(folder)
    if _is_cut(folder / SECRET):
        log.warning("the secret key in %s was cut short: this is a new pair, whose public key others need", folder)
    elif os.path.lexists(folder / SECRET):
        raise KeyFileError(f"{folder / SECRET} is there already; remove it to replace this machine's keys")
    public, secret = _key_pair()
    _write_key(folder / PUBLIC, public)
    _write_key(folder / SECRET, secret)  # last: where it is, the pair is
    return public


def allow(folder: Path, name: str, public: bytes) -> None:
    """Lets the machine `name` connect, at once: the list is read at each handshake. Raises ValueError, NotPrivate."""
    if not re.fullmatch(r"[\w.-]{1,64}", name) or name.startswith("."):
        raise ValueError(f"a machine's name has letters, digits, - and _, got {name!r}")
    _make(folder)
    _write_key(folder / ALLOWED / f"{name}.key", check_key(public, name))


def expect_server(folder: Path, public: bytes) -> None:
    """Connects to services of the machine with this key, and to no other."""
    check_owner_only(folder)
    _write_key(folder / SERVER, check_key(public, SERVER))


def read_keys(folder: Path) -> Keys:
    """Raises KeyFileError where a key is missing, damaged, or others could read the secret or change any of them."""
    try:
        secret = _read_key(folder / SECRET)
        check_owner_only(folder)
        if (folder / SECRET).lstat().st_mode & 0o077:
            raise KeyFileError(f"{folder / SECRET} can be read by other users. Run: chmod 600 {folder / SECRET}")
        with guard_untrusted(KeyFileError, folder / SECRET):
            public = zmq.curve_public(secret)
        server = _read_key(folder / SERVER) if os.path.lexists(folder / SERVER) else public
    except NotOwnerOnly as error:
        raise KeyFileError(str(error)) from error
    return Keys(public, secret, server)


def check_key(text: bytes, where: object) -> bytes:
    """The key in `text`. Raises KeyFileError, which names `where` it came from."""
    key = text.strip()
    if not _Z85.fullmatch(key):
        raise KeyFileError(f"{where}: expected a key of 40 characters, got {len(key)} bytes. Run: splatnode keygen")
    return key


def _key_pair() -> tuple[bytes, bytes]:
    """Public and secret. A command line takes a word with a leading `-` for an option: no public key has one."""
    while True:
        public, secret = zmq.curve_keypair()
        if not public.startswith(b"-"):
            return public, secret


def _make(folder: Path) -> None:
    """The folder, and that of the allowed keys. Raises NotPrivate, OSError."""
    for each in (folder, folder / ALLOWED):
        each.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_owner_only(each)


def _is_cut(path: Path) -> bool:
    """True if the file has less than a key, as a full disk or a power cut may have left it."""
    try:
        return len(read_own(path, _LARGEST).strip()) < _KEY_BYTES
    except (FileNotFoundError, StrayFile):
        return False


def _write_key(path: Path, key: bytes) -> None:
    remove_leftovers(path.parent)
    write_atomically(path, [key + b"\n"])


def _read_key(path: Path) -> bytes:
    """Raises KeyFileError, and NotPrivate where others could change it."""
    try:
        return check_key(read_own(path, _LARGEST, only_ours=True), path)
    except FileNotFoundError as error:
        raise KeyFileError(f"no key {path}. Run: splatnode keygen {path.parent}") from error
    except StrayFile as error:
        raise KeyFileError(str(error)) from error


class AllowList:
    """Tells at each handshake whether a key may connect; the interface is that of pyzmq's credentials provider."""

    def __init__(self, folder: Path, own: bytes) -> None:
        self.folder = folder
        self.own = own
        self._said: set[str] = set()

    def callback(self, domain: str, key: bytes) -> bool:
        try:
            allowed = key == self.own or key in outlast(self._list_keys, "whom to let in", _READ_S)
        except OSError as error:
            self._say(logging.ERROR, f"cannot read whom to let in, so nobody is: {error}")
            return False
        if not allowed:
            self._say(logging.WARNING, f"refused a connection: key {key.decode('ascii', 'replace')} is not allowed")
        return allowed

    def _list_keys(self) -> set[bytes]:
        """The keys that only this user can have put there; the others are said. Raises NotPrivate, OSError."""
        for each in (self.folder.parent, self.folder):
            check_owner_only(each)
        found = set()
        for path in sorted(self.folder / name for name in os.listdir(self.folder) if name.endswith(".key")):
            try:
                found.add(_read_key(path))
            except (KeyFileError, NotOwnerOnly) as error:
                self._say(logging.ERROR, f"a key is not accepted: {error}")
        return found

    def _say(self, level: int, text: str) -> None:
        """Once: a stranger who tries again and again does not fill the journal."""
        if text not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(text)
            more = "; nothing further is said of connections" if len(self._said) == _MOST_SAID else ""
            log.log(level, "%s%s (allowed are those in %s)", text, more, self.folder)
