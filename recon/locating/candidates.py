"""The lenses that a photograph may have been taken with, the likeliest first."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics
from splatnode.recon.locating.camera_model import PINHOLE, Lens
from splatnode.recon.result.landmarks import KnownLenses

Array = npt.NDArray[np.float64]

# What is not known of a lens, as in recon/registration (lenses.py, finishing.py); lengths over the longer side.
_EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA = 0.05, 0.02, 0.004
_SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA = 0.01, 0.005  # focusing changes the lens of one camera
_FREE_SIGMA = 0.3  # of log focal, of a lens of which nothing is known
_CROP_SIGMA = 0.2  # of the principal point of a picture that was cropped
_FOCALS = np.geomspace(0.45, 3.2, 9)  # over the longer side, 96 to 18 degrees of view: steps of 28 %
_SAME_SHAPE = 0.01  # largest difference of two pictures' height over width
_SAME_FOCAL = 0.15  # of log focals: an EXIF focal length that may be of the result's own lens
_TOLD_APART = 0.002  # log focals of a result's lenses that are tried one by one


def given(intrinsics: Intrinsics) -> Lens | None:
    """The lens of a photograph without distortion that came with trusted intrinsics; None where they are not."""
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), 0.0, 0.0, 0.0) if intrinsics.source != "exif" else None


def own(lenses: KnownLenses, width: int, height: int, intrinsics: Intrinsics | None) -> list[Lens]:
    """Those of the result's own lenses that took pictures of this shape, upright or not."""
    side, found = max(width, height), list[Lens]()
    shape = height / width
    for focal, radial, shift, known in zip(lenses.focals, lenses.radials, lenses.shifts, lenses.shapes, strict=True):
        upright = abs(shape - known) <= _SAME_SHAPE
        if not upright and abs(1.0 / shape - known) > _SAME_SHAPE:
            continue
        if intrinsics is not None and abs(np.log(intrinsics.fx / side / focal)) > _SAME_FOCAL:
            continue
        if any(abs(np.log(lens.focal / side / focal)) < _TOLD_APART for lens in found):
            continue
        moved = shift * side if upright else np.zeros(2)
        sigmas = _SAME_LENS_SIGMA, _SAME_RADIAL_SIGMA, _SHIFT_SIGMA * side
        found.append(Lens(float(focal) * side, (float(radial[0]), float(radial[1])), moved, *sigmas))
    return found


def continued(focal: float, log_sigma: float, shift: Array, lenses: KnownLenses, width: int, height: int) -> Lens:
    """That of the photograph before, of the same camera and size: `focal` and `shift` in pixels, as it was found.

    `log_sigma` is how well the logarithm of the focal length is known. Its radial coefficients are those of
    the result's lens nearest to it, if that took pictures of this shape.
    """
    side = max(width, height)
    alike = own(lenses, width, height, Intrinsics(width, height, focal, focal, width / 2, height / 2, source="exif"))
    nearest = min(alike, key=lambda lens: abs(np.log(lens.focal / focal)), default=None)
    radial, sigma = (PINHOLE, _RADIAL_SIGMA) if nearest is None else (nearest.radial, _SAME_RADIAL_SIGMA)
    return Lens(focal, radial, shift, max(log_sigma, _SAME_LENS_SIGMA), sigma, _SHIFT_SIGMA * side)


def nominal(intrinsics: Intrinsics, side: int) -> Lens:
    """The lens that EXIF tells, which is right to a few per cent."""
    return Lens(intrinsics.fx, PINHOLE, np.zeros(2), _EXIF_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side)


def any_lens(side: int) -> list[Lens]:
    """Focal lengths from wide to long, each with what lies between it and the next."""
    return [
        Lens(float(focal) * side, PINHOLE, np.zeros(2), _FREE_SIGMA, _RADIAL_SIGMA, _SHIFT_SIGMA * side)
        for focal in _FOCALS
    ]


def cropped(lens: Lens, side: int) -> Lens:
    """Any lens near this one, of a picture that may be a part of what the camera saw."""
    return Lens(lens.focal, lens.radial, lens.shift, _FREE_SIGMA, _RADIAL_SIGMA, _CROP_SIGMA * side)
