"""Who may look: on this machine's own address anybody on it, over a network who has the key."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.process.durable import write_atomically
from splatnode.capture.process.private import NotOwnerOnly, read_own

LOOPBACK = "127.0.0.1"
_KEY = re.compile(r"[A-Za-z0-9_-]{32,128}")
_KEY_BYTES = 32  # random ones, of a key
_LARGEST = 1000  # bytes of a file with a key
_OTHERS = 0o077


@dataclass(frozen=True)
class Access:
    """The rules of one server."""

    address: str  # numeric, that it listens on
    port: int
    key: str | None  # None: none is needed, which is so on a loopback address alone

    def __post_init__(self) -> None:
        if self.key is None and not ipaddress.ip_address(self.address).is_loopback:
            raise ValueError(f"a key is needed to listen on {self.address}, which other machines can reach")

    @property
    def cookie(self) -> str:
        """The name of the cookie that keeps the key: browsers send cookies to all ports of a machine alike."""
        return f"splatnode_{self.port}"

    def url(self, machine: str | None = None, key: str | None = None) -> str:
        """Returns the URL for a browser: with the address or the `machine`'s name, and the key or its substitute."""
        host = machine or (f"[{self.address}]" if ":" in self.address else self.address)
        return f"http://{host}:{self.port}/" + (f"?key={key or self.key}" if self.key else "")

    def is_allowed_host(self, host: str | None) -> bool:
        """Whether a request was meant for this server.

        Without a key only a name of the loopback address is, with any port, which ssh may have changed: a foreign page
        whose name was made to lead here (DNS rebinding) has another name.
        """
        return self.key is not None or _is_loopback(host or "")

    def is_key(self, text: str | None) -> bool:
        """Compared in a time that tells nothing of where they differ."""
        return self.key is not None and hmac.compare_digest((text or "").encode(errors="replace"), self.key.encode())

    def is_authorized(self, authorization: str | None, cookies: str | None) -> bool:
        """Whether a request has the key, in its cookie or as `Authorization: Bearer KEY`; any, where none is needed.

        The arguments are the headers of those names.
        """
        scheme, _, bearer = (authorization or "").partition(" ")
        is_told = scheme.lower() == "bearer" and self.is_key(bearer.strip())
        return self.key is None or is_told or self.is_key(_cookie(cookies, self.cookie))


def new_key() -> str:
    return secrets.token_urlsafe(_KEY_BYTES)


def load_or_create_key(path: Path) -> str:
    """The key in the file; a new one, which the file gets, where there is none, or where it was cut to nothing.

    Raises NotPrivate where others may read the file, ValueError for one that holds something else, OSError.
    """
    text = _read_key_file(path)
    if not text:
        write_atomically(path, [f"{new_key()}\n".encode()])
        text = _read_key_file(path)
    key = text.decode(errors="replace").strip()
    if not _KEY.fullmatch(key):
        raise ValueError(f"{path} must hold 32 to 128 letters, digits, - or _; remove it to get a new key")
    return key


def _read_key_file(path: Path) -> bytes:
    """Returns the content of this user's file; nothing where it is not there."""
    try:
        text = read_own(path, _LARGEST, only_ours=True)
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return b""
    if mode & _OTHERS:
        raise NotOwnerOnly(f"others may read {path}. Run: chmod 600 {path}")
    return text


def _cookie(header: str | None, name: str) -> str | None:
    """Finds one cookie: browsers send those of all programs on a machine, some of which no standard allows."""
    parts = (part.partition("=") for part in (header or "").split(";"))
    return next((value.strip() for found, _, value in parts if found.strip() == name), None)


def _is_loopback(host: str) -> bool:
    """Whether a Host header names the loopback address."""
    found = re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[^:\[\]]+)(:[0-9]{1,5})?", host)
    name = found[1].strip("[]").lower() if found else ""
    try:
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
