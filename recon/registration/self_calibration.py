"""Lenses: which frames share one, and what is known of it before anything is reconstructed.

One camera stores its pictures in several sizes. Frames of one shape have the focal length over their longer side in
common. All lenses are described in the pixels of the largest frame, and smaller frames are scaled to that size: so an
error of so many pixels means the same in all views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.keyframes import Keyframe, longer_side
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment, multiview_geometry
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, SparseModel

# Focal length before anything is reconstructed: a vote of the pairs of frames.

# Focal lengths are counted over the longer side of the image.
_MIN_RATIO, _MAX_RATIO = 0.3, 5.0  # 118 to 11 degrees of view: beyond, a pair's own estimate is a failure
_GRID = np.geomspace(_MIN_RATIO, _MAX_RATIO, 240)  # of candidates, 1.2 % apart

_TYPICAL_RATIO = 1.0  # of phones and webcams: 53 degrees of view
_TYPICAL_SIGMA = 0.35  # of log focal around it
_TYPICAL_WEIGHT = 30.0  # matches that it counts as much as: a pair has hundreds

_VOTE_SIGMA = 0.06  # of log focal: the spread of the estimates of single pairs
_MIN_DISTANCE = 0.15  # between two candidates, of log focal: nearer ones lead to the same model


def vote(pairs: Sequence[TwoView], num_candidates: int) -> tuple[float, ...]:
    """The most likely ratios of focal length to longer side, the best first.

    A pair votes by a Gaussian kernel in log focal, with the number of its matches that neither a plane nor a rotation
    explains: these leave the focal length open. A weak prior around typical lenses settles what is undecided.
    """
    density = _TYPICAL_WEIGHT * np.exp(-0.5 * (np.log(_GRID / _TYPICAL_RATIO) / _TYPICAL_SIGMA) ** 2)
    for pair in pairs:
        count = len(pair.matches)
        if not _MIN_RATIO < pair.focal_ratio < _MAX_RATIO:
            continue
        weight = count * max(0.0, 1.0 - max(pair.num_homography, pair.num_rotation) / count)
        density += weight * np.exp(-0.5 * (np.log(_GRID / pair.focal_ratio) / _VOTE_SIGMA) ** 2)
    chosen: list[float] = []
    remaining: npt.NDArray[np.float64] = density
    for _ in range(num_candidates):
        best = float(_GRID[int(remaining.argmax())])
        chosen.append(best)
        remaining = remaining * (np.abs(np.log(_GRID / best)) > _MIN_DISTANCE)
    return tuple(chosen)


_NUM_CANDIDATES = 3  # focal lengths that are tried for a lens of which nothing is known
_SAME_NOMINAL = 0.01  # step of log focal in which nominal focal lengths are told apart: they are rounded numbers
# By which the distortion moves the farthest corner, over the longer side: 8 pixels of 512. What is estimated below is
# as much the errors of few points as the lens: held-out PSNR fell by .3 to .4 dB at 1 to 4 pixels, and rose from 13 on
LEAST_SHIFT = 0.016
CORNER = 0.6  # distance of a corner from the middle, over the longer side: that of a picture of 3 x 2
_ROUNDING_PX = 1.0  # difference of the shorter sides of two frames of one shape: sizes are whole pixels


class LensGroupingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lenses: which frames share one, and what is known of it before anything is reconstructed."""

    exif_sigma: float = 0.05  # of log focal, from EXIF: nominal focal lengths are rounded, and focusing changes them
    voted_sigma: float = 0.3  # of log focal, when pairs of frames voted for it
    # Largest difference of log focals, adjusted for each size of frames of one shape by itself, with which all have one
    # lens; beyond, some frames are crops or zoomed. Resized frames differed by 0.007 at most, crops to 75 % by
    # 0.114 at least, with the principal point as free as `free_shift_sigma`.
    max_focal_difference: float = 0.05
    free_shift_sigma: float = 0.1  # of the principal point in that comparison, as a share of the longer side


@dataclass(frozen=True)
class Grouping:
    """Frames grouped by lens."""

    lens_of: tuple[int, ...]  # of each frame
    longer_side: int  # of the largest frame, in whose pixels all lenses are described
    scales: tuple[float, ...]  # of each frame: these pixels over its own


