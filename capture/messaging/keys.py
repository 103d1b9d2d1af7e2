"""CURVE keys: this machine's pair, the keys of clients that may connect, and the key of the server.

A folder holds `secret.key` (0600) and `public.key` of this machine, `allowed/NAME.key` with the public keys of other
machines that may connect here, and, where this machine connects to another one, that one's public key as `server.key`.
Processes on one machine share the folder; its own key is always let in. A key is 40 characters of Z85 text.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import zmq

from splatnode.capture.process.durable import remove_leftovers, write_whole

log = logging.getLogger(__name__)

SECRET, PUBLIC, SERVER, ALLOWED = "secret.key", "public.key", "server.key", "allowed"
_Z85 = re.compile(rb"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


class KeyFileError(PermissionError):
    """The keys cannot be used; the text names the file and what to do."""


@dataclass(frozen=True)
class Keys:
    public: bytes
    secret: bytes
    server: bytes  # of the machine whose services are connected to


def create_keys(folder: Path) -> bytes:
    """A new pair in `folder`, whose public key is returned. Raises KeyFileError where there is one already."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    (folder / ALLOWED).mkdir(mode=0o700, exist_ok=True)
    if (folder / SECRET).exists():
        raise KeyFileError(f"{folder / SECRET} is there already; remove it to replace this machine's keys")
    public, secret = zmq.curve_keypair()
    _write_key(folder / PUBLIC, public)
    _write_key(folder / SECRET, secret)  # last: where it is, the pair is
    return public


def allow(folder: Path, name: str, public: bytes) -> None:
    """Lets the machine `name` connect, at once: the list is read at each handshake."""
    if not re.fullmatch(r"[\w.-]{1,64}", name) or name.startswith("."):
        raise ValueError(f"a machine's name has letters, digits, - and _, got {name!r}")
    (folder / ALLOWED).mkdir(mode=0o700, parents=True, exist_ok=True)
    _write_key(folder / ALLOWED / f"{name}.key", checked_key(public, name))


def expect_server(folder: Path, public: bytes) -> None:
    """Connects to services of the machine with this key, and to no other."""
    _write_key(folder / SERVER, checked_key(public, SERVER))


def read_keys(folder: Path) -> Keys:
    """Raises KeyFileError where a key is missing, damaged, or the secret is readable by others."""
    secret_file = folder / SECRET
    secret = _read_key(secret_file)
    if secret_file.stat().st_mode & 0o077:
        raise KeyFileError(f"{secret_file} can be read by other users. Run: chmod 600 {secret_file}")
    public = _read_key(folder / PUBLIC)
    return Keys(public, secret, _read_key(folder / SERVER) if (folder / SERVER).exists() else public)


def checked_key(text: bytes, where: object) -> bytes:
    key = text.strip()
    if not _Z85.fullmatch(key):
        raise KeyFileError(f"{where}: expected a key of 40 characters, got {len(key)} bytes. Run: splatnode keys")
    return key


def _write_key(path: Path, key: bytes) -> None:
    remove_leftovers(path.parent)
    write_whole(path, [key + b"\n"])


def _read_key(path: Path) -> bytes:
    try:
        return checked_key(path.read_bytes(), path)
    except FileNotFoundError as error:
        raise KeyFileError(f"no key {path}. Run: splatnode keys {path.parent}") from error


class AllowList:
    """Tells at each handshake whether a key may connect; the interface is that of pyzmq's credentials provider."""

    def __init__(self, folder: Path, own: bytes) -> None:
        self.folder = folder
        self.own = own

    def callback(self, domain: str, key: bytes) -> bool:
        try:
            allowed = key == self.own or key in self._listed()
        except OSError as error:
            log.error("cannot read whom to let in, so nobody is: %s", error)
            return False
        if not allowed:
            log.warning("refused a connection: key %s is not in %s", key.decode("ascii", "replace"), self.folder)
        return allowed

    def _listed(self) -> set[bytes]:
        return {path.read_bytes().strip() for path in self.folder.glob("*.key")}
