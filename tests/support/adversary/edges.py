"""Numbers and texts at which readers go wrong."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

INTEGERS = (
    *(0, -1, 1, 2, 3, 4, 255, 256, 65535, 65536, 2**24),
    *(2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53 + 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1),
    *(-(2**31), -(2**31) - 1, -(2**63), 10**6, 10**9, 10**15),
)
FLOATS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    math.nan,
    math.inf,
    -math.inf,
    5e-324,
    1e-308,
    1e-12,
    1e12,
    1e13,
    1e38,
    1e39,
    1e308,
)
TEXTS = (
    "",
    ".",
    "..",
    "../../../outside",
    "/outside",
    "a/b.png",
    "\0",
    "a\nevent=keyframe name=b",
    "event=stopped",
    "%s %d %n",
    "\x1b]0;title\x07\x1b[2J",
    "\r<0>level=emerg",
    "gpj.\u202eexe",
    "\u2028\u2029\x85\ufeff",
    "<img src=x onerror=alert(1)>",
    "nan",
    "1e400",
    "x" * 255,
    "x" * 256,
    "x" * 5000,
    "\U0010ffff" * 70,
    "con.png",
    "-rf",
)
NUMBER_TEXTS = (
    *("nan", "-nan", "inf", ".inf", "-.inf", "1e400", "-1e400", "1e-400", "5e-324", "1e308", "1e155", "-0", "0"),
    *("1e-320", "0x10", "0o7", "1_0", "1,5", "+1", "1e", ".", "true", "~", "[1]", "{}", "''", '"', "#", "١٢", "²", "½"),
    *(
        "9" * 25,
        "9" * 400,
        "9" * 5000,
        "0." + "0" * 500 + "1",
        "190:20:30",
        "2026-11-23",
        "\0",
        "\u2028",
        "\x85",
        "\ufeff",
    ),
)


def integer(rng: random.Random) -> int:
    return rng.choice(INTEGERS) if rng.random() < 0.7 else rng.randrange(-(2**16), 2**16)


def number(rng: random.Random) -> float:
    return rng.choice(FLOATS) if rng.random() < 0.7 else rng.uniform(-1e3, 1e3)


def text(rng: random.Random) -> str:
    return rng.choice(TEXTS)


def number_text(rng: random.Random) -> str:
    """What stands where a text has a number."""
    kind = rng.randrange(4)
    return (rng.choice(NUMBER_TEXTS), str(integer(rng)), repr(number(rng)), text(rng))[kind]


def odd(rng: random.Random, usual: object, share: float = 0.03) -> str:
    """A usual number as text, or now and then an odd one."""
    return number_text(rng) if rng.random() < share else str(usual)


def unsigned(rng: random.Random, bits: int) -> int:
    """An edge number as it wraps in a field of so many bits."""
    return integer(rng) % 2**bits


def single(rng: random.Random) -> bytes:
    """A float32: an edge number, a NaN that signals when it is computed with, or any bits at all."""
    chance = rng.random()
    if chance < 0.05:
        return struct.pack("<I", rng.choice((0x7FA00000, 0x7F800001, 0xFFA00000)))
    if chance < 0.3:
        return rng.randbytes(4)
    value = number(rng)
    return struct.pack("<f", value if not math.isfinite(value) or abs(value) < 3e38 else math.copysign(math.inf, value))


def hostile(rng: random.Random, depth: int = 2) -> Any:
    """A value of any type that MessagePack, JSON and YAML know."""
    kind = rng.randrange(8 if depth else 6)
    if kind == 6:
        return [hostile(rng, depth - 1) for _ in range(rng.choice((0, 1, 3, 40)))]
    if kind == 7:
        return {text(rng): hostile(rng, depth - 1) for _ in range(rng.choice((0, 1, 3)))}
    return (None, rng.random() < 0.5, integer(rng), number(rng), text(rng), rng.randbytes(rng.choice((0, 1, 40))))[kind]


def mangled(rng: random.Random, tree: Any, times: int) -> Any:
    """A copy of a tree of dicts and lists with so many things done to it, anywhere."""
    for _ in range(times):
        tree = _mangled_once(rng, tree)
    return tree


def _mangled_once(rng: random.Random, tree: Any) -> Any:
    if isinstance(tree, dict) and tree and rng.random() < 0.9:
        key = rng.choice(list(tree))
        changed = dict(tree)
        action = rng.random()
        if action < 0.08:
            del changed[key]
        elif action < 0.14:
            changed[text(rng)] = changed.pop(key)
        else:
            changed[key] = _mangled_once(rng, tree[key])
        return changed
    if isinstance(tree, (list, tuple)) and tree and rng.random() < 0.9:
        changed, index = list(tree), rng.randrange(len(tree))
        action = rng.random()
        if action < 0.05:
            del changed[index]
        elif action < 0.1:
            changed *= rng.choice((2, 50))
        else:
            changed[index] = _mangled_once(rng, tree[index])
        return changed
    if isinstance(tree, float) and rng.random() < 0.7:
        return number(rng)
    if isinstance(tree, int) and rng.random() < 0.7:
        return integer(rng)
    if isinstance(tree, str) and rng.random() < 0.7:
        return text(rng)
    return hostile(rng)


def damaged(rng: random.Random, data: bytes, times: int) -> bytes:
    """A copy of bytes with so many of them changed, cut, doubled or left out."""
    changed = bytearray(data)
    for _ in range(times):
        at = rng.randrange(len(changed) + 1)
        action = rng.randrange(5)
        if action == 0:
            del changed[at:]
        elif action == 1:
            changed[at:at] = changed[max(0, at - 40) : at]
        elif action == 2:
            del changed[at : at + rng.choice((1, 4, 100))]
        else:
            piece = struct.pack(rng.choice(("<I", ">I", "<Q", "<H", ">H")), 0)
            size = len(piece)
            changed[at : at + size] = unsigned(rng, 8 * size).to_bytes(size, rng.choice(("little", "big")))
    return bytes(changed)