def group(keyframes: Sequence[Keyframe], across_sizes: bool) -> Grouping:
    """Frames of one camera, one size (landscape or portrait) and one nominal focal length share a lens.

    If `across_sizes`, frames of one shape do, whatever their size. Nominal focal lengths count over the longer side.
    """
    first: list[Keyframe] = []  # of each lens
    lens_of = []
    for keyframe in keyframes:
        known = (lens for lens, other in enumerate(first) if _may_share(keyframe, other, across_sizes))
        lens = next(known, len(first))
        if lens == len(first):
            first.append(keyframe)
        lens_of.append(lens)
    sides = [longer_side(keyframe.frame) for keyframe in keyframes]
    largest = max(sides)
    return Grouping(tuple(lens_of), largest, tuple(largest / side for side in sides))


def _may_share(one: Keyframe, other: Keyframe, across_sizes: bool) -> bool:
    """Whether two frames may have been taken through one lens."""
    if _nominal(one) != _nominal(other):
        return False
    if one.frame.camera_id != other.frame.camera_id:
        return False
    cameras = one.frame.camera, other.frame.camera
    if all(cameras) and cameras[0] != cameras[1]:
        return False
    (long1, short1), (long2, short2) = (sorted(k.frame.image.shape[:2], reverse=True) for k in (one, other))
    if not across_sizes:
        return (long1, short1) == (long2, short2)
    return abs(short1 / long1 - short2 / long2) * min(long1, long2) <= _ROUNDING_PX


def _nominal(keyframe: Keyframe) -> tuple[str, int] | None:
    """Source and step of the focal length that came with a frame; None without one."""
    given = keyframe.frame.intrinsics
    if given is None:
        return None
    return given.source, round(float(np.log(given.fx / longer_side(keyframe.frame))) / _SAME_NOMINAL)


def candidates(
    keyframes: Sequence[Keyframe],
    grouping: Grouping,
    pairs: Mapping[tuple[int, int], TwoView],
    config: LensGroupingConfig,
) -> list[Lens]:
    """For each lens, the focal length that came with its frames, else those that the pairs of its frames vote for."""
    found = []
    for lens in range(max(grouping.lens_of) + 1):
        members = [i for i, member in enumerate(grouping.lens_of) if member == lens]
        given = keyframes[members[0]].frame.intrinsics
        if given is not None:
            calibrated = given.source in ("given", "calibration")
            scale = grouping.scales[members[0]]
            found.append(Lens((scale * given.fx,), 0.0 if calibrated else config.exif_sigma))
            continue
        inside = [pair for key, pair in pairs.items() if key[0] in members and key[1] in members]
        # A single image has no pair through its own lens alone: those with other images say roughly what it is.
        inside = inside or [pair for key, pair in pairs.items() if key[0] in members or key[1] in members]
        ratios = vote(inside, _NUM_CANDIDATES)
        focals = tuple(ratio * grouping.longer_side for ratio in ratios)
        found.append(Lens(focals, config.voted_sigma, typical=_TYPICAL_RATIO * grouping.longer_side))
    return found


def sizes_disagree(
    estimate: bundle_adjustment.Problem,
    prior: bundle_adjustment.LensPrior,
    loss: bundle_adjustment.BundleAdjustmentConfig,
    fixed_camera: int,
    grouping: Grouping,
    config: LensGroupingConfig,
) -> bool:
    """Whether frames that share a lens get different focal lengths when each of their sizes has a lens of its own.

    Calibrated lenses (sigma 0) are never doubted.
    """
    kinds = sorted(set(zip(grouping.lens_of, grouping.scales, strict=True)))
    kind_of = np.array([kinds.index(kind) for kind in zip(grouping.lens_of, grouping.scales, strict=True)])
    lens_of = np.array([lens for lens, _ in kinds])
    apart = replace(
        estimate,
        lens_of_camera=kind_of,
        log_focals=estimate.log_focals[lens_of],
        radials=estimate.radials[lens_of],
        shifts=estimate.shifts[lens_of],
        log_aspects=np.log(estimate.aspects)[lens_of],
        skews=estimate.all_skews[lens_of],
    )
    sigmas = prior.sigmas[lens_of]
    free = bundle_adjustment.LensPrior(
        log_focals=prior.log_focals[lens_of],
        sigmas=sigmas,
        radial_sigmas=prior.radial_sigmas[lens_of],
        shift_sigmas=np.where(sigmas > 0, config.free_shift_sigma * grouping.longer_side, 0.0),
    )
    focals = bundle_adjustment.adjust(apart, free, loss, fixed_camera).log_focals
    observed = np.bincount(kind_of[estimate.camera_of], minlength=len(kinds)) > 0
    return any(
        np.ptp(focals[observed & (lens_of == lens)]) > config.max_focal_difference
        for lens in set(lens_of[observed].tolist())
    )


