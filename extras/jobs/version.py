"""Which splatnode this is: its version, and a digest of its sources, which a version in development does not tell."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

_DIGITS = 8  # hexadecimal
_ROOMS = ("capture", "recon")  # whose code results depend on


@cache
def own_version() -> str:
    """Such as "0.1.0 (1f3a5b7c)"; two that are the same give the same results on one kind of processor."""
    package = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for room in _ROOMS:
        for file in sorted((package / room).rglob("*.py")) + sorted((package / room / "core").glob("*.cpp")):
            digest.update(str(file.relative_to(package)).encode() + b"\0" + file.read_bytes())
    try:
        version = metadata.version("splatnode")
    except metadata.PackageNotFoundError:
        version = "not installed"
    return f"{version} ({digest.hexdigest()[:_DIGITS]})"


def other_version(begun_with: str) -> str | None:
    """Returns a message if this machine's splatnode is not the one that began the work; None if it is."""
    if (version := own_version()) == begun_with:
        return None
    there = f"the worker on {platform.node()} has splatnode {version}, the work was begun with {begun_with}"
    return f"{there}; install the same on all machines"
