"""Holding exposure, white balance and focus still: a scene whose colours change between frames cannot be modelled."""

from __future__ import annotations

import errno
import logging
from dataclasses import dataclass

from splatnode.capture.process.logs import event
from splatnode.capture.video4linux.device import Device

log = logging.getLogger(__name__)

AUTO_WHITE_BALANCE, GAIN, AUTO_GAIN = 0x98090C, 0x980913, 0x980912  # V4L2_CID_*
AUTO_EXPOSURE, EXPOSURE, EXPOSURE_PRIORITY = 0x9A0901, 0x9A0902, 0x9A0903
FOCUS, AUTO_FOCUS = 0x9A090A, 0x9A090C
EXPOSURE_MANUAL, EXPOSURE_BY_APERTURE = 1, 3  # most webcams call their automatic "aperture priority"
_UNIT_US = 100  # of EXPOSURE


@dataclass(frozen=True)
class Lock:
    """An automatic control, the value that turns it off, and the value that it would go on choosing."""

    name: str
    automatic: int
    off: int
    value: int | None = None


LOCKS = (
    Lock("exposure", AUTO_EXPOSURE, EXPOSURE_MANUAL, EXPOSURE),
    Lock("gain", AUTO_GAIN, 0, GAIN),
    Lock("white_balance", AUTO_WHITE_BALANCE, 0),
    Lock("focus", AUTO_FOCUS, 0, FOCUS),
)


def run_free(device: Device) -> None:
    """Lets the camera choose, at a constant frame rate."""
    for control, wish in (
        (AUTO_EXPOSURE, EXPOSURE_BY_APERTURE),
        (EXPOSURE_PRIORITY, 0),
        (AUTO_GAIN, 1),
        (AUTO_WHITE_BALANCE, 1),
        (AUTO_FOCUS, 1),
    ):
        _set(device, control, wish)


def hold(device: Device, exposure_us: int | None = None) -> dict[str, bool | None]:
    """Holds what the camera has chosen, or `exposure_us`: whether each automatic is off; None where it has none."""
    held = {}
    for lock in LOCKS:
        if device.control_range(lock.automatic) is None:
            held[lock.name] = None
            continue
        chosen = _get(device, lock.value) if lock.value is not None else None
        held[lock.name] = _set(device, lock.automatic, lock.off)
        if held[lock.name] and chosen is not None and lock.value is not None:
            _set(device, lock.value, chosen)
    if exposure_us is not None:
        held["exposure"] = bool(held["exposure"]) and _set(device, EXPOSURE, max(1, round(exposure_us / _UNIT_US)))
    event(log, logging.INFO, "locked", **held)
    return held


def _get(device: Device, control: int) -> int | None:
    return device.get_control(control) if device.control_range(control) is not None else None


def _set(device: Device, control: int, value: int) -> bool:
    """Whether the camera reads back what was set; one that refuses is no error."""
    if device.control_range(control) is None:
        return False
    try:
        return device.set_control(control, value) == value
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise
        return False