# Own lenses: is the lens that images are taken to share refuted by any of them?
#
# A zoom, an autofocus that breathes, a second camera of the same resolution or a crop gives an image a lens of its
# own. Nothing tells that beforehand. So each lens parameter of an image is a common value plus a deviation, under a
# prior whose width is estimated from the deviation itself (automatic relevance determination: MacKay, "Bayesian
# interpolation", 1992). A deviation stays where the observations tell it well enough; any other falls to where
# `Config` holds it. Images with a deviation that stays get a lens of their own. What cannot be decided widens the
# covariance (`widen_lens_priors`).

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_FOCAL, _RADIAL, _SHIFT, _ASPECT, _SKEW = 0, 1, slice(3, 5), 5, 6  # columns of the parameters of a lens
_SHAPE = slice(5, 7)  # its aspect and skew
FEWEST_FOR_SHAPES = 3  # views, of which each may have an aspect and a skew of its own
_ROUNDS = 8  # of adjustments, each under the prior that the one before gave
_OWN_SIGMA = 0.5  # of log focal, of a lens whose focal length was refuted
_NEGLIGIBLE = 1e-6  # a sigma below it is 0
_WIDE_ROUNDS = 3  # of a coarse search, in which all deviations are free
_COARSE_TOLERANCE = 5.0  # of the points of a coarse search, times `max_error_px`
_MANY = 0.3  # share of a group's views that refute its common lens, from which on no view is taken to have it
_MANY_CALIBRATED = 0.7  # the same of a lens that was given
_WIDER = 1.5  # times the deviations of such a group that were found: those of its other views are not known
_MORE = 1.001  # times a sigma: rounding does not make one larger
_ITERATIONS, _DECREASE = 15, 1e-4  # of the adjustments but the last


class OwnLensesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Standard deviations of an image's deviations from the common lens, where nothing refutes that it is common
    focal_sigma: float = 0.004  # of log focal
    shift_sigma: float = 0.0015  # of the principal point, as a share of the longer side
    radial_sigma: float = 0.01  # of the first radial coefficient
    own_aspect_sigma: float = 0.001  # of the log aspect
    skew_sigma: float = 0.001  # of the skew: how far a row moves across for one down, in focal lengths
    aspect_sigma: float = 0.003  # of the log aspect that all images of a group have in common
    # The same where the search for deviations begins, in which all of them are free
    widest_focal: float = 0.3  # of log focal
    widest_shift: float = 0.1  # of the principal point, as a share of the longer side
    widest_radial: float = 0.1  # of the first radial coefficient
    widest_skew: float = 0.1  # of the skew: how far a row moves across for one down, in focal lengths
    widest_aspect: float = 0.3  # of the log aspect, both of an image and of what all images of a group have in common
    # A deviation of at least so many standard errors stays
    refuted_at: float = 4.25
    # Of what all images have in common where it is given: calibrations differ by as much
    calibrated_focal: float = 0.002  # of log focal
    calibrated_shift: float = 0.001  # of the principal point, as a share of the longer side
    # Pixels far from square, which the search for deviations does not find, are tried where a free aspect differs at
    # least so much (of the log aspect)
    least_aspect: float = 0.05
    aspect_gain: float = 0.9  # and leaves at most this share of the cost


@dataclass(frozen=True, eq=False)
class PerViewLensModel:
    """A model in which each view has a lens of its own, near the common one of its group."""

    estimate: bundle_adjustment.Problem  # with C lenses, one a view
    prior: bundle_adjustment.LensPrior  # of these
    stays: Flags  # (C, 7) deviations from the common lens that stay
    widths: Array  # (C, 7) of the deviations of a group many of whose views refute that it has this in common; else 0
    common: Array  # (C, 7) the common parameters of the group of each view
    displaced: Flags  # (C,) views of groups whose common principal point or aspect is not what it was taken for

    @property
    def refutes(self) -> bool:
        """Whether a view refutes the common lens, or a group that its lens is what it was taken for."""
        return bool(self.refuting_views.any() or self.displaced.any())

    @property
    def refuting_views(self) -> Flags:
        """(C,) views that refute the common lens."""
        return np.asarray(self.stays.any(axis=1))


