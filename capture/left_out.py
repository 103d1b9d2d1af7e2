"""Fields of records that are left out where there is nothing: a reader that does not know them reads the rest."""

from __future__ import annotations

from typing import TypeVar

from msgspec import UNSET, UnsetType

T = TypeVar("T")


def make_optional_field(value: T | None) -> T | UnsetType:
    """The value as a field; left out where it is None."""
    return UNSET if value is None else value


def read_optional_field(field: T | UnsetType) -> T | None:
    """The value of a field; None where it was left out."""
    return None if isinstance(field, UnsetType) else field
