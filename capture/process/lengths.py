"""Lengths as people write them, with their unit: 100mm, 10 cm, 0.1m."""

from __future__ import annotations

import argparse
import re

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", re.ASCII)
_LONGEST = 1000.0  # metres


def metres(text: str) -> float:
    """The length in metres. Raises ValueError where it has no unit or is not above 0."""
    found = _LENGTH.fullmatch(text[:100])
    length = float(found[1]) * _METRES[found[2]] if found else 0.0
    if not 0.0 < length <= _LONGEST:
        raise ValueError(f"a length must have its unit, as 100mm, 10cm or 0.1m, and be above 0; got {text[:100]!a}")
    return length


def parse_measurement(text: str) -> tuple[float, float | None]:
    """A length and its standard deviation in metres, as 100mm@0.2mm; None where there is none. Raises ValueError."""
    length, at, sigma = text.partition("@")
    return metres(length), metres(sigma) if at else None


def measurement_argument(text: str) -> str:
    """The text, for an argument of the command line that `parse_measurement` reads."""
    try:
        parse_measurement(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text.strip()


def metres_argument(text: str) -> float:
    """As `metres`, for an argument of the command line."""
    try:
        return metres(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def format_length(length_m: float) -> str:
    """The length in the unit that suits it: 100 mm, 1.5 m."""
    return f"{length_m:g} m" if length_m >= 1.0 else f"{1e3 * length_m:g} mm"
