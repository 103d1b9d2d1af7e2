"""What speaks against the camera that was found for a photograph. Each check refuses by the evidence of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from splatnode.recon.keyframes import REFERENCE_SIDE
from splatnode.recon.locating import NORMAL_95, LensSource, LocalizationBounds, NotLocated, Reason, pose_refinement
from splatnode.recon.locating.pose_refinement import (
    CORRELATED,
    POSE,
    CameraFit,
    CameraModel,
    Correspondences,
    Lens,
    LensAssumption,
    PoseEstimate,
    optimize_camera,
    pose_covariance,
)
from splatnode.recon.matching.pair_matching import log10_number_of_false_alarms
from splatnode.recon.result.snapshot import Landmarks
from splatnode.recon.result.verdict import compute_length_95
from splatnode.recon.verification import evidence

# All that is known of a photograph when it is judged.

Array = npt.NDArray[np.float64]

_SAMPLE = 5  # correspondences that define a pose, a focal length and a principal point
_CELL = 4.0  # side of a cell in which features count as one, in limits of their errors
_SHUFFLES = 20  # of the landmarks among the pixels, which tell how often chance agrees


@dataclass(frozen=True, eq=False)
class QueryContext:
    """The correspondences and settings by which a camera of a query image is judged."""

    known: Correspondences
    width: int  # of the photograph, pixels
    height: int
    reference_noise_px: float  # of an observation, pixels at REFERENCE_SIDE
    unit: float  # the median depth of the scene's points
    settings: pose_refinement.PoseSearchConfig

    @property
    def side(self) -> int:
        """The longer side, pixels."""
        return max(self.width, self.height)

    @property
    def scale(self) -> float:
        """Pixels for one at REFERENCE_SIDE."""
        return self.side / REFERENCE_SIDE

    @property
    def noise_px(self) -> float:
        """Returns the standard deviation of an observation, pixels of the query image."""
        return self.reference_noise_px * self.scale

    def estimate_pose(self, *lenses: Lens) -> PoseEstimate | None:
        """The camera with that of the lenses on which most correspondences agree."""
        return pose_refinement.estimate_pose(self.known, lenses, self.scale, self.noise_px, self.settings)

    def refine_pose(self, camera: CameraModel, lens: Lens) -> PoseEstimate | None:
        """The camera refined, with its inliers found again."""
        return pose_refinement.refine_pose(camera, self.known, lens, self.scale, self.noise_px, self.settings)

    def make_hypothesis(
        self, posed: PoseEstimate | None, source: LensSource = LensSource.FREE, rivals: Sequence[PoseEstimate] = ()
    ) -> PoseHypothesis:
        limit_px = self.settings.max_error_px * self.scale
        log10_nfa = 0.0 if posed is None else _log10_nfa(self.known, posed, limit_px, self.width * self.height)
        return PoseHypothesis(self, posed, log10_nfa, source, tuple(rivals))


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A camera for a photograph."""

    by: QueryContext
    posed: PoseEstimate | None  # None: there is none
    log10_nfa: float  # log10 of the expected number of cameras that chance gives so much agreement
    source: LensSource  # of the camera's lens
    rivals: tuple[PoseEstimate, ...] = ()  # cameras with other lenses that were found, too

    @property
    def correspondences(self) -> Correspondences:
        return self.by.known

    @property
    def num_independent(self) -> int:
        """How many spots of the photograph agree with the camera."""
        return count_independent(self.inliers.pixels, self.by.settings.max_error_px * self.by.scale)

    @property
    def inliers(self) -> Correspondences:
        """Returns the correspondences that agree with the camera."""
        return self.correspondences.select(np.zeros(0, np.int64) if self.posed is None else self.posed.agreeing)


