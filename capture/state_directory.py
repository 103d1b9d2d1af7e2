"""Where a daemon keeps what must outlive it."""

from __future__ import annotations

import os
from pathlib import Path


def state_directory() -> Path:
    """$STATE_DIRECTORY, which systemd sets, else $XDG_STATE_HOME/splatnode, else ~/.local/state/splatnode."""
    if os.environ.get("STATE_DIRECTORY"):
        return Path(os.environ["STATE_DIRECTORY"].split(":")[0])
    return Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser() / "splatnode"
