"""Which numbers could not be computed: NaN and infinity in a record, found by walking all of its fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass

import numpy as np


def find_non_finite(record: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every number in `record` that is NaN or infinite: field names, positions and keys, outermost first.

    Walks dataclasses, mappings, tuples, lists and numeric arrays; an array counts as one number. A field that is added
    to a record is walked without a change here.
    """
    if is_dataclass(record) and not isinstance(record, type):
        parts = ((field.name, getattr(record, field.name)) for field in fields(record))
    elif isinstance(record, Mapping):
        parts = ((str(key), value) for key, value in record.items())
    elif isinstance(record, tuple | list):
        parts = ((str(position), value) for position, value in enumerate(record))
    else:
        if isinstance(record, int | float | np.number | np.ndarray) and not np.isfinite(record).all():
            yield path
        return
    for name, value in parts:
        yield from find_non_finite(value, (*path, name))