def _log10_nfa(known: Correspondences, posed: PoseEstimate, limit_px: float, area: int) -> float:
    """log10 of the number of false alarms (Moisan and Stival, 2004), of unrelated pixels and landmarks.

    The chance of one agreement is that of landmarks dealt anew among the pixels, which are not spread evenly either,
    and at least that of an even spread.
    """
    seen, depth = posed.fit.camera.project(known.points)
    seen = np.where(depth[:, None] > 0, seen, np.inf)
    generator, hits = np.random.default_rng(0), 0
    for _ in range(_SHUFFLES):
        dealt = seen[generator.permutation(len(seen))]
        hits += int((np.linalg.norm(dealt - known.pixels, axis=1) < limit_px).sum())
    own = int(posed.agreeing.sum())
    # A landmark that is dealt to its own pixel again is no chance; on average one an agreement and shuffle in M is.
    dealt_again = _SHUFFLES * own / max(len(seen), 1)
    chance = max((hits - dealt_again) / (_SHUFFLES * max(len(seen), 1)), math.pi * limit_px**2 / area)
    apart, agreeing = (count_independent(pixels, limit_px) for pixels in (known.pixels, known.pixels[posed.agreeing]))
    return log10_number_of_false_alarms(max(apart, agreeing), agreeing, _SAMPLE, min(chance, 1.0))


def count_independent(pixels: Array, limit_px: float) -> int:
    """How many of the pixels (M, 2) say something of their own: those in one cell of the picture count as one.

    One spot of the picture has several features, and where one of them agrees by chance, the others do, too.
    """
    return len(np.unique(np.floor(pixels / (_CELL * limit_px)), axis=0))


# The lens that a query image was taken with: what is assumed of it is compared with a free lens, always.
#
# A wrong lens finds a wrong camera on which many points agree. So the camera is looked for with lenses of all focal
# lengths, the one on which most points agree is refined with a free lens (focal length, principal point, first radial
# coefficient, aspect), and an assumption is kept only where that does not contradict it. What is kept counts as known
# no better than a share of what the image itself leaves open: an image that cannot refute a lens cannot confirm it
# either.


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
_VAGUE = 0.03  # sigma of log focal from which on a camera is looked for with focal lengths between those tried, too
_BETWEEN = -0.15, -0.1, -0.05, 0.05, 0.1, 0.15  # log focals from the one that was tried
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
    tried = pose_refinement.select_distinct_focals(assumed, _TRIED_APART)
    found = [pose_refinement.search_pose(known, lens, scale, settings) for lens in tried]
    few = known.select(np.random.default_rng(0).permutation(len(known))[:_SUBSET])
    most = min(settings.iterations, _SUBSET_ITERATIONS)
    found += [pose_refinement.search_pose(few, lens, scale, settings, most) for lens in others]
    return _best_first(judged, found, len(tried))


def search_cameras_longer(judged: QueryContext, lenses: Sequence[Lens]) -> list[CameraModel]:
    """As `search_cameras`, with each of the `lenses` by all correspondences, which finds more where inliers are few."""
    most = min(judged.settings.iterations, _LONGER_ITERATIONS)
    found = [pose_refinement.search_pose(judged.known, lens, judged.scale, judged.settings, most) for lens in lenses]
    return _best_first(judged, found)


def _best_first(judged: QueryContext, found: Sequence[CameraModel | None], preferred: int = 0) -> list[CameraModel]:
    """Those that there are, by how many correspondences agree; the first `preferred` ones before equals."""
    limit_px, ranked = judged.settings.search_px * judged.scale, list[tuple[float, CameraModel]]()
    for number, camera in enumerate(found):
        if camera is not None:
            count = int(pose_refinement.agreement(camera, judged.known, limit_px).sum())
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
    starts = _refine_starts(judged, cameras)
    if not starts:
        return None
    best = _choose_start(starts)
    if _sigmas(best.wide)[0] > _VAGUE:
        between = [replace(best.camera.lens, focal=best.camera.lens.focal * math.exp(step)) for step in _BETWEEN]
        starts += _refine_starts(judged, search_cameras_longer(judged, between))
        best = _choose_start(starts)
    camera, wide = best.camera, best.wide
    shaped, usual = _test_shape(
        wide, _nearest(assumed, wide) or pose_refinement.make_typical_lens(camera.lens, side), side
    )
    prior = replace(pose_refinement.free_lens(camera.lens, side).copy_shape(shaped), shift=np.zeros(2))
    free = judged.refine_pose(camera if usual else wide.fit.camera, prior)
    if free is None:
        return None
    rivals = tuple(each.wide for each in starts if each is not best)
    order = sorted(assumed, key=lambda each: (each.source is not LensSource.SCENE, _log_focal_apart(each.lens, free)))
    for each in order if usual else ():
        kept = _keep(each, free, shaped, side)
        chosen = None if kept is None else _refine_with_assumption(judged, free, each, kept)
        if chosen is not None and chosen.posed.agreeing.sum() >= _MIN_AGREEMENT * free.agreeing.sum():
            return replace(chosen, rivals=rivals)
    chosen = _refine_with_free_lens(judged, free, prior)
    return None if chosen is None else replace(chosen, rivals=rivals)


