"""What a camera that may have no frame for long gives in place of one: it is there, and has nothing new."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KeepAlive:
    """A loss is over with it as with a frame. Nobody but the reader gets it (capture/reader.py)."""
