"""The mirrored answer: seen from afar, a scene and its mirror image in depth look the same from mirrored cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.registration import bundle
from splatnode.recon.verification import refit

# Shifts below which the mirrored start has found its way back to the same answer:
SAME_DEG = 1.0  # of rotations
SAME_REL = 0.03  # of centres, relative to their spread
NO_RIVAL = 100.0  # ratio of costs that stands for the lack of a mirrored answer; far beyond all that counts


def compute_reversal_cost_ratio(fit: refit.BundleFit) -> float:
    """How much worse the mirrored answer is than this one: the ratio of their costs, both adjusted; near 1 nothing
    tells them apart, and 100 at most. NaN where one of the two could not be computed.

    Under an affine camera, points mirrored in a plane that faces the camera and cameras turned the other way give the
    same pictures (Necker's reversal; Shapiro et al. 1995). Perspective breaks the tie, if there is enough of it.
    """
    whole = refit.adjust(fit)
    other = refit.adjust(replace(whole, problem=_reverse_depth(whole.problem)))
    between = refit.compute_shift(whole, other)
    if between.rotation_deg < SAME_DEG and between.centre_rel < SAME_REL:
        return NO_RIVAL
    return float(np.minimum(NO_RIVAL, other.cost / np.maximum(whole.cost, refit.MIN_COST)))


def _reverse_depth(problem: bundle.Problem) -> bundle.Problem:
    """The problem with its points mirrored in the plane through their middle that faces the first camera."""
    rotation0, translation0 = problem.rotations[0], problem.translations[0]
    points = problem.points @ rotation0.T + translation0
    rotations = problem.rotations @ rotation0.T
    translations = problem.translations - rotations @ translation0
    middle = np.median(points, axis=0)
    mirror = np.diag([1.0, 1.0, -1.0])
    turned = mirror @ rotations @ mirror
    return replace(
        problem,
        rotations=turned,
        translations=rotations @ middle + translations - turned @ middle,
        points=(points - middle) @ mirror + middle,
    )
