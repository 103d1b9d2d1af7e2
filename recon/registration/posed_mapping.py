"""Registration with given poses: cameras in the world of these, whether images share matches or not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, ndtri

from splatnode.recon.geometry import align_cameras, angles_deg, compute_rms_radius, cross_matrix
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.pair_matching import Pair, TwoView
from splatnode.recon.registration import (
    bundle_adjustment,
    incremental_mapper,
    known_poses,
    mapping_problem,
    multiview_geometry,
    self_calibration,
)
from splatnode.recon.registration.bundle_adjustment import differentiate_by_pose
from splatnode.recon.registration.incremental_mapper import FinalModel, MapperConfig, MapperResult
from splatnode.recon.registration.known_poses import Deviation, Drift, Given, GivenWorld, Offset, has_pose
from splatnode.recon.registration.mapping_problem import MapperInput, SparseModel
from splatnode.recon.registration.registration import (
    Registration,
    RegistrationConfig,
    convert_to_lens_pixels,
    make_registration,
    make_views,
    patch_images,
    relabel_pairs,
    sort_by_content,
)
from splatnode.recon.registration.subpixel import PatchImage
from splatnode.recon.threads import BACKGROUND, RunContext

# What is wrong with all given poses alike: how the camera sits on what carries it was told wrongly.

Array = npt.NDArray[np.float64]

_LEAST_CAMERAS = 4  # 24 numbers for a similarity and an offset, which are 13
_LEAST_TURN_DEG = 5.0  # by which orientations must differ: of cameras that look one way a shift is one of the world
_MOST_SIGMAS = 3.0  # root of the mean square of what is left, of which images are a part
_IMAGES = 2.0  # times as wide as given: what images do not know of their cameras counts, too
_OF_SHIFT_M = 1.0  # standard deviation of the offset's shift before anything is known, metres


def offset_of(keyframes: Sequence[Keyframe], registration: Registration) -> Offset | None:
    """The offset in the camera's frame in which all given poses agree with the cameras of the images alone.

    None where there are too few cameras to tell it, or no offset explains the poses.
    """
    chosen = [camera for camera in registration.cameras if has_pose(keyframes[camera.index])]
    poses = [keyframes[camera.index].frame.given_pose for camera in chosen]
    if len(chosen) < _LEAST_CAMERAS:
        return None
    scene, given = np.stack([camera.T_world_camera for camera in chosen]), np.stack([p.matrix for p in poses if p])
    turned = Rotation.from_matrix(np.swapaxes(scene[:1, :3, :3], 1, 2) @ scene[:, :3, :3]).magnitude()
    if np.degrees(turned.max()) < _LEAST_TURN_DEG:
        return None
    sigmas = _IMAGES * np.array([(np.radians(pose.sigma_deg), pose.sigma_m) for pose in poses if pose])
    begun = align_cameras(scene, given)
    middle, size = scene[:, :3, 3].mean(0), max(compute_rms_radius(given[:, :3, 3]), 1e-9)

    def offset(values: Array) -> Array:
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = Rotation.from_rotvec(values[7:10]).as_matrix(), size * values[10:13]
        return X

    def errors(values: Array) -> Array:
        rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ begun.rotation
        scale = begun.scale * np.exp(values[6])
        moved = np.tile(np.eye(4), (len(scene), 1, 1))
        moved[:, :3, :3] = rotation @ scene[:, :3, :3]
        moved[:, :3, 3] = begun(middle) + size * values[3:6] + scale * (scene[:, :3, 3] - middle) @ rotation.T
        expected = moved @ offset(values)
        turns = Rotation.from_matrix(np.swapaxes(expected[:, :3, :3], 1, 2) @ given[:, :3, :3]).as_rotvec()
        moves = expected[:, :3, 3] - given[:, :3, 3]
        parts = [(turns / sigmas[:, :1]).ravel(), (moves / sigmas[:, 1:]).ravel(), size * values[10:13] / _OF_SHIFT_M]
        return np.concatenate(parts)

    found = least_squares(errors, np.zeros(13), x_scale=0.01)
    left = float(np.sqrt(2.0 * found.cost / (6 * len(scene) - 13)))
    if left >= _MOST_SIGMAS:
        return None
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    turn, shift = (float(np.sqrt(np.linalg.eigvalsh(covariance[b, b]).max())) for b in (slice(7, 10), slice(10, 13)))
    return Offset(offset(found.x), turn, size * shift)


# The model of images whose poses are given: these start it and hold it, and the images still judge each of them.
#
# Where an image's matches fit another pose, or the adjusted model is farther from a given pose than both sigmas allow,
# that pose is let go, the worst first; the images alone place its camera then, where they can.


# First observations decide where cameras are, each as if it were one of its own: poses do not bend what images agree
# on, and what is left of the errors is noise of the images
_OWN_PX = 0.5  # of an observation, at REFERENCE_SIDE, before errors are known
# Then poses and images are weighed against each other, as unsure as both are. Images count 2.5 times less sure than by
# themselves: what lenses and shutters do otherwise than the model is the same in all images, and a given pose that is
# true must not be let go for it
_LESS_SURE = 2.5
# Of an observation, at REFERENCE_SIDE, at least: what is alike in all of an image does not fall as aligned patches do
_LEAST_PX = 0.15
_WIDE_PX = 12.0  # of the robust loss then: what poses do to all observations alike makes none of them an outlier
# Twice the logarithm of the odds (100 to 1) by which a pose must be likelier false than another to be let go alone
_DECIDED = 2.0 * math.log(100.0)
_FIRST_ERRORS = 3.0  # sigmas of the given poses, in pixels, up to which observations are kept at first
_MOST_TOLERANCE = 12.0  # times the largest error of an observation
_LEAST_HELD = 2  # poses that must stay
_DOUBTED_RATIO = 0.6  # share of a view's matches that fit, below which its pose is doubted
_MORE, _MORE_POINTS = 1.5, 15  # factor and number by which more observations must fit another pose
_LEAST_OBSERVATIONS = 15  # of points that two others see, of a camera that images alone place
# A pair with so many matches tells whether a pose is false: most agree on another one, and few on what is given
_TELLING_MATCHES, _CONSISTENT, _AGREEING = 40, 0.8, 0.3
# Far from what is given, repeated structure (the other wing of a castle) is likelier than such an error of a pose
_FAR_DEG, _TELLING_FAR = 15.0, 150
_ROUNDS = 3  # of tests after a model was finished


@dataclass(frozen=True, eq=False)
class PosedMap:
    """A model in the frame of the given poses."""

    model: MapperResult
    deviations: tuple[Deviation, ...]  # of views, the worst first; lengths in metres


# Whether images contradict given poses: the residual of each pose against all others, beyond both sigmas.
#
# A pose g with covariance S holds its camera; the adjustment puts that at x with covariance C, in which g counts. Then
# x - g has the covariance S - C, whatever else is known, so that no adjustment without g is needed (Cook and Weisberg,
# "Residuals and influence in regression", 1982, 2.2). Directions that images do not tell do not count.

# Of a false alarm: 3.9 sigmas. Of 190 false poses 3 more are named than by 1e-5, and none of 204 sets of true ones
LEAST_PROBABILITY = 1e-4
_DOUBTED = 1e-2  # probability below which a pose widens the bounds of its camera to where images alone have it
_LEAST_SHARE = 0.05  # least share of a pose's variance that images must take away for a direction to count
_SMALLEST = 1e-300  # of a probability, whose sigmas are finite


@dataclass(frozen=True, eq=False)
class Residual:
    """How far a camera is from its given pose."""

    turn: Array  # (3,) radians, about the camera's axes
    shift: Array  # (3,) along them, in the problem's unit
    probability: float  # that an error as large comes by chance; 1 where images tell nothing
    squared: float = 0.0  # its length in its own sigmas, squared: by how much the cost falls without the pose
    # (6,) turn and shift, as above, from where the camera is to where it would be without its given pose
    without: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def sigmas(self) -> float:
        """The deviation of a normal variable that is as unlikely."""
        return float(-ndtri(max(self.probability, _SMALLEST) / 2.0))


def residuals(
    problem: bundle_adjustment.Problem, given: bundle_adjustment.GivenPoses, covariance: bundle_adjustment.Covariance
) -> dict[int, Residual]:
    """Computes the residual of each camera that `given` has a pose of and `covariance` is finite for.

    Where `problem.given` holds a camera, its residual is against all others; where not, against the images alone.
    """
    held = np.zeros(len(given.sigmas), bool) if problem.given is None else problem.given.is_held
    blocks, found, priors = covariance.cameras, {}, given.covariance
    for camera in np.flatnonzero(given.is_held).tolist():
        if not np.isfinite(blocks[camera]).all() or not blocks[camera].any():
            continue
        turn, shift, by_pose = deviation(problem, given, camera)
        own = slice(6 * camera, 6 * camera + 6)
        whiten = np.linalg.inv(np.linalg.cholesky(priors[own, own]))
        error = whiten @ np.concatenate([turn, shift])
        known = whiten @ by_pose @ blocks[camera] @ by_pose.T @ whiten.T
        of_residual = np.eye(6) - known if held[camera] else np.eye(6) + known
        variances, directions = np.linalg.eigh((of_residual + of_residual.T) / 2.0)
        counts = variances > _LEAST_SHARE
        squared = float(((directions.T @ error)[counts] ** 2 / variances[counts]).sum())
        probability = float(chdtrc(counts.sum(), squared)) if counts.any() else 1.0
        # An observation with the covariance I that is taken away moves x by C (I - C)^-1 (x - g)
        axes = directions[:, counts]
        moved = known @ axes @ ((axes.T @ error) / variances[counts])
        found[camera] = Residual(turn, shift, probability, squared, np.linalg.solve(whiten, moved))
    return found


def deviation(
    problem: bundle_adjustment.Problem, given: bundle_adjustment.GivenPoses, camera: int
) -> tuple[Array, Array, Array]:
    """Turn (3,) and shift (3,) of a camera from its given pose, and their derivatives (6, 6) by the camera's pose."""
    rotation = problem.rotations[camera]
    turn = Rotation.from_matrix(rotation @ given.rotations[camera].T).as_rotvec()
    x, y, z = seen = rotation @ given.centres[camera]
    by_pose = np.eye(6)
    by_pose[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return turn, seen + problem.translations[camera], by_pose


# The model.


def build_model(
    problem: MapperInput,
    focals: Sequence[float],
    given: Given,
    images: Sequence[PatchImage],
    config: MapperConfig,
    run: RunContext = BACKGROUND,
) -> PosedMap | None:
    """The model of all views with a given pose, and of the others that images place; None where too few poses hold.

    `focals` (one a lens) are in pixels.
    """
    config, alike = _count_each(config), _LESS_SURE * math.sqrt(config.finishing.correlated)
    tolerance = _first_tolerance(problem, focals, given, config)
    partial = _adjust_until_settled(problem, _start(problem, focals, given), tolerance, config)
    run.pause()
    partial = _release_single(problem, partial, given, config, alike)
    run.pause()
    partial = _release_undecided_pairs(problem, _let_go(problem, partial, config), config)
    partial = _test_poses(problem, _count_as_given(problem, partial), given, config, alike)
    run.pause()
    if partial is None:
        return None
    if len(partial.estimate.points) >= config.incremental.min_points:
        partial = incremental_mapper.extend(problem, partial, config.incremental)
    finished = _finish_model(problem, partial, images, config)
    for _ in range(_ROUNDS):
        run.pause()
        again = _test_poses(problem, finished, given, config, alike)
        if again is None:
            return None
        if again is finished.model:
            break
        finished = _finish_model(problem, again, images, config)
    finished = _remove_unseen_cameras(_weigh(problem, finished, alike))
    return PosedMap(
        incremental_mapper.make_result(
            problem, finished, config.incremental.triangulation.max_error_px, len(problem.lenses)
        ),
        _deviations(finished, given),
    )


def _count_each(config: MapperConfig) -> MapperConfig:
    """The configuration under which each observation counts as one of its own."""
    return msgspec.structs.replace(config, finishing=msgspec.structs.replace(config.finishing, correlated=1.0))


def _count_as_given(problem: MapperInput, partial: SparseModel) -> FinalModel:
    """The model with the noise that observations have before errors are known."""
    noise_px = _OWN_PX * float(np.median(problem.scale))
    return FinalModel(partial, bundle_adjustment.BundleAdjustmentConfig(noise_px=noise_px), 0.0)


def _weigh(problem: MapperInput, finished: FinalModel, alike: float) -> FinalModel:
    """The model in which given poses and images count as they are unsure; the same points, by the same observations.

    The noise of `finished` is that of an observation; what is alike in many makes each `alike` times less sure.
    """
    scale = float(np.median(problem.scale))
    noise_px = alike * max(finished.loss.noise_px, _LEAST_PX * scale)
    loss = bundle_adjustment.BundleAdjustmentConfig(robust_px=_WIDE_PX * scale, noise_px=noise_px)
    partial = finished.model
    if len(partial.estimate.points):
        estimate = bundle_adjustment.adjust(partial.estimate, partial.prior, loss, partial.registered[0])
        partial = replace(partial, estimate=estimate)
    return replace(finished, model=partial, loss=loss)


def _start(problem: MapperInput, focals: Sequence[float], given: Given) -> SparseModel:
    """The model of the given poses alone, without points."""
    poses, log_focals = given.poses, np.log(focals)
    estimate = bundle_adjustment.make_empty_problem(
        rotations=poses.rotations.copy(),
        translations=-np.einsum("cij,cj->ci", poses.rotations, poses.centres),
        lens_of_camera=np.array([view.lens for view in problem.views]),
        log_focals=log_focals,
        radials=np.array([lens.radial for lens in problem.lenses]),
        shifts=np.zeros((len(problem.lenses), 2)),
    )
    prior = bundle_adjustment.focal_prior(log_focals, np.array([lens.sigma for lens in problem.lenses]))
    known = tuple(np.flatnonzero(poses.is_held).tolist())
    return SparseModel(known, replace(estimate, given=poses), prior, np.zeros(0, np.int64))


def _first_tolerance(problem: MapperInput, focals: Sequence[float], given: Given, config: MapperConfig) -> float:
    """Returns how far the poses' sigmas move points in the worst view, as a multiple of the largest error."""
    known = np.flatnonzero(given.poses.is_held)
    lenses = [problem.views[i].lens for i in known]
    per_radian = np.array(focals)[lenses] / problem.scale[known]
    # Absolute positions that are known as well as orientations move points as much, however far away the scene is
    of_turns, of_both = math.sqrt(2.0) * given.poses.sigmas[known, 0], given.angle_sigmas[known]
    angles = of_turns if given.poses.joint is None else np.maximum(of_turns, of_both)
    most = _FIRST_ERRORS * float((angles * per_radian).max()) / config.incremental.triangulation.max_error_px
    return float(np.clip(most, incremental_mapper.SETTLED_TOLERANCE, _MOST_TOLERANCE))


def _adjust_until_settled(
    problem: MapperInput, partial: SparseModel, tolerance: float, config: MapperConfig
) -> SparseModel:
    """The model with points, adjusted while observations may have smaller and smaller errors."""
    scale = float(np.median(problem.scale))
    while True:
        robust_px = max(config.incremental.robust_px, tolerance / incremental_mapper.SETTLED_TOLERANCE) * scale
        loss = bundle_adjustment.BundleAdjustmentConfig(robust_px=robust_px, noise_px=_OWN_PX * scale)
        settings = config.incremental.triangulation
        partial = incremental_mapper.adjust(problem, partial, problem.growing_tracks, loss, tolerance, settings)
        if tolerance <= incremental_mapper.SETTLED_TOLERANCE:
            return partial
        tolerance = max(tolerance / 3.0, incremental_mapper.SETTLED_TOLERANCE)


def _find_held_views(partial: SparseModel) -> list[int]:
    """The views whose given pose holds them."""
    given = partial.estimate.given
    return [] if given is None else [view for view in partial.registered if given.is_held[view]]


def _release_poses(partial: SparseModel, views: Sequence[int]) -> SparseModel:
    """The model in which the given poses of these hold nothing."""
    given = partial.estimate.given
    if given is None:
        raise AssertionError("given poses hold the map")
    return replace(partial, estimate=replace(partial.estimate, given=given.release(views)))


def _release_single(
    problem: MapperInput, partial: SparseModel, given: Given, config: MapperConfig, alike: float
) -> SparseModel:
    """The model without the one pose that explains by itself all that is contradicted; without all that may be it.

    As it is where nothing is contradicted, or no single pose explains it.
    """
    doubted, _ = _find_contradictions(problem, partial, given, config, alike)
    explained: dict[int, tuple[SparseModel, float]] = {}
    for view in sorted(doubted):
        freed = _free(problem, partial, view, config)
        left, squared = _find_contradictions(problem, freed, given, config, alike)
        if not left:
            explained[view] = freed, squared
    least = min((squared for _, squared in explained.values()), default=0.0)
    possible = [view for view, (_, squared) in explained.items() if squared - least < _DECIDED]
    if len(possible) == 1:
        return explained[possible[0]][0]
    if not possible or not _may_release(partial, possible):
        return partial
    rest = tuple(view for view in partial.registered if view not in possible)
    rest = replace(_release_poses(partial, possible), registered=rest)
    return _adjust_until_settled(problem, rest, incremental_mapper.SETTLED_TOLERANCE, config)


def _find_contradictions(
    problem: MapperInput, partial: SparseModel, given: Given, config: MapperConfig, alike: float
) -> tuple[set[int], float]:
    """The held views that a pair or all images together contradict; the square of the largest residual, in sigmas."""
    refuted = {view for pair, said in _pairs_say(problem, partial, config).items() if said < 0 for view in pair}
    if not len(partial.estimate.points):
        return refuted, 0.0
    held = set(_find_held_views(partial))
    found = _residuals(_weigh(problem, _count_as_given(problem, partial), alike), given)
    found = {view: residual for view, residual in found.items() if view in held}
    beyond = {view for view, residual in found.items() if residual.probability < LEAST_PROBABILITY}
    return refuted | beyond, max((residual.squared for residual in found.values()), default=0.0)


def _free(problem: MapperInput, partial: SparseModel, view: int, config: MapperConfig) -> SparseModel:
    """The model in which images alone place `view`; without it where they cannot."""
    rest = replace(partial, registered=tuple(each for each in partial.registered if each != view))
    rest = _adjust_until_settled(problem, _release_poses(rest, [view]), incremental_mapper.SETTLED_TOLERANCE, config)
    if len(rest.estimate.points) < config.incremental.min_points:
        return rest
    found = mapping_problem.resect(problem, rest, view, config.incremental.resection)
    if found is None:
        return rest
    estimate = bundle_adjustment.replace_pose(rest.estimate, view, found.rotation, found.translation)
    freed = replace(rest, estimate=estimate, registered=partial.registered)
    return _adjust_until_settled(problem, freed, 2.0 * incremental_mapper.SETTLED_TOLERANCE, config)


def _may_release(partial: SparseModel, views: Sequence[int]) -> bool:
    """Whether most poses, and enough, hold their cameras without these."""
    num_held = len(_find_held_views(partial))
    return num_held - len(views) >= max(_LEAST_HELD, num_held // 2 + 1)


def _let_go(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> SparseModel:
    """The model without the poses of views whose matches hardly fit, and fit another pose much better."""
    tried: set[int] = set()
    while len(_find_held_views(partial)) > _LEAST_HELD:
        doubted = [view for view in _find_doubtful_views(problem, partial, config) if view not in tried]
        if not doubted:
            break
        tried.add(doubted[0])
        freed = _place_by_matches(problem, partial, doubted[0], config) or _place_refuted_view(
            problem, partial, doubted[0], config
        )
        if freed is not None:
            partial = freed
            tried.clear()
    return partial


def _find_doubtful_views(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> list[int]:
    """The views that a given pose holds and few of whose matches fit; those first that fit least."""
    ratios = mapping_problem.inlier_ratios(problem, partial, config.incremental.triangulation.max_error_px)
    of_view = {
        view: mapping_problem.compute_pooled_ratio(ratios, problem.pairs, view) for view in _find_held_views(partial)
    }
    matched = {view for pair in ratios for view in pair}
    return sorted(
        (view for view, ratio in of_view.items() if ratio < _DOUBTED_RATIO and view in matched), key=of_view.__getitem__
    )


def _place_by_matches(
    problem: MapperInput, partial: SparseModel, view: int, config: MapperConfig
) -> SparseModel | None:
    """The model with `view` where its matches place it; None where no more of them fit then."""
    freed = _free(problem, partial, view, config)
    if view not in freed.registered:
        return None
    before, after = (_observations(each)[view] for each in (partial, freed))
    return freed if after > _MORE * before + _MORE_POINTS else None


def _place_refuted_view(
    problem: MapperInput, partial: SparseModel, view: int, config: MapperConfig
) -> SparseModel | None:
    """The model with `view` where one pair places it, where its pairs with views that others confirm refute its pose.

    For views of which too little is seen by two others: nothing but the pair tells how far away they are.
    """
    says = _pairs_say(problem, partial, config)
    confirmed = {each for pair, said in says.items() if said > 0 for each in pair}
    refuting = [pair for pair, said in says.items() if said < 0 and view in pair and set(pair) & confirmed]
    if view in confirmed or not refuting:
        return None
    best = max(refuting, key=lambda pair: (len(problem.pairs[pair].matches), pair))
    rest = replace(partial, registered=tuple(each for each in partial.registered if each != view))
    rest = _adjust_until_settled(problem, _release_poses(rest, [view]), incremental_mapper.SETTLED_TOLERANCE, config)
    return replace(_place_by_pair(problem, rest, view, best, config), registered=partial.registered)


def _release_undecided_pairs(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> SparseModel:
    """The model without both views of a pair that refutes one of their poses, where nothing tells which.

    As it is where most of the poses would be gone with them.
    """
    says = _pairs_say(problem, partial, config)
    confirmed = {each for pair, said in says.items() if said > 0 for each in pair}
    undecided = [pair for pair, said in says.items() if said < 0 and not set(pair) & confirmed]
    views = {each for pair in undecided for each in pair}
    held = set(_find_held_views(partial))
    if not views or len(held - views) < _LEAST_HELD or 2 * len(held - views) <= len(held):
        return partial
    moved = _release_poses(
        replace(partial, registered=tuple(v for v in partial.registered if v not in views)), sorted(views)
    )
    for pair in undecided:
        for view in pair:
            found = _place_by_pair(problem, partial, view, pair, config).estimate
            pose = found.rotations[view], found.translations[view]
            moved = replace(moved, estimate=bundle_adjustment.replace_pose(moved.estimate, view, *pose))
    return _adjust_until_settled(problem, moved, incremental_mapper.SETTLED_TOLERANCE, config)


def _pairs_say(problem: MapperInput, partial: SparseModel, config: MapperConfig) -> dict[tuple[int, int], int]:
    """Judges pairs of held views: 1 where the matches agree with the poses, -1 where with others, else 0."""
    held, telling, found = set(_find_held_views(partial)), find_telling_pairs(problem.pairs), {}
    limit = config.incremental.triangulation.max_error_px
    for (i, j), pair in problem.pairs.items():
        if not {i, j} <= held or (i, j) not in telling:
            continue
        scale = float(problem.scale[i])
        share = float((multiview_geometry.sampson_errors(partial.estimate, (i, j), pair) < limit * scale).mean())
        if share > _AGREEING:
            found[i, j] = int(share > _DOUBTED_RATIO)
            continue
        rotation, _, num_fit = _relative(problem, partial, (i, j), config)
        given = partial.estimate.rotations[j] @ partial.estimate.rotations[i].T
        apart_deg = float(angles_deg(rotation, given))
        found[i, j] = -int(contradicts_poses(len(pair.matches), num_fit, apart_deg))
    return found


def find_telling_pairs(pairs: Mapping[Pair, TwoView]) -> set[Pair]:
    """Finds the pairs of so many matches that they may contradict poses and depth images.

    The edges of plain walls give matches, too, few and wrong ones.
    """
    return {pair for pair, found in pairs.items() if len(found.matches) >= _TELLING_MATCHES}


def contradicts_poses(num_matches: int, num_fit: int, apart_deg: float) -> bool:
    """Whether a pair whose matches hardly fit given poses tells that one of these is false.

    `num_fit` of its matches fit one other relative pose, whose rotation is `apart_deg` degrees away.
    """
    enough = num_fit >= (_TELLING_FAR if apart_deg > _FAR_DEG else 0)
    return enough and num_fit >= _CONSISTENT * num_matches


def _relative(
    problem: MapperInput, partial: SparseModel, pair: tuple[int, int], config: MapperConfig
) -> tuple[Array, Array, int]:
    """The pose of the second view of `pair` in the first one, and how many matches agree, by these alone."""
    i, j = pair
    focals = np.exp(partial.estimate.log_focals[partial.estimate.lens_of_camera[[i, j]]])
    limit = config.incremental.triangulation.max_error_px * float(problem.scale[i])
    return multiview_geometry.relative_pose(problem.pairs[pair], float(focals[0]), float(focals[1]), limit)


def _place_by_pair(
    problem: MapperInput, partial: SparseModel, view: int, pair: tuple[int, int], config: MapperConfig
) -> SparseModel:
    """The model with `view` where the matches of `pair` alone place it, as far from the other view as it was."""
    estimate, (first, second) = partial.estimate, pair
    rotation, direction, _ = _relative(problem, partial, pair, config)
    centres = bundle_adjustment.centres(estimate)
    move = direction / np.linalg.norm(direction) * np.linalg.norm(centres[second] - centres[first])
    if view == second:
        turned = rotation @ estimate.rotations[first]
        shifted = rotation @ estimate.translations[first] + move
    else:
        turned = rotation.T @ estimate.rotations[second]
        shifted = rotation.T @ (estimate.translations[second] - move)
    return replace(partial, estimate=bundle_adjustment.replace_pose(estimate, view, turned, shifted))


def _observations(partial: SparseModel) -> npt.NDArray[np.int64]:
    """(C,) how many points each camera observes."""
    return np.bincount(partial.estimate.camera_of, minlength=len(partial.estimate.rotations))


def _test_poses(
    problem: MapperInput,
    finished: FinalModel,
    given: Given,
    config: MapperConfig,
    alike: float,
) -> SparseModel | None:
    """The model without the given poses that it contradicts; None: too few hold. The model of `finished` if all hold.

    `alike`: see `_weigh`.
    """
    partial = finished.model
    while len(partial.estimate.points):
        weighed = _weigh(problem, finished, alike)
        held, found = set(_find_held_views(partial)), _residuals(weighed, given)
        contradicted = _find_contradicted({view: found[view] for view in sorted(held & found.keys())})
        released = contradicted if _may_release(partial, contradicted) else contradicted[:1]
        if not released:
            break
        partial = _adjust_until_settled(
            problem, _release_poses(partial, released), 2.0 * incremental_mapper.SETTLED_TOLERANCE, config
        )
        finished = _count_as_given(problem, partial)
    return partial if len(_find_held_views(partial)) >= _LEAST_HELD and _most_hold(partial, given) else None


def _find_contradicted(found: Mapping[int, Residual]) -> list[int]:
    """The view whose pose is the most contradicted, and then others of which nothing tells that it is not they instead.

    None where no pose is contradicted.
    """
    beyond = [view for view in found if found[view].probability < LEAST_PROBABILITY]
    beyond.sort(key=lambda view: (found[view].probability, -found[view].squared))
    return [view for view in beyond if found[beyond[0]].squared - found[view].squared < _DECIDED]


def _most_hold(partial: SparseModel, given: Given) -> bool:
    return 2 * len(_find_held_views(partial)) > int(given.poses.is_held.sum())


def _residuals(finished: FinalModel, given: Given) -> dict[int, Residual]:
    """The residuals of the poses in a model in which these and images are weighed."""
    partial = finished.model
    covariance = bundle_adjustment.covariance(partial.estimate, partial.prior, finished.loss, -1)
    return residuals(partial.estimate, given.poses, covariance)


def _finish_model(
    problem: MapperInput, partial: SparseModel, images: Sequence[PatchImage], config: MapperConfig
) -> FinalModel:
    """The model after its last adjustment; as it is where there are too few points for one."""
    finished = (
        incremental_mapper.run_final_adjustment(problem, partial, images, config.finishing)
        if len(partial.estimate.points)
        else None
    )
    if finished is not None:
        return finished
    errors = bundle_adjustment.reprojection_errors(partial.estimate) / problem.scale[partial.estimate.camera_of]
    rms_px = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
    return replace(_count_as_given(problem, partial), rms_px=rms_px)


def _remove_unseen_cameras(finished: FinalModel) -> FinalModel:
    """The model without cameras that nothing holds: neither a given pose nor enough observations."""
    partial, held = finished.model, set(_find_held_views(finished.model))
    estimate = partial.estimate
    seen_by = np.bincount(estimate.point_of, minlength=len(estimate.points))
    by_three = estimate.camera_of[seen_by[estimate.point_of] >= 3]
    counts = np.bincount(by_three, minlength=len(estimate.rotations))
    kept = tuple(v for v in partial.registered if v in held or counts[v] >= _LEAST_OBSERVATIONS)
    if kept == partial.registered:
        return finished
    rest = bundle_adjustment.keep_observations(estimate, np.isin(estimate.camera_of, kept))
    rest = bundle_adjustment.adjust(rest, partial.prior, finished.loss) if len(rest.points) else rest
    return replace(finished, model=replace(partial, registered=kept, estimate=rest))


def _deviations(finished: FinalModel, given: Given) -> tuple[Deviation, ...]:
    """Lists the given poses that do not hold their cameras."""
    held, found = set(_find_held_views(finished.model)), []
    residuals = _residuals(finished, given) if len(finished.model.estimate.points) else {}
    for view in np.flatnonzero(given.poses.is_held).tolist():
        if view in held:
            continue
        turn, shift, _ = deviation(finished.model.estimate, given.poses, view)
        sigmas = residuals[view].sigmas if view in residuals else math.nan
        metres = given.metres * float(np.linalg.norm(shift))
        found.append(Deviation(view, metres, float(np.degrees(np.linalg.norm(turn))), sigmas))
    return tuple(sorted(found, key=lambda each: -each.sigmas if math.isfinite(each.sigmas) else 0.0))


# Registration with given poses: cameras in the world of these, whether images share matches or not.

Pairs = Mapping[tuple[int, int], TwoView]


def register_posed(
    keyframes: Sequence[Keyframe],
    pairs: Pairs,
    config: RegistrationConfig,
    run: RunContext = BACKGROUND,
    offset: Offset | None = None,
) -> Registration | None:
    """The cameras of the keyframes whose pose is given and true, and of those that images place beside them.

    None where given poses cannot hold a model: fewer than two have a pose and a lens that are told, or the images
    contradict as many of them as they confirm. `offset` is taken out of all poses. `pairs` and `run`: see `register`.
    """
    order = sort_by_content(keyframes)
    ordered, rank = [keyframes[index] for index in order], np.argsort(order)
    drift = Drift(config.poses_drift, config.poses_drift_deg)
    given = known_poses.collect_known_poses(ordered, offset, drift)
    if given is None:
        return None
    grouping = self_calibration.group(ordered, across_sizes=True)
    matched = known_poses.add_guided_matches(ordered, relabel_pairs(pairs, rank), given)
    run.pause()
    views = make_views(ordered, grouping)
    known = self_calibration.candidates(ordered, grouping, matched, config.lenses)
    settings = config.mapper
    problem = mapping_problem.prepare(
        views,
        known,
        convert_to_lens_pixels(matched, grouping),
        settings.max_growing_tracks,
        settings.max_final_tracks,
    )
    focals, images = [lens.focals[0] for lens in known], patch_images(ordered, grouping, config)
    built = build_model(problem, focals, given, images, settings, run)
    if built is None:
        return None
    moved = replace(built, model=built.model.relabel(order))
    found = make_registration(moved.model, keyframes, [grouping.scales[i] for i in rank], config)
    return replace(found, given=_world(moved, found, given, order, offset))


def _world(
    built: PosedMap, found: Registration, given: Given, order: Sequence[int], offset: Offset | None
) -> GivenWorld:
    """How the registration `found` of `built`, whose views are keyframes, lies in the given world.

    View i of `built.deviations` is keyframe `order[i]`.
    """
    estimate, views = built.model.estimate, [camera.index for camera in found.cameras]
    first, unit = views[0], _unit(built, found)
    to_first, from_first = estimate.rotations[first], estimate.translations[first]
    held = [] if estimate.given is None else [view for view in views if estimate.given.is_held[view]]
    covariance = bundle_adjustment.covariance(estimate, built.model.prior, built.model.loss, -1)
    turns, moves = differentiate_by_pose(estimate.rotations[views], estimate.translations[views])
    rows = (6 * np.array(views)[:, None] + np.arange(6)).ravel()
    joint = covariance.joint[np.ix_(rows, rows)]
    blocks = [slice(3 * i, 3 * i + 3) for i in range(len(views))]
    in_world = [(to_first @ turns[b], unit * to_first @ moves[b]) for b in blocks]
    # What is not known of the offset is not known of any camera.
    turn_sigma, shift_sigma = (0.0, 0.0) if offset is None else (offset.turn_sigma, offset.shift_sigma)
    of_turn, of_shift = turn_sigma**2 * np.eye(3), (shift_sigma * unit / given.metres) ** 2 * np.eye(3)
    doubt = _find_doubt(estimate, covariance)
    turn_doubts, shift_doubts = (
        np.stack([size * to_first @ doubt.get(view, np.zeros((2, 3)))[row] for view in views])
        for row, size in ((0, 1.0), (1, unit))
    )
    return GivenWorld(
        scale=given.metres / unit,
        rotation=to_first.T,
        translation=given.origin - given.metres * to_first.T @ from_first,
        scale_sigma=0.0 if estimate.given is None else compute_scale_sigma(estimate.given),
        deviations=tuple(replace(each, index=order[each.index]) for each in built.deviations),
        offset=offset,
        turn_covariances=np.stack([turn @ joint @ turn.T + of_turn for turn, _ in in_world]) + _square(turn_doubts),
        centre_covariances=np.stack([move @ joint @ move.T + of_shift for _, move in in_world]) + _square(shift_doubts),
        held=frozenset(held),
    )


def _square(offsets: Array) -> Array:
    """(C, 3, 3) covariances of C cameras that may be off by `offsets` (C, 3)."""
    return offsets[:, :, None] * offsets[:, None, :]


def _find_doubt(problem: bundle_adjustment.Problem, covariance: bundle_adjustment.Covariance) -> dict[int, Array]:
    """How far cameras would turn and move (2, 3), along the world's axes, without a given pose that is in doubt."""
    if problem.given is None or not len(problem.points):
        return {}
    found = {}
    for camera, residual in residuals(problem, problem.given, covariance).items():
        if residual.probability < _DOUBTED:
            found[camera] = residual.without.reshape(2, 3) @ problem.rotations[camera]
    return found


def compute_scale_sigma(given: bundle_adjustment.GivenPoses) -> float:
    """Standard deviation of the logarithm of the scale at which cameras of a known shape fit given poses."""
    held = np.flatnonzero(given.is_held)
    middle = given.centres[held].mean(0)
    by_similarity = np.zeros((6 * len(given.centres), 7))
    for camera in held.tolist():
        rotation, off = given.rotations[camera], given.centres[camera] - middle
        own = slice(6 * camera, 6 * camera + 3), slice(6 * camera + 3, 6 * camera + 6)
        by_similarity[own[0], :3], by_similarity[own[1], 3:6] = rotation, rotation
        by_similarity[own[1], :3], by_similarity[own[1], 6] = -rotation @ cross_matrix(off[None])[0], rotation @ off
    covariance = np.linalg.pinv(by_similarity.T @ given.information @ by_similarity)
    return float(np.sqrt(covariance[6, 6]))


def _unit(built: PosedMap, found: Registration) -> float:
    """A length in `found` over the same in `built`: the registration scaled it."""
    return 1.0 / known_poses.distance(built.model.estimate, [camera.index for camera in found.cameras])