def free_lenses(
    problem: MapperInput,
    partial: SparseModel,
    loss: bundle_adjustment.BundleAdjustmentConfig,
    config: OwnLensesConfig,
    coarse: multiview_geometry.TriangulationConfig | None = None,
    shapes: bool = True,
) -> PerViewLensModel:
    """The model adjusted with a lens for each view, and which views refute that theirs is common.

    With `shapes` each view may have an aspect and a skew of its own, too.

    `loss` has the noise of an observation, by which deviations are weighed. With `coarse` points are triangulated anew
    before each adjustment, with large errors allowed: a model that a wrong common lens has bent lacks those that tell.
    """
    sides = np.array([view.longer_side for view in problem.views], np.float64)
    groups, registered = partial.estimate.lens_of_camera, np.zeros(len(problem.views), bool)
    registered[list(partial.registered)] = True
    shared = np.bincount(groups[registered], minlength=len(partial.prior.sigmas)) > 1
    floors = _narrowest_own(sides, config, int(registered.sum()))
    widest = config.widest_focal, config.widest_shift, config.widest_radial
    own = _sigmas(*widest, sides, config.widest_aspect, config.widest_skew)
    own[:, _SHAPE] = np.where(shapes & (floors[:, _SHAPE] > 0), own[:, _SHAPE], 0.0)
    own[~shared[groups]] = 0.0  # of a lens with one view there is nothing to deviate from
    least = _least_common(partial.prior, groups, sides, config)
    common = np.maximum(least, _sigmas(0.0, config.widest_shift, 0.0, sides, config.widest_aspect))
    common[~shared[groups]] = least[~shared[groups]]
    estimate, kept = expand_lenses(partial.estimate), 2.0 / config.refuted_at
    quick = msgspec.structs.replace(loss, max_iterations=_ITERATIONS, tolerance=_DECREASE)
    middles, sizes = np.zeros_like(own), np.zeros_like(own)
    prior = _prior(partial.prior, groups, own, common)
    for turn in range(_ROUNDS):
        if coarse is not None:
            estimate, _ = multiview_geometry.retriangulate(
                estimate, problem.growing_tracks, partial.registered, problem.scale, coarse, _COARSE_TOLERANCE
            )
        estimate = bundle_adjustment.adjust(
            estimate, prior, loss if turn == _ROUNDS - 1 else quick, partial.registered[0]
        )
        middles = _common_parameters(estimate, prior, registered)
        # What is `refuted_at` standard errors from its mean, or farther, stays under such a prior
        sizes = kept * _pool_deviations(_parameters(estimate) - middles)
        if coarse is not None and turn < _WIDE_ROUNDS:
            continue
        own = np.where(own > 0, np.maximum(sizes, floors), 0.0)
        offset = kept * _pool_deviations(middles)
        for k in (_SHIFT, _ASPECT):
            common[:, k] = np.where(common[:, k] > 0, np.maximum(offset[:, k], least[:, k]), 0.0)
        if turn < _ROUNDS - 1:
            prior = _prior(partial.prior, groups, own, common)
    stays = (sizes > floors) & (own > 0) & registered[:, None]
    widths = _widths(stays, sizes / kept, groups, registered, partial.prior.sigmas == 0)
    displaced = (common > _MORE * least)[:, 3:].any(1)
    return PerViewLensModel(
        estimate, prior, stays | (widths > 0), widths, middles, displaced & shared[groups] & registered
    )


def _widths(stays: Flags, sizes: Array, groups: Index, registered: Flags, calibrated: Flags) -> Array:
    """(C, 7) the RMS deviation of a view's group in a parameter that many of its views refute; 0 where few do."""
    widths = np.zeros_like(sizes)
    for group in np.unique(groups[registered]):
        (members,) = np.nonzero((groups == group) & registered)
        many = stays[members].mean(0) >= (_MANY_CALIBRATED if calibrated[group] else _MANY)
        widths[members] = np.where(many & (stays[members].sum(0) > 1), np.sqrt((sizes[members] ** 2).mean(0)), 0.0)
    return widths


