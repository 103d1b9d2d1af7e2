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
_TOO_DEEP = "values may not be nested as deeply as these"


def record_of(value: Any, kind: Any, dec_hook: Callable[[type, Any], Any] | None = None) -> Any:
    """`msgspec.convert`: the plain `value` as a `kind`. Raises msgspec.ValidationError, and nothing else."""
    with _TURN:
        try:
            return msgspec.convert(value, kind, dec_hook=dec_hook)
        except RecursionError as error:
            raise msgspec.ValidationError(_TOO_DEEP) from error


def record_in(data: bytes | str, kind: Any) -> Any:
    """`msgspec.json.decode`: the `kind` in JSON.

    Raises msgspec.DecodeError, msgspec.ValidationError, and nothing else: msgspec itself has further errors for a text
    that is no UTF-8 and for one that is nested deeply.
    """
    with _TURN:
        try:
            return msgspec.json.decode(data, type=kind)
        except RecursionError as error:
            raise msgspec.DecodeError(_TOO_DEEP) from error
        except UnicodeError as error:
            raise msgspec.DecodeError(f"JSON is UTF-8: {error}") from error


def decoder_of(kind: Any) -> Decoder:
    """A decoder of MessagePack, which threads may share."""
    with _TURN:
        return Decoder(kind)
