"""The lens that a query image was taken with: what is assumed of it is compared with a free lens, always.

A wrong lens finds a wrong camera on which many points agree. So the camera is looked for with lenses of all focal
lengths, the one on which most points agree is refined with a free lens (focal length, principal point, first radial
coefficient, aspect), and an assumption is kept only where that does not contradict it. What is kept counts as known no
better than a share of what the image itself leaves open: an image that cannot refute a lens cannot confirm it either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.locating import candidates, posing
from splatnode.recon.locating.camera_model import POSE, CameraModel, Lens
from splatnode.recon.locating.candidates import LensAssumption
from splatnode.recon.locating.case import QueryContext
from splatnode.recon.locating.outcome import LensSource
from splatnode.recon.locating.posing import PoseEstimate
from splatnode.recon.locating.refinement import optimize_camera

Array = npt.NDArray[np.float64]

# An assumption is refuted beyond so many standard deviations, its own and those of the free lens together.
_REFUTED_SIGMAS = 2.0
_REFUTED_SHAPE_SIGMAS = 3.0  # likewise of the radial coefficient and the aspect
# What was assumed is taken to be known no better than this share of what the free lens leaves open.
_SHARE_OPEN = 0.6
_MIN_AGREEMENT = 0.8  # of the points that agree with a free lens, those that must agree with the assumed one
_MOST_GIVEN_LOG, _MOST_GIVEN_SHIFT = 0.03, 0.02  # and of a given lens, no worse than this: it is known, not assumed
_CLEARLY_MORE = 1.05  # times as many points must agree with another camera, where an assumed lens has one
_SUBSET = 500  # correspondences with which lenses of all focal lengths are tried
_SUBSET_ITERATIONS = 1_500  # of RANSAC with each of these
_LONGER_ITERATIONS = 3_000  # and with all correspondences: they do for 13 % inliers
_REFINED = 3  # cameras that are refined with a free lens, those on which most points agree
_TRIED_APART = 0.1  # log focals of assumed lenses that a camera is looked for with, one by one
_FOCAL, _RADIAL, _SHIFT, _ASPECT = POSE, POSE + 1, slice(POSE + 2, POSE + 4), POSE + 4  # parameters of the lens


@dataclass(frozen=True, eq=False)
class LensChoice:
    """A camera, and where its lens is from."""

    posed: PoseEstimate
    source: LensSource
    as_assumed: bool  # whether the lens is one of those that were assumed
    rivals: tuple[PoseEstimate, ...] = ()  # the other cameras that were refined, each with a free lens


def search_cameras(
    judged: QueryContext, assumed: Sequence[LensAssumption], others: Sequence[Lens]
) -> list[CameraModel]:
    """Cameras with the assumed lenses, and by a part of the correspondences with the `others`.

    The first is that on which most correspondences agree.
    """
    known, scale, settings = judged.known, judged.scale, judged.settings
    tried = candidates.select_distinct_focals(assumed, _TRIED_APART)
    found = [posing.search_pose(known, lens, scale, settings) for lens in tried]
    few = known.select(np.random.default_rng(0).permutation(len(known))[:_SUBSET])
    most = min(settings.iterations, _SUBSET_ITERATIONS)
    found += [posing.search_pose(few, lens, scale, settings, most) for lens in others]
    return _best_first(judged, found, len(tried))


def search_cameras_longer(judged: QueryContext, lenses: Sequence[Lens]) -> list[CameraModel]:
    """As `search_cameras`, with each of the `lenses` by all correspondences, which finds more where inliers are few."""
    most = min(judged.settings.iterations, _LONGER_ITERATIONS)
    found = [posing.search_pose(judged.known, lens, judged.scale, judged.settings, most) for lens in lenses]
    return _best_first(judged, found)


def _best_first(judged: QueryContext, found: Sequence[CameraModel | None], preferred: int = 0) -> list[CameraModel]:
    """Those that there are, by how many correspondences agree; the first `preferred` ones before equals."""
    limit_px, ranked = judged.settings.search_px * judged.scale, list[tuple[float, CameraModel]]()
    for number, camera in enumerate(found):
        if camera is not None:
            count = int(posing.agreement(camera, judged.known, limit_px).sum())
            ranked.append((count * (_CLEARLY_MORE if number < preferred else 1.0), camera))
    return [camera for _, camera in sorted(ranked, key=lambda each: -each[0])]


def choose_lens(
    judged: QueryContext, cameras: Sequence[CameraModel], assumed: Sequence[LensAssumption]
) -> LensChoice | None:
    """The camera on which most correspondences agree, with its lens; None where there is none.

    `cameras` are where to start from, the best first. Of the `assumed` lenses the first is taken that the image does
    not contradict, else a free one.
    """
    side = judged.side
    found = [
        (camera, judged.refine_pose(camera, candidates.free_lens(camera.lens, side))) for camera in cameras[:_REFINED]
    ]
    starts = [(int(wide.agreeing.sum()), camera, wide) for camera, wide in found if wide is not None]
    if not starts:
        return None
    count, camera, wide = starts[0]
    for start in starts[1:]:
        if start[0] > _CLEARLY_MORE * count:
            count, camera, wide = start
    shaped, usual = _test_shape(wide, _nearest(assumed, wide) or candidates.make_typical_lens(camera.lens, side), side)
    prior = replace(candidates.free_lens(camera.lens, side).copy_shape(shaped), shift=np.zeros(2))
    free = judged.refine_pose(camera if usual else wide.fit.camera, prior)
    if free is None:
        return None
    rivals = tuple(each for _, _, each in starts if each is not wide)
    order = sorted(assumed, key=lambda each: (each.source is not LensSource.SCENE, _log_focal_apart(each.lens, free)))
    for each in order if usual else ():
        kept = _keep(each, free, shaped, side)
        chosen = None if kept is None else _refine_with_assumption(judged, free, each, kept)
        if chosen is not None and chosen.posed.agreeing.sum() >= _MIN_AGREEMENT * free.agreeing.sum():
            return replace(chosen, rivals=rivals)
    chosen = _refine_with_free_lens(judged, free, prior)
    return None if chosen is None else replace(chosen, rivals=rivals)


def _log_focal_apart(lens: Lens, posed: PoseEstimate) -> float:
    return abs(float(np.log(posed.fit.camera.lens.focal / lens.focal)))


def _nearest(assumed: Sequence[LensAssumption], posed: PoseEstimate) -> Lens | None:
    return min((each.lens for each in assumed), key=lambda lens: _log_focal_apart(lens, posed), default=None)


def _test_shape(wide: PoseEstimate, expected: Lens, side: int) -> tuple[Lens, bool]:
    """The radial coefficients and the aspect, of `expected` where the free lens `wide` does not refute them.

    Whether it does not is the second value.
    """
    lens, sigmas = wide.fit.camera.lens, _sigmas(wide)
    limits, free = _REFUTED_SHAPE_SIGMAS, candidates.free_lens(lens, side)
    bent = not abs(lens.radial[0] - expected.radial[0]) <= limits * np.hypot(sigmas[1], expected.radial_sigma)
    stretched = not abs(lens.log_aspect - expected.log_aspect) <= limits * np.hypot(
        sigmas[4], expected.log_aspect_sigma
    )
    shaped = replace(
        lens,
        radial=lens.radial if bent else expected.radial,
        radial_sigma=free.radial_sigma if bent else _widen(expected.radial_sigma, sigmas[1], free.radial_sigma),
        log_aspect=lens.log_aspect if stretched else expected.log_aspect,
        log_aspect_sigma=free.log_aspect_sigma
        if stretched
        else _widen(expected.log_aspect_sigma, sigmas[4], free.log_aspect_sigma),
    )
    return shaped, not (bent or stretched)


def _sigmas(posed: PoseEstimate) -> Array:
    """(5,) of the lens, as its points leave it open; infinite where that is not known."""
    variances = np.diag(posed.fit.covariance)[POSE:]
    return np.sqrt(np.where(np.isfinite(variances), np.maximum(variances, 0.0), np.inf))


def _widen(sigma: float, open_sigma: float, most: float) -> float:
    """The sigma of what was assumed: its own, but at least a share of what the image leaves open."""
    return float(min(max(sigma, _SHARE_OPEN * open_sigma), max(sigma, most)))


def _keep(each: LensAssumption, free: PoseEstimate, shaped: Lens, side: int) -> Lens | None:
    """The assumed lens with the sigmas that the image leaves to it; None where the free lens refutes it."""
    lens, found, sigmas = each.lens, free.fit.camera.lens, _sigmas(free)
    apart = np.array([np.log(found.focal / lens.focal), *(found.shift - lens.shift)])
    limits = _REFUTED_SIGMAS * np.hypot(sigmas[[0, 2, 3]], lens.sigmas[[0, 2, 3]])
    if not (np.abs(apart) <= limits).all():
        return None
    most = free.prior.log_focal_sigma, free.prior.shift_sigma
    if each.exact:
        most = _MOST_GIVEN_LOG, _MOST_GIVEN_SHIFT * side
    return replace(
        lens.copy_shape(shaped),
        radial=lens.radial,
        log_focal_sigma=_widen(lens.log_focal_sigma, sigmas[0], most[0]),
        shift_sigma=_widen(lens.shift_sigma, float(sigmas[2:4].max()), most[1]),
    )


def _refine_with_assumption(
    judged: QueryContext, free: PoseEstimate, each: LensAssumption, kept: Lens
) -> LensChoice | None:
    """The camera with an assumed lens. One that is exact stays, and what it may be wrong by is in the covariance."""
    if not each.exact:
        posed = judged.refine_pose(free.fit.camera, kept)
        return None if posed is None else LensChoice(posed, each.source, True)
    exact = replace(kept, log_focal_sigma=0.0, radial_sigma=0.0, shift_sigma=0.0, log_aspect_sigma=0.0)
    posed = judged.refine_pose(free.fit.camera, exact)
    if posed is None:
        return None
    loose = optimize_camera(posed.fit.camera, kept, judged.known.select(posed.agreeing), judged.noise_px)
    return LensChoice(replace(posed, fit=replace(posed.fit, covariance=loose.covariance)), each.source, True)


def _refine_with_free_lens(judged: QueryContext, free: PoseEstimate, prior: Lens) -> LensChoice | None:
    """The camera with a lens of its own, whose principal point is in the middle where the image does not refute it."""
    lens, sigmas, usual = free.fit.camera.lens, _sigmas(free)[2:4], candidates.make_typical_lens(prior, judged.side)
    if not (np.abs(lens.shift) <= _REFUTED_SIGMAS * np.hypot(sigmas, usual.shift_sigma)).all():
        return LensChoice(free, LensSource.FREE, False)
    sigma = _widen(usual.shift_sigma, float(sigmas.max()), prior.shift_sigma)
    posed = judged.refine_pose(free.fit.camera, replace(prior, shift=np.zeros(2), shift_sigma=sigma))
    return None if posed is None else LensChoice(posed, LensSource.FREE, False)
