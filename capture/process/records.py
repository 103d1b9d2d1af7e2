"""Records out of JSON and of plain values, in any thread.

msgspec learns a type when it first meets it, and keeps what it has learnt with the type before it knows all of it. Two
threads that meet a type at once can end the process (segmentation fault, msgspec 0.22), so they take turns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import msgspec

Decoder = msgspec.msgpack.Decoder
_TURN = threading.RLock()


def record_of(value: Any, kind: Any, dec_hook: Callable[[type, Any], Any] | None = None) -> Any:
    """`msgspec.convert`: the plain `value` as a `kind`. Raises msgspec.ValidationError."""
    with _TURN:
        return msgspec.convert(value, kind, dec_hook=dec_hook)


def record_in(data: bytes | str, kind: Any) -> Any:
    """`msgspec.json.decode`: the `kind` in JSON. Raises msgspec.DecodeError, msgspec.ValidationError."""
    with _TURN:
        return msgspec.json.decode(data, type=kind)


def decoder_of(kind: Any) -> Decoder:
    """A decoder of MessagePack, which threads may share."""
    with _TURN:
        return Decoder(kind)
