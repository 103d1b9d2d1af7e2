"""The files of a checkpoint that can be made anew from its keyframes: where one is missing or damaged, it is."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.messaging.message_file import read_message, write_message
from splatnode.capture.messaging.wire import Message, decode, encode
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.recon.daemon.checkpoint.ledger import LIMITS

log = logging.getLogger(__name__)

MADE_ANEW = ("graph", "judgement", "fallbacks", "scene", "pointmaps")
SHOWN = ("scene", "pointmaps")  # those of them that only a scene that grows has need of


def save(directory: Path, name: str, header: msgspec.Struct, arrays: list[Any]) -> None:
    """Whole or not at all. Raises OSError."""
    write_message(directory / name, encode(header, arrays))


def load(directory: Path, name: str, schema: Any) -> Message[Any] | None:
    """Loads what `save` wrote under this name; None where it is missing or damaged."""
    try:
        return decode(read_message(directory / name), schema, LIMITS)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise_shortage(error)
        log.warning("%s of the checkpoint is made anew: %s", name, error)
        return None


def remove(directory: Path, *names: str) -> None:
    """Raises OSError."""
    for name in names:
        (directory / name).unlink(missing_ok=True)
