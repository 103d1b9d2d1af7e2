"""What unknown principal points leave open: pictures of another size may be crops, with the lens beside their middle.

A picture that was cut out of a larger one fits nearly as well with its lens behind the middle, from a wrong pose. Among
pictures of one size and one lens that would show; of one that differs from the others it would not. There the principal
point is set free, and how far that moves the cameras is how wrong they may be.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.frames.keyframe import REFERENCE_SIDE
from splatnode.recon.registration import lenses
from splatnode.recon.verification import refit

FREE_SHIFT = (
    lenses.LensGroupingConfig().free_shift_sigma
)  # of the longer side, as where frames of several sizes are told apart


def free_principal_points(fit: refit.BundleFit) -> refit.CameraShifts | None:
    """How far the cameras move when the lenses of fewer cameras than the commonest one are set free.

    None where all pictures came through one lens, or every other one came calibrated. Lenses of single images that
    refuted the common one are left out: where their principal points are was asked when they were found.
    """
    count = len(fit.prior.sigmas)
    seen_through = np.bincount(fit.problem.lens_of_camera, minlength=count)
    free = (fit.prior.sigmas > 0) & ~fit.own & (np.arange(count) != seen_through.argmax())
    if not free.any():
        return None
    whole = refit.adjust(fit)
    sigmas = np.where(free, FREE_SHIFT * REFERENCE_SIDE * max(fit.scale, 1.0), whole.prior.shift_sigmas)
    return refit.compute_camera_shifts(
        whole, refit.adjust(replace(whole, prior=replace(whole.prior, shift_sigmas=sigmas)))
    )
