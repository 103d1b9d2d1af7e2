"""What views of the board do not suffice for, each as a sentence that says what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatnode.capture.calibration.coverage import CORNERS, Coverage
from splatnode.capture.calibration.estimate import Estimate
from splatnode.capture.calibration.uncertainty import pixel_sigmas

LEAST_VIEWS = 10
_LEAST_SHARE = 0.75  # of the picture's cells
_TILTED_DEG = 15.0  # the board must be tilted by more in a third of the views, else they say little of the focal length
_LARGEST_RMS = 0.0012  # of the longer side: corners that are farther from where a lens has them are not of this board


@dataclass(frozen=True)
class Limits:
    """The limits of what is good enough; standard deviations."""

    focal: float  # relative
    corner: float  # of where the picture's corners are seen, as a share of its longer side


ENOUGH = Limits(focal=0.003, corner=0.0008)  # .8 pixels of a picture of 1000: a lens is written
GOOD = Limits(focal=0.0005, corner=0.00015)  # more views are not waited for


class TooLittle(ValueError):
    """Views that give no lens: the text says what is missing."""

    exit_code = 65


def describe_missing_views(views: int, pictures: int, moving: bool) -> str | None:
    if views >= LEAST_VIEWS:
        return None
    show, own = ("shows", "its own") if views == 1 else ("show", "their own")
    still = ", held still for a moment" if moving else ""
    return (
        f"{LEAST_VIEWS} pictures that show the board are needed; {views} of {pictures} {show} it, from a place and "
        f"at a tilt of {own}{still}"
    )


def describe_missing_coverage(coverage: Coverage) -> str | None:
    if coverage.open_corners:
        return (
            f"the board was never seen near the picture's corner {' and '.join(coverage.open_corners)}: the lens bends "
            "most there. Hold it so that it reaches beyond the picture's border"
        )
    if coverage.share < _LEAST_SHARE:
        return (
            f"the board was seen in {coverage.share:.0%} of the picture, and {_LEAST_SHARE:.0%} is needed: show it "
            "where the grid has dots"
        )
    return None


def describe_uncertainty(estimate: Estimate, coverage: Coverage, limits: Limits) -> list[str]:
    """Lists what the estimate does not know well enough."""
    longer, tilts = max(estimate.lens.width, estimate.lens.height), estimate.tilts_deg
    if not estimate.rms_px <= _LARGEST_RMS * longer:
        return [
            f"the corners are {estimate.rms_px:.2f} pixels from where any lens would show them, and "
            f"{_LARGEST_RMS * longer:.2f} is the most: another board than was given, one that is not flat, or blurred "
            "pictures"
        ]
    found = []
    flat = float(np.quantile(tilts, 2 / 3)) < _TILTED_DEG
    if not estimate.focal_sigma <= limits.focal or flat:
        how = "parallel to the picture, or nearly so, in most views" if flat else "tilted too little or too seldom"
        found.append(
            f"the focal length is known to {100 * min(estimate.focal_sigma, 9.99):.2f} %: the board was {how}. Tilt "
            "it by 20 to 45 degrees, to the left, to the right, forwards and backwards"
        )
    sigmas = pixel_sigmas(estimate, coverage.outermost)
    worst = int(np.argmax(np.where(np.isfinite(sigmas), sigmas, np.inf)))
    if not sigmas[worst] <= limits.corner * longer:
        known = f"to {sigmas[worst]:.2f} pixels" if np.isfinite(sigmas[worst]) else "not at all"
        found.append(
            f"at the picture's corner {list(CORNERS)[worst]} the lens is known {known}, and "
            f"{limits.corner * longer:.2f} is needed: show the board there, tilted, in more views"
        )
    return found