def split_lenses(
    problem: MapperInput, partial: SparseModel, freed: PerViewLensModel, config: OwnLensesConfig
) -> tuple[MapperInput, SparseModel]:
    """Both, with lenses of their own for the refuted views, and everything where the freed model has it."""
    (views,) = np.nonzero(freed.refuting_views)
    groups, found = partial.estimate.lens_of_camera, freed.estimate
    lens_of = groups.copy()
    lens_of[views] = len(problem.lenses) + np.arange(len(views))
    # What a group has in common is taken where it may change.
    common = _parameters(partial.estimate)
    sigmas = partial.prior.own_sigmas
    for view in partial.registered:
        group = groups[view]
        if partial.prior.sigmas[group] > 0:
            common[group, _FOCAL] = freed.common[view, _FOCAL]
        if freed.displaced[view]:
            common[group, 3:] = freed.common[view, 3:]
            if freed.prior.common is not None:
                sigmas[group, 3:] = np.maximum(sigmas[group, 3:], freed.prior.common.sigmas[view, 3:])
    of_views = _parameters(found)[views]
    own = np.maximum(freed.prior.own_sigmas[views], np.abs(of_views))
    own[:, _FOCAL] = _OWN_SIGMA
    sides = np.array([problem.views[view].longer_side for view in views], np.float64)
    floors = _narrowest_own(sides, config, len(partial.registered))
    values, sigmas = np.concatenate([common, of_views]), np.concatenate([sigmas, own])
    estimate = replace(
        found,
        lens_of_camera=lens_of,
        log_focals=values[:, _FOCAL],
        radials=values[:, 1:3],
        shifts=values[:, _SHIFT],
        log_aspects=values[:, _ASPECT],
        skews=values[:, _SKEW],
    )
    known = partial.prior.ties
    to, tied = (np.full(len(common), -1), np.zeros_like(common)) if known is None else (known.to, known.sigmas)
    ties = bundle_adjustment.LensTies(
        to=np.concatenate([to, groups[views]]),
        sigmas=np.concatenate([tied, np.where(freed.stays[views], _WIDER * freed.widths[views], floors)]),
    )
    means = partial.prior.log_focals
    prior = bundle_adjustment.LensPrior(
        log_focals=np.concatenate([means, means[groups[views]]]),
        sigmas=sigmas[:, _FOCAL],
        radial_sigmas=sigmas[:, 1:3],
        shift_sigmas=sigmas[:, 3],
        aspect_sigmas=sigmas[:, _ASPECT],
        skew_sigmas=sigmas[:, _SKEW],
        ties=ties,
    )
    lenses = [*problem.lenses, *(Lens((float(np.exp(focal)),), _OWN_SIGMA) for focal in of_views[:, _FOCAL])]
    numbered = [replace(view, lens=int(lens)) for view, lens in zip(problem.views, lens_of, strict=True)]
    problem = replace(problem, views=tuple(numbered), lenses=tuple(lenses))
    return problem, replace(partial, estimate=estimate, prior=prior)


def free_aspects(
    partial: SparseModel, loss: bundle_adjustment.BundleAdjustmentConfig, config: OwnLensesConfig
) -> SparseModel | None:
    """The model adjusted with pixels of any aspect; None where these explain little more or hardly differ."""
    before, prior = partial.estimate, free_aspect_prior(partial, config)
    after = bundle_adjustment.adjust(before, prior, loss, partial.registered[0])
    moved = np.abs(np.log(after.aspects / before.aspects)).max()
    costs = [bundle_adjustment.robust_cost(each, loss) for each in (before, after)]
    if moved < config.least_aspect or not costs[1] <= config.aspect_gain * costs[0]:
        return None
    return replace(partial, estimate=after, prior=prior)


def free_aspect_prior(partial: SparseModel, config: OwnLensesConfig) -> bundle_adjustment.LensPrior:
    """The prior of the model with pixels of any aspect, one for lenses that are tied; given lenses keep theirs."""
    prior = partial.prior
    lenses = partial.estimate.lens_of_camera[list(partial.registered)]
    free = np.isin(np.arange(len(prior.sigmas)), lenses) & (prior.sigmas > 0)
    sigmas = prior.own_sigmas[:, _ASPECT]
    return replace(prior, aspect_sigmas=np.where(free, np.maximum(sigmas, config.widest_aspect), sigmas))


def is_stretched(partial: SparseModel, config: OwnLensesConfig) -> bool:
    """Whether a view of the model has pixels that are far from square."""
    aspects = partial.estimate.aspects[partial.estimate.lens_of_camera[list(partial.registered)]]
    return bool(np.abs(np.log(aspects)).max() > config.least_aspect)