@dataclass(frozen=True, eq=False)
class _Start:
    """Describes a camera from which the pose and a lens of its own are sought."""

    camera: CameraModel
    wide: PoseEstimate  # refined from it with a free lens

    @property
    def count(self) -> int:
        return int(self.wide.agreeing.sum())


def _refine_starts(judged: QueryContext, cameras: Sequence[CameraModel]) -> list[_Start]:
    """Refines the first few cameras, each with a free lens, and leaves out those of which nothing is left."""
    found = [
        (camera, judged.refine_pose(camera, pose_refinement.free_lens(camera.lens, judged.side)))
        for camera in cameras[:_REFINED]
    ]
    return [_Start(camera, wide) for camera, wide in found if wide is not None]


def _choose_start(starts: Sequence[_Start]) -> _Start:
    """Chooses the start on which most correspondences agree; a vague one gives way to the best determined of equals.

    Where only far points agree, they leave focal length and position open along a line; those on which near ones agree,
    too, are another set of as many points.
    """
    best = starts[0]
    for start in starts[1:]:
        if start.count > _CLEARLY_MORE * best.count:
            best = start
    if _sigmas(best.wide)[0] <= _VAGUE:
        return best
    equal = [start for start in starts if _CLEARLY_MORE * start.count >= best.count]
    return min(equal, key=lambda start: _sigmas(start.wide)[0])


def _log_focal_apart(lens: Lens, posed: PoseEstimate) -> float:
    return abs(float(np.log(posed.fit.camera.lens.focal / lens.focal)))


def _nearest(assumed: Sequence[LensAssumption], posed: PoseEstimate) -> Lens | None:
    return min((each.lens for each in assumed), key=lambda lens: _log_focal_apart(lens, posed), default=None)


def _test_shape(wide: PoseEstimate, expected: Lens, side: int) -> tuple[Lens, bool]:
    """The radial coefficients and the aspect, of `expected` where the free lens `wide` does not refute them.

    Whether it does not is the second value.
    """
    lens, sigmas = wide.fit.camera.lens, _sigmas(wide)
    limits, free = _REFUTED_SHAPE_SIGMAS, pose_refinement.free_lens(lens, side)
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
    lens, sigmas, usual = (
        free.fit.camera.lens,
        _sigmas(free)[2:4],
        pose_refinement.make_typical_lens(prior, judged.side),
    )
    if not (np.abs(lens.shift) <= _REFUTED_SIGMAS * np.hypot(sigmas, usual.shift_sigma)).all():
        return LensChoice(free, LensSource.FREE, False)
    sigma = _widen(usual.shift_sigma, float(sigmas.max()), prior.shift_sigma)
    posed = judged.refine_pose(free.fit.camera, replace(prior, shift=np.zeros(2), shift_sigma=sigma))
    return None if posed is None else LensChoice(posed, LensSource.FREE, False)


class LocalizationCheckConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Checks of the camera that was found for a query image. Each check refuses by the evidence of its own."""

    max_log10_nfa: float = -12.0  # as of a pair of photographs (recon/matching/pair_matching.py)
    min_points: int = 15  # that agree, as of a view that is added to a map (recon/registration/mapping_problem.py)
    min_share_of_picture: float = 0.04  # that their hull covers: less may be a thing that stood elsewhere
    max_elsewhere: float = 0.5  # agreement with a second camera, over that with the first
    max_apart: float = 4.0  # standard deviations between what two halves of the picture say of the camera
    mirror: evidence.ReflectionConfig = evidence.ReflectionConfig()  # of the test whether it was turned left to right
    max_mirror_gain: float = 0.05  # of matches, in logarithms, once it is turned left to right; right ones have below 0
    max_rival: float = 0.8  # agreement with a camera of another lens, over that with the first
    focal_range: tuple[float, float] = (0.3, 6.0)  # over the longer side: 118 to 10 degrees of view
    crops: tuple[float, float] = (0.6, 5.0)  # what a border, or cropping, may make of a focal length that is stated
    max_shift: float = 0.5  # of the principal point, over the longer side: it is in the picture, or was before a crop
    max_log_aspect: float = 0.7  # of the focal length across over that down: 2
    max_radial: float = 0.5  # the first coefficient of a lens that bends lines; beyond, it is a fisheye
    least_shear: float = 0.003  # pixels across for one down, from which on it is taken out of an image
    max_rotation_deg: float = 5.0  # of the claim; beyond, a camera is far off (extras/evaluate/stability/trial.py)
    max_centre_percent: float = 10.0  # likewise


Check = Callable[[PoseHypothesis, LocalizationCheckConfig], NotLocated | None]


def run_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The first check that refuses, or None."""
    return _first(case, config, _CHECKS)


def run_presence_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The same of the checks whether the camera was found at all, which matches with all that is in view answer."""
    return _first(case, config, _WHETHER_FOUND)


def run_pose_checks(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """The same of the other ones."""
    return _first(case, config, [check for check in _CHECKS if check not in _WHETHER_FOUND])


def _first(case: PoseHypothesis, config: LocalizationCheckConfig, checks: Sequence[Check]) -> NotLocated | None:
    if case.posed is None:
        return make_not_found(case)
    return next((found for check in checks if (found := check(case, config)) is not None), None)


def make_not_found(case: PoseHypothesis) -> NotLocated:
    """Rejects a query image whose inliers chance explains."""
    count = len(case.inliers)
    agree = f"only {count} points agree with one camera, as chance may give" if count else "no points agree"
    return NotLocated(
        Reason.NOT_FOUND,
        f"too little of it is in the scene: {agree}.",
        "Take it nearer to where the scene's photographs were taken, looking the same way.",
    )


def check_uncertainty(claim: LocalizationBounds, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects a camera that is known too roughly to be of use."""
    if claim.rotation_deg <= config.max_rotation_deg and claim.centre_percent <= config.max_centre_percent:
        return None
    return NotLocated(
        Reason.UNCERTAIN,
        f"its camera is known to {claim.rotation_deg:.0f} degrees and {claim.centre_percent:.0f} % of the distance "
        f"only; at most {config.max_rotation_deg:g} degrees and {config.max_centre_percent:g} % are given out.",
        "Take it so that more of the scene is in it, or give its calibration.",
    )


