"""Where a daemon keeps what must outlive it."""

from __future__ import annotations

import os
from pathlib import Path


def state_directory() -> Path:
    """$STATE_DIRECTORY, which systemd sets, else $XDG_STATE_HOME/splatnode, else ~/.local/state/splatnode."""
    if os.environ.get("STATE_DIRECTORY"):
        return Path(os.environ["STATE_DIRECTORY"].split(":")[0])
    named = os.environ.get("XDG_STATE_HOME")
    return (Path(named).expanduser() if named else home("XDG_STATE_HOME") / ".local" / "state") / "splatnode"


def home(instead: str) -> Path:
    """The user's own folder. Raises ValueError, which names the variable to set `instead`, where there is none.

    A number that a container or a service runs as is a user without one.
    """
    try:
        return Path.home()
    except RuntimeError as error:
        raise ValueError(f"user {os.getuid()} has no home directory; set {instead} to a folder") from error
