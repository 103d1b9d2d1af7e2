"""Mutants: a case that was drawn with one more thing done to it, for a fraction of what drawing costs.

Headers and documents are changed as trees where they are trees, so that most of what was sound stays so; the rest is
changed as bytes.
"""

from __future__ import annotations

import json
import random
from typing import Any

import msgspec

from tests.support.adversary import edges

_LONGEST_TREE = 3000  # bytes of a document that is changed as a tree: a longer one takes too long


def mutant(rng: random.Random, case: Any) -> Any:
    """A copy of a case (bytes, parts of a message, files by name, or several of these) that differs in one place."""
    if isinstance(case, bytes):
        return _document(rng, case)
    if isinstance(case, dict):
        names = [name for name, data in case.items() if data is not None]
        if not names:
            return case
        name = rng.choice(names)
        return case | {name: mutant(rng, case[name])}
    if isinstance(case, tuple):
        at = rng.randrange(len(case))
        return (*case[:at], mutant(rng, case[at]), *case[at + 1 :])
    return _parts(rng, case)


def _parts(rng: random.Random, parts: list[bytes]) -> list[bytes]:
    changed = list(parts)
    action = rng.random()
    if action < 0.6 and len(parts) > 1:
        changed[1] = _packed(rng, parts[1])
    elif action < 0.95 and parts:
        at = rng.randrange(len(parts))
        changed[at] = edges.damaged(rng, parts[at][:4096], 1)
    elif action < 0.97 and parts:
        changed.insert(rng.randrange(len(parts) + 1), rng.choice(parts))
    elif parts:
        del changed[rng.randrange(len(parts))]
    return changed


def _packed(rng: random.Random, head: bytes) -> bytes:
    """A header of MessagePack with one value changed."""
    try:
        return msgspec.msgpack.encode(edges.mangled(rng, msgspec.msgpack.decode(head), 1))
    except (ValueError, OverflowError, TypeError, RecursionError):  # it was none, or MessagePack cannot say it
        return edges.damaged(rng, head, 1)


def _document(rng: random.Random, data: bytes) -> bytes:
    if data[:1] in (b"{", b"[") and len(data) < _LONGEST_TREE and rng.random() < 0.7:
        try:
            tree = edges.mangled(rng, json.loads(data), 1)
            return json.dumps(tree, default=lambda value: value.hex()).encode("utf-8", "surrogatepass")
        except (ValueError, RecursionError):
            return edges.damaged(rng, data, 1)
    if rng.random() < 0.3 and len(data) < _LONGEST_TREE:
        return _word(rng, data)
    return edges.damaged(rng, data, 1)


def _word(rng: random.Random, data: bytes) -> bytes:
    """A text with one of its words exchanged."""
    words = data.split(b" ")
    words[rng.randrange(len(words))] = edges.number_text(rng).encode("utf-8", "surrogatepass")
    return b" ".join(words)
