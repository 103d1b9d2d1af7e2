"""The campaigns, each found by the name of its module; one that is not in this checkout is left out."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType

NAMES = ("boundaries", "writes", "siege", "sanitize")


def campaigns() -> dict[str, ModuleType]:
    """Those that there are, by name."""
    places = {name: f"{__package__}.{name}" for name in NAMES}
    there = {name: place for name, place in places.items() if importlib.util.find_spec(place) is not None}
    return {name: importlib.import_module(place) for name, place in there.items()}


def missing() -> list[str]:
    return [name for name in NAMES if importlib.util.find_spec(f"{__package__}.{name}") is None]