def find_common_lens(prior: bundle_adjustment.LensPrior, lens: int, config: OwnLensesConfig) -> int:
    """The common lens whose focal length and distortion a lens has; the lens itself where these are its own."""
    if prior.ties is None or prior.ties.to[lens] < 0:
        return lens
    tied = prior.ties.sigmas[lens]
    if not 0 < tied[_FOCAL] <= _MORE * config.focal_sigma or not 0 < tied[_RADIAL] <= _MORE * config.radial_sigma:
        return lens
    return int(prior.ties.to[lens])


def widen_lens_priors(
    problem: bundle_adjustment.Problem, prior: bundle_adjustment.LensPrior, sides: Array, config: OwnLensesConfig
) -> tuple[bundle_adjustment.Problem, bundle_adjustment.LensPrior]:
    """The same model with what is not known of lenses: each view may deviate from the lens that it shares.

    `sides` (C,) are the longer sides of the views' pictures. The covariance of the two has that in it.
    """
    lenses = problem.lens_of_camera
    common = prior.own_sigmas[lenses]
    floors = _narrowest_own(sides, config, len(np.unique(problem.camera_of)))
    if prior.ties is None:
        groups, tied = lenses, floors
    else:
        to = prior.ties.to[lenses]
        groups = np.where(to < 0, lenses, to)
        tied = np.where((to < 0)[:, None], floors, prior.ties.sigmas[lenses])
    shared = np.bincount(groups, minlength=len(prior.sigmas)) > 1
    # A parameter that is not tied, or of a lens that no other view shares, has its whole prior as its own.
    alone = ~shared[groups][:, None] | ((tied == 0) & (common > 0))
    own = np.where(alone, common, tied)
    common = np.where(alone, 0.0, prior.own_sigmas[groups])
    return expand_lenses(problem), _prior(prior, groups, own, common)


def expand_lenses(estimate: bundle_adjustment.Problem) -> bundle_adjustment.Problem:
    """The same model with as many lenses as views, in their order; those of a group are alike."""
    groups = estimate.lens_of_camera
    return replace(
        estimate,
        lens_of_camera=np.arange(len(groups)),
        log_focals=estimate.log_focals[groups],
        radials=estimate.radials[groups],
        shifts=estimate.shifts[groups],
        log_aspects=np.log(estimate.aspects)[groups],
        skews=estimate.all_skews[groups],
    )


def _narrowest_own(sides: Array, config: OwnLensesConfig, num_views: int) -> Array:
    """(C, 7) sigmas of the deviations of images that nothing tells to have a lens of their own.

    Fewer than FEWEST_FOR_SHAPES views tell nothing of a shape: each has that of its lens.
    """
    lens = config.focal_sigma, config.shift_sigma, config.radial_sigma
    shape = (config.own_aspect_sigma, config.skew_sigma) if num_views >= FEWEST_FOR_SHAPES else (0.0, 0.0)
    return _sigmas(*lens, sides, *shape)


def _sigmas(focal: float, shift: float, radial: float, sides: Array, aspect: float = 0.0, skew: float = 0.0) -> Array:
    """(C, 7)"""
    sigmas = np.zeros((len(sides), 7))
    sigmas[:, _FOCAL], sigmas[:, _RADIAL], sigmas[:, _SHIFT] = focal, radial, (shift * sides)[:, None]
    sigmas[:, _ASPECT], sigmas[:, _SKEW] = aspect, skew
    return sigmas


def _least_common(prior: bundle_adjustment.LensPrior, groups: Index, sides: Array, config: OwnLensesConfig) -> Array:
    """(C, 7) sigmas of what the views of a group have in common, where nothing speaks against what is known of it."""
    least = _sigmas(config.calibrated_focal, config.calibrated_shift, 0.0, sides, config.aspect_sigma)
    return np.maximum(prior.own_sigmas[groups], least)


def _prior(
    of_groups: bundle_adjustment.LensPrior, groups: Index, own: Array, common: Array
) -> bundle_adjustment.LensPrior:
    return bundle_adjustment.LensPrior(
        log_focals=of_groups.log_focals[groups],
        sigmas=own[:, _FOCAL],
        radial_sigmas=own[:, 1:3],
        shift_sigmas=own[:, 3],
        aspect_sigmas=own[:, _ASPECT],
        skew_sigmas=own[:, _SKEW],
        common=bundle_adjustment.CommonLensPrior(groups, common),
    )


