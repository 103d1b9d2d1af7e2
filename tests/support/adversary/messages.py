"""Messages: any header of a schema, any table of arrays, and buffers that fit it or do not."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

from splatnode.capture.messaging.messages import DTYPES, MAGIC
from tests.support.adversary import edges
from tests.support.adversary.schema_values import value

Parts = list[bytes]
Row = tuple[Any, list[int], bytes]  # dtype, shape, bytes


def message(
    rng: random.Random, schema: Any, table: Callable[[random.Random, Any], Sequence[Row]] = lambda rng, header: ()
) -> Parts:
    """The parts of a message whose header is drawn from `schema`, with the arrays that `table` gives it.

    In some messages everything is sound but for one thing; in others much is wrong.
    """
    odd = rng.choice((0.0, 0.0, 0.004, 0.02, 0.1))
    header = value(rng, schema, odd) if rng.random() < 0.98 else edges.hostile(rng)
    rows = list(table(rng, header))
    if rows and rng.random() < 0.5:
        for index in range(len(rows)) if rng.random() < 0.3 else [rng.randrange(len(rows))]:
            rows[index] = _changed(rng, *rows[index])
    if rng.random() < 0.03:
        rows.append(_changed(rng, edges.hostile(rng), [edges.integer(rng)], b""))
    if rows and rng.random() < 0.03:
        rows.pop(rng.randrange(len(rows)))
    announced = [[kind, shape] for kind, shape, _ in rows]
    try:
        head = msgspec.msgpack.encode([header, announced])
    except (OverflowError, UnicodeEncodeError, TypeError):  # what MessagePack cannot say
        head = msgspec.msgpack.encode([None, []])
    if rng.random() < 0.03:
        head = edges.damaged(rng, head, 1)
    if rng.random() < 0.01:
        head = rng.choice((b"\x91", b"\x81\xa1a", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")) * 3000 + head
    parts = [MAGIC, head, *(buffer for *_, buffer in rows)]
    if rng.random() < 0.02:
        rng.shuffle(parts)
    return parts if rng.random() < 0.98 else parts[: rng.randrange(len(parts) + 1)]


def _changed(rng: random.Random, kind: Any, shape: list[int], buffer: bytes) -> Row:
    """An array of the table with an edge in its shape, its dtype, or its bytes."""
    action = rng.random()
    if action < 0.4:
        changed = [edges.integer(rng) if rng.random() < 0.5 else size for size in shape]
        if rng.random() < 0.5 and 0 not in changed:
            changed.insert(rng.randrange(len(changed) + 1), 0)
        if rng.random() < 0.3:
            changed += [1] * rng.choice((1, 3, 40))
        fits = 0 <= math.prod(changed) <= 4096 and str(kind) in DTYPES
        return kind, changed, bytes(math.prod(changed) * DTYPES[kind].itemsize) if fits else buffer
    if action < 0.7:
        other = rng.choice((*DTYPES, "O", "V8", "f2", "c16", edges.text(rng), edges.integer(rng)))
        size = DTYPES[other].itemsize if other in DTYPES else 1
        return other, list(shape), bytes(size * max(0, math.prod(shape))) if math.prod(shape) < 4096 else buffer
    return kind, list(shape), edges.damaged(rng, buffer, 1)


def image_row(rng: random.Random) -> Row:
    height, width, channels = rng.choice((1, 2, 12)), rng.choice((1, 3, 16)), rng.choice((3, 3, 3, 0, 1, 4))
    return "u1", [height, width, channels], rng.randbytes(height * width * channels)


def frame_rows(rng: random.Random, header: Any) -> list[Row]:
    """The image of a frame, its right and depth images where the header tells of these; now and then others."""
    if rng.random() < 0.3:
        return [image_row(rng)]
    told = header if isinstance(header, dict) else {}
    rows: list[Row] = [("u1", [12, 16, 3], rng.randbytes(576))]
    if told.get("baseline") is not None:
        rows.append(("u1", [12, 16], rng.randbytes(192)))
    if isinstance(depth := told.get("depth"), dict):
        kind = rng.choice(
            (("u2", rng.randbytes(384)), ("f4", np.full(192, rng.choice((0.0, 1.0, np.nan)), "<f4").tobytes()))
        )
        rows.append((kind[0], [12, 16], kind[1]))
        if depth.get("has_confidence") is True:
            rows.append(("u1", [12, 16], rng.randbytes(192)))
    return rows


def bytes_row(data: bytes) -> Row:
    return "u1", [len(data)], data


def gaussian_rows(rng: random.Random) -> list[Row]:
    """The six arrays of a scene's Gaussians; some do not belong together."""
    count = rng.choice((0, 1, 2, 7))
    bases = rng.choice((1, 1, 1, 4, 9, 16, 0, 2, 17))
    shapes = [[count, 3], [count, 4], [count, 3], [count], [count, bases, 3]]
    rows = [("f4", shape, _singles(rng, math.prod(shape))) for shape in shapes]
    return [*rows, ("i4", [count], np.array([edges.unsigned(rng, 31) for _ in range(count)], "<i4").tobytes())]


def _singles(rng: random.Random, count: int) -> bytes:
    if rng.random() < 0.7:
        return np.full(count, rng.choice((0.0, 0.5, 1.0)), "<f4").tobytes()
    return b"".join(edges.single(rng) for _ in range(count))
