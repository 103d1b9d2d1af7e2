"""What a header may say: each kind of number and text with its range, and what all of them have in common.

Types that msgspec checks tell the range of each field. `check` is for what types do not say: text that a terminal only
shows, numbers that are finite, and nothing without end in a field that takes anything.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping
from typing import Annotated

import msgspec

from splatnode.capture.process.printable import LONGEST_NAME, LONGEST_TEXT, is_printable

LARGEST = 2**62  # of all integers
MOST_ENTRIES = 4096  # of a sequence or a table
DEEPEST = 12  # values within values

SessionId = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$", max_length=32)]
Sequential = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
Count = Annotated[int, msgspec.Meta(ge=-1, le=LARGEST)]  # or a number of something, -1 where there is none yet
Finite = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
Amount = Annotated[float, msgspec.Meta(ge=0.0, le=1e12)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_NAME)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]


def check(value: object, depth: int = 0) -> None:
    """Raises ValueError where `value`, a decoded header, holds what no header may hold."""
    if isinstance(value, str):
        if not is_printable(value):
            raise ValueError(f"text must be printable and at most {LONGEST_TEXT} characters, got {value[:60]!a}")
    elif isinstance(value, int):
        if abs(value) > LARGEST:
            raise ValueError(f"numbers must be within 2**62, got {value}")
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"numbers must be finite, got {value}")
    elif value is not None and value is not msgspec.UNSET and not isinstance(value, enum.Enum):
        _check_all(_contents(value), depth + 1)


def _contents(value: object) -> list[object]:
    if isinstance(value, (list, tuple)):
        return list(value)
    if isinstance(value, Mapping):
        return [*value, *value.values()]
    if isinstance(value, msgspec.Struct):
        return [getattr(value, name) for name in value.__struct_fields__]
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    raise ValueError(f"a header has text and numbers, got {type(value).__name__}")


def _check_all(values: list[object], depth: int) -> None:
    if depth > DEEPEST or len(values) > 2 * MOST_ENTRIES:
        raise ValueError(f"at most {MOST_ENTRIES} values, {DEEPEST} deep, got {len(values)} at depth {depth}")
    for value in values:
        check(value, depth)