def _parameters(estimate: bundle_adjustment.Problem) -> Array:
    """(G, 7)"""
    shapes = np.log(estimate.aspects), estimate.all_skews
    return np.column_stack([estimate.log_focals, estimate.radials, estimate.shifts, *shapes])


def _common_parameters(
    estimate: bundle_adjustment.Problem, prior: bundle_adjustment.LensPrior, registered: Flags
) -> Array:
    """(C, 7) the most likely common parameters of each view's group."""
    if prior.common is None:
        raise ValueError("the prior must have common parameters")
    values, means, own, common = _parameters(estimate), prior.means, prior.own_sigmas, prior.common.sigmas
    middles = values.copy()
    for group in np.unique(prior.common.group_of[registered]):
        (members,) = np.nonzero((prior.common.group_of == group) & registered)
        weights = 1.0 / np.maximum(own[members], _NEGLIGIBLE) ** 2
        held = 1.0 / np.maximum(common[members[0]], _NEGLIGIBLE) ** 2
        total = (weights * values[members]).sum(0) + held * means[members[0]]
        middles[prior.common.group_of == group] = total / (weights.sum(0) + held)
    return middles


def _pool_deviations(deviations: Array) -> Array:
    """(C, 7) sizes of the deviations; both coordinates of a principal point count as one."""
    sizes = np.abs(deviations)
    sizes[:, _SHIFT] = np.sqrt((deviations[:, _SHIFT] ** 2).mean(1))[:, None]
    return sizes


def separate_views(problem: MapperInput) -> MapperInput:
    """The problem with a lens for each view, of which next to nothing is known; any view may be a crop."""
    lenses, views = list(problem.lenses), []
    seen: set[int] = set()
    for view in problem.views:
        lens = view.lens
        if lens in seen:
            lens = len(lenses)
            lenses.append(problem.lenses[view.lens])
        seen.add(lens)
        views.append(replace(view, lens=lens))
        widest_shift = OwnLensesConfig().widest_shift * view.longer_side
        lenses[lens] = replace(lenses[lens], sigma=max(lenses[lens].sigma, _OWN_SIGMA), widest_shift=widest_shift)
    return replace(problem, views=tuple(views), lenses=tuple(lenses))


def add_lens(
    problem: MapperInput, partial: SparseModel, view: int, focal: float, shift: Array | None = None
) -> tuple[MapperInput, SparseModel]:
    """Both, with a lens of its own for a view, which the model then does not have.

    Focal length and shift (2,) of the principal point are in pixels. The view may be a crop: that point is free.
    """
    widest_shift = OwnLensesConfig().widest_shift * problem.views[view].longer_side
    number, before, prior = len(problem.lenses), partial.estimate, partial.prior
    lens_of = before.lens_of_camera.copy()
    lens_of[view] = number
    estimate = replace(
        before,
        lens_of_camera=lens_of,
        log_focals=np.append(before.log_focals, np.log(focal)),
        radials=np.vstack([before.radials, np.zeros((1, 2))]),
        shifts=np.vstack([before.shifts, np.zeros(2) if shift is None else shift]),
        log_aspects=np.append(np.log(before.aspects), 0.0),
        skews=np.append(before.all_skews, 0.0),
    )
    prior = bundle_adjustment.LensPrior(
        log_focals=np.append(prior.log_focals, np.log(focal)),
        sigmas=np.append(prior.sigmas, _OWN_SIGMA),
        radial_sigmas=np.vstack([prior.radial_sigmas, np.zeros((1, 2))]),
        shift_sigmas=np.append(prior.shift_sigmas, widest_shift),
        aspect_sigmas=None if prior.aspect_sigmas is None else np.append(prior.aspect_sigmas, 0.0),
        skew_sigmas=None if prior.skew_sigmas is None else np.append(prior.skew_sigmas, 0.0),
        ties=None
        if prior.ties is None
        else bundle_adjustment.LensTies(np.append(prior.ties.to, -1), np.vstack([prior.ties.sigmas, np.zeros((1, 7))])),
    )
    views = tuple(replace(each, lens=number) if index == view else each for index, each in enumerate(problem.views))
    own = Lens((focal,), _OWN_SIGMA, widest_shift=widest_shift)
    problem = replace(problem, views=views, lenses=(*problem.lenses, own))
    registered = tuple(each for each in partial.registered if each != view)
    return problem, replace(partial, registered=registered, estimate=estimate, prior=prior)
