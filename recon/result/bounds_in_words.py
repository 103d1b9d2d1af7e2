"""Bounds as a person reads them. Numbers are rounded up, because a bound that was rounded down would not hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

from splatnode.recon.result.bounds import Bounds, find_widest
from splatnode.recon.result.scale import Scale
from splatnode.recon.result.snapshot import CameraEstimate

_DIGITS = 2  # significant ones
_LEAST, _MOST = 1e-9, 1e9  # numbers beyond these are told as bounds: nobody's cameras are so exact, or so wrong
_ROUNDING = 1e-9  # relative: a number that is over its digits by less is not rounded up
_LENGTHS = ((1.0, "m"), (0.01, "cm"), (0.001, "mm"))  # metres of a unit and its sign, the largest first


def format_camera_bounds(bounds: Bounds, scale: Scale) -> str:
    """The bounds of one camera, with its position in metres where `scale` is metric."""
    return _format_bounds("direction", "position", bounds, scale)


def format_widest_bounds(cameras: Sequence[CameraEstimate], scale: Scale) -> str:
    """The widest bounds of the cameras; empty where no camera has bounds."""
    worst = find_widest(camera.bounds for camera in cameras if camera.bounds is not None)
    return "" if worst is None else _format_bounds("directions", "positions", worst, scale)


def _format_bounds(direction: str, position: str, bounds: Bounds, scale: Scale) -> str:
    length = f" ({_format_length(bounds.centre)})" if scale.metric else ""
    return (
        f"{direction} to {format_rounded_up(bounds.rotation_deg)} degrees, "
        f"{position} to {format_rounded_up(bounds.centre_percent)} % of the distance to the scene{length}, "
        f"focal length to {format_rounded_up(bounds.focal_percent)} % (95 % bounds)"
    )


def _format_length(metres: float) -> str:
    unit, sign = next((each for each in _LENGTHS if metres >= each[0]), _LENGTHS[-1])
    return f"{format_rounded_up(metres / unit)} {sign}"


def format_rounded_up(value: float) -> str:
    """Returns the smallest number with two significant digits that is not below `value`; no exponent. Never raises."""
    if not (math.isfinite(value) and value > 0):
        return "0" if value == 0 else "an unknown number of"
    if value > _MOST:
        return f"more than {_MOST:.0f}"
    value = max(value, _LEAST)
    decimals = _DIGITS - 1 - math.floor(math.log10(value))
    rounded = math.ceil(value * 10.0**decimals * (1.0 - _ROUNDING)) / 10.0**decimals
    text = f"{rounded:.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