def check_stated_focal(lens: Lens, stated_focal: float, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects a lens that neither cropping nor a border makes of the stated focal length, in pixels."""
    least, most = config.crops
    if least <= lens.focal / stated_focal <= most:
        return None
    return NotLocated(
        Reason.LENS,
        f"its points ask for a focal length of {lens.focal:.4g} pixels, where {stated_focal:.4g} are stated.",
        "Give the lens of this image, or none.",
    )


_SHEAR_STEP, _MOST_SHEAR = 0.01, 0.1  # of the shears that are tried: pixels across for one down
_COST_SIGMAS = 3.0  # of a residual, from which on it counts less
_SIGMA_GAIN = CORRELATED / _COST_SIGMAS**2  # of the cost, for a standard deviation: CORRELATED points count as one


def measure_shear(judged: QueryContext, camera: CameraModel, sigmas: float = 3.0) -> float:
    """Measures the pixels across for one down by which an image is sheared, as by a rolling shutter in a turn.

    Focal length, aspect, principal point and distortion imitate a shear in part, and the pose slides along. So with
    each shear taken out all of them are found anew from `camera` on, and the one with the least cost of all
    correspondences counts; 0 where it lowers the cost by less than so many standard deviations do.
    """
    cameras, costs = {0: camera}, dict[int, float]()

    def cost(number: int, near: int) -> float:
        if number not in costs:
            costs[number], cameras[number] = _fit_sheared(judged, number * _SHEAR_STEP, cameras[near])
        return costs[number]

    best, last = 0, round(_MOST_SHEAR / _SHEAR_STEP)
    cost(0, 0)
    way = 1 if cost(1, 0) < cost(-1, 0) else -1
    while abs(best) < last and cost(best + way, best) < costs[best]:
        best += way
    before, at, after = cost(best - 1, best), costs[best], cost(best + 1, best)
    bend = before - 2.0 * at + after
    aside = 0.5 * (before - after) / bend if bend > 0 and math.isfinite(bend) else 0.0
    aside = float(np.clip(aside, -0.5, 0.5))
    gain = costs[0] - at + (0.5 * bend * aside**2 if aside else 0.0)
    return _SHEAR_STEP * (best + aside) if gain >= sigmas**2 * _SIGMA_GAIN else 0.0


def straighten(case: PoseHypothesis, shear: float) -> PoseHypothesis | None:
    """The case with a shear taken out of the image, and a lens of its own; None where no camera fits."""
    assert case.posed is not None
    straight = _take_out_shear(case.by, shear)
    posed = straight.refine_pose(
        case.posed.fit.camera, pose_refinement.free_lens(case.posed.fit.camera.lens, case.by.side)
    )
    return None if posed is None else PoseHypothesis(straight, posed, case.log10_nfa, LensSource.FREE)


def _take_out_shear(judged: QueryContext, shear: float) -> QueryContext:
    pixels = judged.known.pixels - np.outer(shear * judged.known.pixels[:, 1], [1.0, 0.0])
    return replace(judged, known=replace(judged.known, pixels=pixels))


def _fit_sheared(judged: QueryContext, shear: float, camera: CameraModel) -> tuple[float, CameraModel]:
    """The robust cost of all correspondences, with this shear taken out, and the camera; infinite where none fits."""
    straight = _take_out_shear(judged, shear)
    posed = straight.refine_pose(camera, pose_refinement.free_lens(camera.lens, judged.side))
    if posed is None:
        return math.inf, camera
    squared = pose_refinement.compute_whitened_errors(posed.fit.camera, straight.known, judged.noise_px) ** 2
    return float(np.log1p(squared / _COST_SIGMAS**2).sum()), posed.fit.camera


def check_mirrored(gain: float, config: LocalizationCheckConfig) -> NotLocated | None:
    """Rejects an image that matches the scene better mirrored: `gain` of `measure_mirror_gain`."""
    if gain <= config.max_mirror_gain:
        return None
    return NotLocated(
        Reason.MIRRORED,
        f"turned left to right it has {100 * math.expm1(gain):.0f} % more matches with the scene.",
        "Give the image as the camera took it; many front cameras and web conferences mirror theirs.",
    )


def _check_chance(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    enough = case.num_independent >= config.min_points and case.log10_nfa <= config.max_log10_nfa
    return None if enough else make_not_found(case)


def _check_coverage(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    share = _hull_area(case.inliers.pixels) / (case.by.width * case.by.height)
    if share >= config.min_share_of_picture:
        return None
    return NotLocated(
        Reason.ONE_PATCH,
        f"all that agrees with the scene lies in {100 * share:.1f} % of the picture, which may be one thing that "
        "stood elsewhere.",
        "Take it so that more of the scene is in it.",
    )


def _hull_area(pixels: Array) -> float:
    try:
        return float(ConvexHull(pixels).volume)  # of a hull in the plane, its area
    except (QhullError, ValueError):
        return 0.0


def _check_lens(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    assert case.posed is not None
    lens, side = case.posed.fit.camera.lens, max(case.by.width, case.by.height)
    least, most = config.focal_range
    shift = float(np.linalg.norm(lens.shift)) / side
    usual = abs(lens.log_aspect) <= config.max_log_aspect and abs(lens.radial[0]) <= config.max_radial
    if least <= lens.focal / side <= most and shift <= config.max_shift and usual:
        return None
    return NotLocated(
        Reason.LENS,
        f"it would take a focal length of {lens.focal / side:.2g} times the longer side, a lens that looks "
        f"{100 * shift:.0f} % of it beside the middle, pixels {math.exp(lens.log_aspect):.2g} times as high as wide, "
        f"and a radial coefficient of {lens.radial[0]:.2g}.",
        "Give the photograph as the camera made it, not cropped, or its calibration.",
    )


def _check_elsewhere(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether what disagrees with the camera agrees with another one.

    Of an image with a lens of its own the other one may have any lens, too: the parts of a collage have several.
    """
    assert case.posed is not None
    camera = case.posed.fit.camera
    lens, explained = camera.lens, np.isin(case.correspondences.feature_of, case.inliers.feature_of)
    rest = replace(case.by, known=case.correspondences.select(~explained))
    starts, by = [pose_refinement.search_pose(rest.known, lens, rest.scale, rest.settings)], case.by
    if case.source is LensSource.FREE:
        starts += search_cameras(rest, (), pose_refinement.make_lens_grid(rest.side, ()))[:1]
        # A free lens could reach the points of the first camera from elsewhere.
        lens, by = pose_refinement.free_lens(lens, rest.side), rest
    found = [posed for start in starts if start is not None and (posed := by.refine_pose(start, lens)) is not None]
    apart = [int(each.agreeing.sum()) for each in found if not _is_near(camera, each.fit.camera, case.by)]
    count = max(apart, default=0)
    if count <= max(config.max_elsewhere * len(case.inliers), config.min_points):
        return None
    return _make_elsewhere(case, count)


def _make_elsewhere(case: PoseHypothesis, count: int) -> NotLocated:
    return NotLocated(
        Reason.ELSEWHERE,
        f"{len(case.inliers)} points agree with one camera and {count} with another one: the scene repeats itself, "
        "or the image has several parts.",
        "Take it so that something is in it which the scene has once, and give it as the camera made it.",
    )


def _check_other_lens(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether a camera of another lens, which was found on the way, explains nearly as much.

    One that lies apart by no more than its own uncertainty is none: then the covariance tells what is left open.
    """
    assert case.posed is not None
    fit = case.posed.fit
    apart = [
        int(each.agreeing.sum())
        for each in case.rivals
        if not _is_near(fit.camera, each.fit.camera, case.by) and _sigmas_apart(fit, each.fit) > config.max_apart
    ]
    if max(apart, default=0) <= config.max_rival * len(case.inliers):
        return None
    return _make_elsewhere(case, max(apart))


_NEAR_DEG, _NEAR_SHARE = 5.0, 0.1  # two cameras nearer than this, of the distance to the scene, are one
_NEAR_SHIFT = 0.1  # likewise of their principal points, over the longer side


def _is_near(one: CameraModel, other: CameraModel, by: QueryContext) -> bool:
    turn = np.degrees(Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude())
    apart = np.linalg.norm(one.T_world_camera[:3, 3] - other.T_world_camera[:3, 3])
    shift = np.linalg.norm(one.lens.shift - other.lens.shift)
    return bool(turn < _NEAR_DEG and apart < _NEAR_SHARE * by.unit and shift < _NEAR_SHIFT * by.side)


def _check_halves(case: PoseHypothesis, config: LocalizationCheckConfig) -> NotLocated | None:
    """Whether the halves of the picture say different things of the camera, beyond what they leave open."""
    assert case.posed is not None
    fit, agreeing = case.posed.fit, case.inliers
    farthest = 0.0
    for axis in (0, 1):
        first = agreeing.pixels[:, axis] < np.median(agreeing.pixels[:, axis])
        halves = [
            optimize_camera(fit.camera, fit.camera.lens, agreeing.select(half), case.by.noise_px)
            for half in (first, ~first)
        ]
        farthest = max(farthest, _sigmas_apart(*halves))
    if farthest <= config.max_apart:
        return None
    return NotLocated(
        Reason.INCONSISTENT,
        "two halves of it put the camera in different places, farther apart than their uncertainty allows.",
        "Something has moved, or its lens bends straight lines: give its calibration.",
    )


def _sigmas_apart(one: CameraFit, other: CameraFit) -> float:
    """How far two cameras lie apart, in standard deviations; infinite where these are not known."""
    between = np.linalg.inv(one.camera.T_world_camera) @ other.camera.T_world_camera
    turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
    apart = np.concatenate([between[:3, 3], turn])
    covariance = sum(pose_covariance(fit.camera, fit.covariance) for fit in (one, other))
    if not np.isfinite(covariance).all():
        return math.inf
    squared = float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart)
    return math.sqrt(max(squared, 0.0) / len(apart))


_CHECKS: tuple[Check, ...] = (
    _check_chance,
    _check_lens,
    _check_coverage,
    _check_elsewhere,
    _check_other_lens,
    _check_halves,
)
_WHETHER_FOUND: tuple[Check, ...] = (_check_chance, _check_elsewhere)


# What is claimed of a placed camera: by its own points, and by how well the scene's own cameras are known.


_BALL_95 = 2.7955  # radius that holds 95 % of a normal distribution with sigma 1 in three dimensions
_MOST_LOG_FOCAL = math.log(10.0)  # who knows the focal length no better knows nothing


def compute_error_bounds(
    posed: PoseEstimate, known: Correspondences, landmarks: Landmarks, side: int
) -> tuple[LocalizationBounds, Array]:
    """The claim of an image whose longer side has `side` pixels.

    And the covariance (6, 6) of a small motion in the camera's frame: translation, then turn.

    The scene around the camera is as wrong as its cameras there: as those whose photographs it shares points with.
    """
    shares = np.bincount(known.photograph_of[posed.agreeing], minlength=len(landmarks.centre_bounds))
    shares = shares / max(shares.sum(), 1)
    turn = np.radians(np.sqrt(shares @ landmarks.rotation_bounds**2)) / _BALL_95
    move = np.sqrt(shares @ landmarks.centre_bounds**2) / _BALL_95
    covariance = pose_covariance(posed.fit.camera, posed.fit.covariance) + np.diag([move**2] * 3 + [turn**2] * 3)
    centre = compute_length_95(covariance[:3, :3])
    of_scene = 0.0 if landmarks.focal_bounds is None else np.sqrt(shares @ (landmarks.focal_bounds / 100.0) ** 2)
    of_lens = posed.fit.covariance[POSE:, POSE:]
    claim = LocalizationBounds(
        rotation_deg=math.degrees(compute_length_95(covariance[3:, 3:])),
        centre=centre,
        centre_percent=100.0 * centre / landmarks.unit,
        focal_percent=100.0 * math.expm1(min(math.hypot(_log_focal_bound(of_lens), of_scene), _MOST_LOG_FOCAL)),
        principal_percent=100.0 * compute_length_95(of_lens[2:4, 2:4]) / side,
    )
    return claim, covariance


def _log_focal_bound(of_lens: Array) -> float:
    """95 % bound of the logarithms of the focal lengths across and down, from the covariance (5, 5) of the lens."""
    variances = [
        np.array([1.0, half]) @ of_lens[np.ix_([0, 4], [0, 4])] @ np.array([1.0, half]) for half in (0.5, -0.5)
    ]
    return NORMAL_95 * math.sqrt(max(*variances, 0.0))
