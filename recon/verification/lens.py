"""Given focal lengths doubted: what the pictures themselves say when the lens is set free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatnode.recon.frames.keyframe import REFERENCE_SIDE, Keyframe, longer_side
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import focal
from splatnode.recon.registration.lenses import CORNER
from splatnode.recon.verification import refit

FREE_RADIAL = 0.3  # sigma of the first radial coefficient where it is free
STEPS = (0.0, 0.35, -0.35)  # of log focal, from which it is set free: a wrong one can be a local minimum


@dataclass(frozen=True)
class FreedLens:
    """A lens whose focal length came with the frames, after the same observations were adjusted with it free."""

    given: float  # pixels of the full-size image
    trusted: bool  # a calibration; else nominal, as from EXIF
    registered: float  # where the registration left it: a nominal one may move a little
    found: float
    cost_ratio: float  # robust cost with the lens free over that with it as it was registered


@dataclass(frozen=True)
class Distortion:
    """The distortion that the observations ask for when all first radial coefficients are free, too."""

    corner_shift: float  # by which a corner of the picture moves further, relative to its distance from the middle
    cost_ratio: float  # robust cost with it free over that with it as registered


def measure_distortion(fit: refit.BundleFit) -> Distortion:
    held = refit.adjust(fit)
    num_lenses = len(held.prior.sigmas)
    first = np.tile([FREE_RADIAL, 0.0], (num_lenses, 1))
    free = refit.adjust(replace(held, prior=replace(held.prior, radial_sigmas=first)))
    corner = CORNER * REFERENCE_SIDE * held.scale
    further = (free.problem.radials - held.problem.radials)[:, 0] * (corner / np.exp(free.problem.log_focals)) ** 2
    return Distortion(float(np.abs(further).max()), float(free.cost / max(held.cost, refit.MIN_COST)))


def free_lenses(fit: refit.BundleFit) -> tuple[FreedLens, ...]:
    """All lenses that came with the frames, set free together. Empty where none did."""
    told = np.isfinite(fit.told)
    if not told.any():
        return ()
    held = refit.adjust(replace(fit, prior=replace(fit.prior, sigmas=np.where(told, 0.0, fit.prior.sigmas))))
    prior = replace(held.prior, sigmas=np.where(told, refit.FREE_SIGMA, held.prior.sigmas))
    starts = [held.problem.log_focals + np.where(told, step, 0.0) for step in STEPS]
    tried = [refit.adjust(replace(held, prior=prior, problem=replace(held.problem, log_focals=s))) for s in starts]
    free = tried[int(np.argmin([candidate.cost for candidate in tried]))]  # the first NaN, where there is one
    ratio = float(free.cost / max(held.cost, refit.MIN_COST))
    focals = (fit.told, np.exp(held.problem.log_focals), np.exp(free.problem.log_focals))
    given, registered, found = ((fit.units * each).tolist() for each in focals)
    return tuple(
        FreedLens(given[g], bool(fit.prior.sigmas[g] == 0), registered[g], found[g], ratio) for g in np.nonzero(told)[0]
    )


def vote_focal(keyframes: Sequence[Keyframe], pairs: Sequence[TwoView]) -> float | None:
    """The focal length in pixels that the pairs vote for where all frames have the same size, else None."""
    sides = {longer_side(keyframe.frame) for keyframe in keyframes}
    if len(sides) != 1 or not pairs:
        return None
    return focal.vote(pairs, num_candidates=1)[0] * sides.pop()
