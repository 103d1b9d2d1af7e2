"""How a camera says that it exposed a frame: for how long, at which sensitivity, through which aperture."""

from __future__ import annotations

import math
from dataclasses import dataclass

_TIMES_S = (1e-7, 1e5)  # from the fastest flash to a night's stars
_ISOS = (1.0, 1e7)
_F_NUMBERS = (0.1, 1000.0)  # up to a pinhole's


@dataclass(frozen=True)
class ExposureSettings:
    """A camera's settings of one exposure. Raises ValueError where no camera could have them."""

    time_s: float  # seconds for which light was gathered
    iso: float  # sensitivity, as an ISO speed: 200 is twice as sensitive as 100
    f_number: float | None = None  # focal length over aperture; None: nobody knows, as of a lens without an iris

    def __post_init__(self) -> None:
        for what, number, (least, most), unit in (
            ("time", self.time_s, _TIMES_S, " seconds"),
            ("sensitivity", self.iso, _ISOS, " ISO"),
            ("f-number", self.f_number, _F_NUMBERS, ""),
        ):
            if number is not None and not least <= number <= most:
                raise ValueError(f"the {what} of an exposure must be {least:g} to {most:g}{unit}, got {number:g}")

    @property
    def log_exposure(self) -> float:
        """Natural logarithm of how bright a surface was recorded, against other frames of the same camera."""
        aperture = 1.0 if self.f_number is None else self.f_number
        return math.log(self.time_s * self.iso / 100.0 / aperture**2)


def parse_exposure(time_s: float | None, iso: float | None, f_number: float | None = None) -> ExposureSettings | None:
    """The settings that a camera or a file tells; None where it tells too little, or what cannot be, as 0 often is.

    An f-number that cannot be is left out alone.
    """
    if time_s is None or iso is None:
        return None
    if f_number is not None and not _F_NUMBERS[0] <= f_number <= _F_NUMBERS[1]:
        f_number = None
    try:
        return ExposureSettings(float(time_s), float(iso), f_number)
    except ValueError:  # it is a hint, which a frame may lack
        return None
