"""A cache of the values that were asked for last."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LruCache(Generic[K, V]):
    """Keeps `maximum` values by key; the least recently used one goes first."""

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._values: dict[K, V] = {}  # the one asked for last is last

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The value of `key`; `make` makes it where it is not kept."""
        value = self._values.pop(key) if key in self._values else make()
        self._values[key] = value
        if len(self._values) > self._maximum:
            del self._values[next(iter(self._values))]
        return value

    def __len__(self) -> int:
        return len(self._values)
