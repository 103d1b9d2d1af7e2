"""What is known of the keyframes' cameras and depth, and the verdict on it: thoroughly, or soon and provisionally."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from splatnode.capture.frame import LEAST_SIGMA, DroppedFrame, Frame, GivenPose, Stamp, make_given_pose
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.process.system import raise_shortage
from splatnode.recon import verification
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.core import give_back_memory
from splatnode.recon.keyframes import (
    LIBRARY_ERRORS,
    Features,
    Keyframe,
    Rejected,
    find_picture,
    mask_bars,
    resize_image,
)
from splatnode.recon.locating.localize import collect_landmarks, measure_shears
from splatnode.recon.matching import features
from splatnode.recon.matching.view_graph import Pair, ViewGraph
from splatnode.recon.metric.depth_alignment import place_beside, place_by_depth
from splatnode.recon.metric.depth_fit import fit_depth_images, make_depth_views
from splatnode.recon.metric.depth_fusion import fill_measured_depth
from splatnode.recon.priors import Pointmap, Prior, apply_image_masks
from splatnode.recon.rasterize import choose_device, format_device
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.registration.known_poses import GivenWorld, Offset
from splatnode.recon.registration.mapping_problem import compute_pooled_ratio
from splatnode.recon.registration.posed_mapping import find_telling_pairs, offset_of, register_posed
from splatnode.recon.registration.registration import Registration, register, undistort_keyframes
from splatnode.recon.registration.rigs import RigEstimate
from splatnode.recon.result.snapshot import DepthCode, Landmarks
from splatnode.recon.result.verdict import SURE, TWO_SIDED_95, Bounds, Code, Verdict
from splatnode.recon.threads import BACKGROUND, RunContext
from splatnode.recon.verification.decision import (
    EXIF_LEFT_OUT,
    contradicts_exif,
    decide,
    excludes_exif,
    forget_exif,
    refuse_before_registration,
)
from splatnode.recon.verification.error_model import (
    compute_log_odds,
    compute_placed_bounds,
    compute_posed_bounds,
    decide_posed,
    describe_rig,
    make_evidence_record,
    predict_bounds,
    shape_bounds,
)
from splatnode.recon.verification.evidence import Evidence, verify, verify_further
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.input_kinds import explain_refusal, refuse_stereo_or_panorama

# What is needed before frames can be matched: the loaded prior, and each frame as a keyframe.

log = logging.getLogger(__name__)


class UnusableFrame(ValueError):
    """One frame that cannot become a keyframe; the text names it and says why."""


def load_prior(config: ReconstructionConfig) -> Prior:
    """The prior that the configuration names. Raises ValueError or FileNotFoundError where it lacks its weights."""
    return config.prior.module.load(msgspec.structs.replace(config.prior.config, seed=config.seed))


def check_device(config: ReconstructionConfig) -> None:
    """Before the work begins: raises DeviceUnavailable; the log tells the device where it was left open."""
    device = choose_device(config.device)
    if config.device != "cpu":
        log.info("%s", format_device(config.device, device))


def prepare(frame: Frame, config: ReconstructionConfig, found: Features | None = None) -> Keyframe:
    """The frame without distortion, with its image at modelled size and its features, unless these are known.

    No other frame is needed. Raises UnusableFrame where the given intrinsics cannot be used, or a library fails.
    """
    try:
        straight = undistort_frame(mask_bars(frame))
    except ValueError as error:  # it names the frame
        raise UnusableFrame(str(error)) from error
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        raise UnusableFrame(f"{frame.name}: its distortion cannot be taken out: {error}") from error
    frame = replace(straight, encoded=None)  # recordings alone want the file as it came
    try:
        found = found or features.apply_mask(features.extract(frame.image, config.matching.features), frame.mask)
        return Keyframe(frame, resize_image(frame.image, config.size), found)
    except LIBRARY_ERRORS as error:
        raise_shortage(error)
        raise UnusableFrame(f"{frame.name}: no features can be found in it: {error}") from error


def prepare_all(frames: Iterable[Frame], config: ReconstructionConfig) -> tuple[list[Keyframe], list[DroppedFrame]]:
    """The keyframes of all frames that can become one, and the others with the reason, which the log tells too.

    Raises UnusableFrame, of the first frame, where none of them can: then what they have in common is to blame.
    """
    keyframes, dropped, first = list[Keyframe](), list[DroppedFrame](), None
    for frame in frames:
        try:
            keyframes.append(prepare(frame, config))
        except UnusableFrame as error:
            log.warning("left out: %s", error)
            dropped.append(DroppedFrame(frame.name, str(error).removeprefix(f"{frame.name}: ")))
            first = first or error
    if first is not None and not keyframes:
        raise first
    return keyframes, dropped


# What is known of the keyframes' cameras and depth, and the verdict on it: thoroughly, or soon and provisionally.

# Points of a further camera that two others see, from which a provisional estimate places it; frames of another place
# that were taken for this one had up to 20.
MIN_CONFIRMED_POINTS = 50
PROVISIONALLY_WIDER = 2.0  # factor of a provisional estimate's bounds, whose sources are quick or taken over
LEAST_FITTING = 0.5  # share of all matches that fit given poses, below which these may be wrong together
_WHOLE = (0.0, 1.0, 0.0, 1.0)  # a picture without bars, as shares of the sides
_SAME_PICTURE = 0.02  # of a side, within which bars are alike
LENS_INSIDE_BARS = "black bars surround the picture, so that the lens that is told for it was not used."
_NOTHING = 1e-6  # share of a keyframe that rounding leaves
PROVISIONAL = "Provisional: checked again with all evidence when the camera rests."


@dataclass(frozen=True, eq=False)
class View:
    """The facts of one image beside its pose and its pixels."""

    name: str  # of its keyframe
    camera_id: str = ""  # of several cameras, which one; empty: there is one
    captured_at: Stamp | None = None
    bounds: Bounds | None = None  # of its camera's errors; None: it has no camera, or nothing was verified
    masked: float | None = None  # share that a mask hides; None: it has no mask
    moving: float = 0.0  # share that was found to move


@dataclass(frozen=True, eq=False)
class ReconstructionSummary:
    """The views, verdict and bounds of a reconstruction, without its images, features and matches."""

    verdict: Verdict
    views: Mapping[str, View]  # by the name of their keyframes, all of them
    evidence_record: dict[str, object] | None  # for reports; None where nothing was verified
    landmarks: Landmarks | None = None  # of a scene that is to be saved
    given: GivenWorld | None = None  # the world of given poses that hold the cameras; None: none do
    rig: RigEstimate | None = None  # that the cameras are on; None: they are on none


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The state of a reconstruction between matching and modelling."""

    graph: ViewGraph
    registration: Registration | None  # its cameras number the keyframes of `graph`
    evidence: Evidence | None  # None where there is nothing to verify
    verdict: Verdict
    pointmaps: Mapping[str, Pointmap] = field(default_factory=dict)  # by keyframe; none until depth is estimated
    shears: Mapping[str, float] = field(default_factory=dict)  # pixels across for one down, by image, where measured

    @property
    def publishable(self) -> bool:
        """Whether there are cameras, verified, that may be published."""
        held = self.evidence is not None or self.prior_world is not None
        return self.verdict.publishable and self.registration is not None and held

    @property
    def prior_world(self) -> GivenWorld | None:
        """The world of given poses that hold the cameras; None where none do."""
        return None if self.registration is None else self.registration.given

    @property
    def rig(self) -> RigEstimate | None:
        """The rig that the cameras are on; None where they are on none."""
        return None if self.registration is None else self.registration.rig

    @property
    def bounds(self) -> Mapping[str, Bounds]:
        """Returns the error bounds of each camera, by its keyframe's name; empty where nothing was verified.

        A provisional estimate claims less, so that what is known in the end is not less than was claimed before.
        """
        if self.registration is not None and self.registration.given is not None:
            return compute_posed_bounds(self.graph, self.registration, self.registration.given)
        if self.registration is None or self.evidence is None:
            return {}
        names, cameras = self.graph.names, self.registration.cameras
        covariances = {names[camera.index]: camera.centre_covariance for camera in cameras}
        found = shape_bounds(predict_bounds(self.evidence, FITTED.select_model(self.evidence).claims), covariances)
        if self.registration.rig is not None:
            found |= compute_placed_bounds(self.graph, self.registration, self.registration.rig, found)
        found = {name: _allow_for_shear(each, self.shears.get(name, 0.0)) for name, each in found.items()}
        wider = PROVISIONALLY_WIDER if self.verdict.provisional else 1.0
        return {name: bounds.widen(wider) for name, bounds in found.items()}

    @property
    def evidence_record(self) -> dict[str, object] | None:
        """The evidence and what it amounts to, for reports; None where nothing was verified."""
        if self.evidence is None:
            return None
        numbers = FITTED.select_model(self.evidence)
        return make_evidence_record(self.evidence, compute_log_odds(self.evidence, numbers.claims, numbers.odds))

    @property
    def summary(self) -> ReconstructionSummary:
        """Returns what snapshots publish of the cameras."""
        views = {each.name: each for each in self.views}
        return ReconstructionSummary(self.verdict, views, self.evidence_record, given=self.prior_world, rig=self.rig)

    @property
    def views(self) -> tuple[View, ...]:
        """Returns what is known of each keyframe, in their order."""
        bounds = self.bounds
        return tuple(
            View(
                name=each.name,
                camera_id=each.frame.camera_id,
                captured_at=each.frame.captured_at,
                bounds=bounds.get(each.name),
                masked=_measure_masked_share(each),
                moving=each.moving,
            )
            for each in self.graph.keyframes
        )

    @property
    def summary_to_save(self) -> ReconstructionSummary:
        """Returns the summary with landmarks to localize query images; gathering them takes up to a second."""
        return replace(self.summary, landmarks=self.landmarks)

    @property
    def landmarks(self) -> Landmarks | None:
        """Gathered from the cameras and all matches; None where no scene is published."""
        if not self.publishable or self.registration is None:
            return None
        return collect_landmarks(self.graph, self.registration, self.bounds)

    @property
    def camera_names(self) -> set[str]:
        """The keyframes that have a camera, whether it may be published or not."""
        cameras = () if self.registration is None else self.registration.cameras
        return {self.graph.keyframes[camera.index].name for camera in cameras}

    @property
    def publishable_camera_names(self) -> set[str]:
        """The keyframes that have a camera in a scene that may be published."""
        return self.camera_names if self.verdict.publishable else set()


def estimate_cameras(
    graph: ViewGraph,
    rejected: Sequence[Rejected],
    config: ReconstructionConfig,
    run: RunContext = BACKGROUND,
) -> Reconstruction:
    """Registers the keyframes of a complete view graph, verifies the cameras, and decides whether they are published.

    There is no registration where it would be of no use. With trusted poses, those that the images do not contradict
    hold the cameras. It pauses about once a second, which may raise.
    """
    posed = _estimate_from_poses(graph, config, run)
    if posed is not None and not _is_contradicted(posed):
        return posed
    alone = _estimate_from_images(graph, rejected, config, run)
    if posed is None or alone.verdict.code in SURE:
        return _remove_offset(alone, config, run) or alone
    return posed


def _measure_masked_share(keyframe: Keyframe) -> float | None:
    """Returns the share of an image that a given mask hides; None where it has none, or one of what moves alone."""
    if keyframe.frame.mask is None:
        return None
    share = 1.0 - float(keyframe.frame.mask.mean()) - keyframe.moving
    return share if share > _NOTHING or not keyframe.moving else None


def _estimate_from_images(
    graph: ViewGraph, rejected: Sequence[Rejected], config: ReconstructionConfig, run: RunContext
) -> Reconstruction:
    """As `estimate_cameras`, whatever poses are given."""
    doubtful = find_lenses_inside_bars(graph)
    if doubtful:
        found = _estimate_from_images(graph.forget_lenses(doubtful), rejected, config, run)
        message = f"{found.verdict.message} {', '.join(sorted(doubtful))}: {LENS_INSIDE_BARS}"
        return replace(found, graph=graph, verdict=replace(found.verdict, message=message))
    refusal = refuse_before_registration(graph, rejected, config.decision)
    if refusal is not None:
        return Reconstruction(graph, None, None, explain_refusal(refusal, graph))
    found = _register_and_verify(graph, config, run)
    doubted = contradicts_exif(graph, found.registration, found.evidence, found.verdict, config.decision)
    return _estimate_without_exif(found, config, run) if doubted else found


def find_lenses_inside_bars(graph: ViewGraph) -> frozenset[str]:
    """The names of the images with a told lens and with black bars that others of the same camera lack.

    A lens that is told may be that of the picture before it was shrunk into its bars. Where all images have the same
    bars, it is taken for that of the images as they are.
    """
    of_camera: dict[tuple[str, str], dict[str, tuple[float, float, float, float]]] = {}
    for keyframe in graph.keyframes:
        if keyframe.frame.intrinsics is not None:
            pictures = of_camera.setdefault((keyframe.frame.camera_id, keyframe.frame.camera), {})
            pictures[keyframe.name] = _measure_picture(keyframe)
    return frozenset(
        name
        for pictures in of_camera.values()
        if np.ptp(list(pictures.values()), axis=0).max() > _SAME_PICTURE
        for name, picture in pictures.items()
        if picture != _WHOLE
    )


def _measure_picture(keyframe: Keyframe) -> tuple[float, float, float, float]:
    """Upper, lower, left and right end of the picture between black bars, as shares of the sides."""
    inside = find_picture(keyframe.image)
    if inside is None:
        return _WHOLE
    (height, width), (rows, columns) = keyframe.image.shape[:2], inside
    return rows.start / height, rows.stop / height, columns.start / width, columns.stop / width


def _register_and_verify(graph: ViewGraph, config: ReconstructionConfig, run: RunContext) -> Reconstruction:
    registration = register(graph.keyframes, graph.pairs, config.registration, run, config.frame_set_tolerance_s)
    run.pause()
    seen = None if registration is None else registration.image_part
    evidence = verify(graph, seen, config.verification, run)
    give_back_memory()
    verdict = explain_refusal(decide(graph, seen, evidence, config.decision), graph)
    limits = {} if seen is None else _limit_shears(graph, seen, verdict)
    shears = measure_shears(graph, seen) if seen is not None and (verdict.publishable or limits) else {}
    verdict = _name_sheared(verdict, shears, limits)
    if registration is not None and registration.rig is not None:
        verdict = describe_rig(verdict, graph, registration.rig)
    kept = registration if verdict.publishable else seen
    return Reconstruction(graph, kept, evidence, verdict, shears=shears)


# What an image that is sheared among others may be taken for, where there are enough of them to tell which one it is
_OF_SHEARED = Code.AMBIGUOUS, Code.FOCAL_SUSPECT, Code.PLANAR_ONLY
_MOST_ALIKE = 3  # cameras with which a sheared one may agree by bending the scene
_MOST_SHEAR = 0.01  # by which an image that is named is sheared, and differs from most others
_SHEAR_OF_ANSWER = 0.04  # the same of images that share a lens, in an answer: a film of a telephone has up to .03
_LEAST_SHEAR = 0.003  # below, bounds allow for it


def _limit_shears(graph: ViewGraph, registration: Registration, verdict: Verdict) -> dict[str, float]:
    """Limits the shear of each image, by name, beyond which it is named; empty where none is to blame for the verdict.

    A lens of its own takes a shear up as a principal point far from the middle, and its camera aside. Images of an
    answer that share a lens may be sheared as a telephone's are that turns.
    """
    cameras = registration.cameras
    if len(cameras) <= _MOST_ALIKE or not (verdict.publishable or verdict.code in _OF_SHEARED):
        return {}
    return {
        graph.names[each.index]: _MOST_SHEAR if each.own_lens or not verdict.publishable else _SHEAR_OF_ANSWER
        for each in cameras
    }


def _name_sheared(verdict: Verdict, shears: Mapping[str, float], limits: Mapping[str, float]) -> Verdict:
    """The refusal of the image that is sheared most, where it stands out, in place of what it looks like.

    What all images have alike, as of one pan, does not count.
    """
    middle = float(np.median(list(shears.values()))) if shears else 0.0
    found = [
        (name, shear)
        for name, shear in shears.items()
        if name in limits and min(abs(shear), abs(shear - middle)) > limits[name]
    ]
    if not found:
        return verdict
    name, shear = max(found, key=lambda each: abs(each[1]))
    return verification.refuse(verification.SHEARED, (name,), name=name, percent=100.0 * abs(shear))


def _allow_for_shear(bounds: Bounds, shear: float) -> Bounds:
    """The bounds of a camera whose image is sheared: a turn about the axis by half of the angle takes up most of it."""
    if abs(shear) < _LEAST_SHEAR:
        return bounds
    return replace(bounds, rotation_deg=float(np.hypot(bounds.rotation_deg, np.degrees(shear))))


def _estimate_without_exif(found: Reconstruction, config: ReconstructionConfig, run: RunContext) -> Reconstruction:
    """The estimate as if EXIF told no focal length, where its bounds exclude what EXIF tells; else `found`."""
    graph = found.graph
    other = _register_and_verify(forget_exif(graph), config, run)
    if other.registration is None or not other.verdict.publishable:
        return found
    was_exact = found.verdict.publishable and found.verdict.code is not Code.OK_ROUGH
    rougher = was_exact and other.verdict.code is Code.OK_ROUGH
    if rougher or len(other.camera_names) < len(found.publishable_camera_names):
        return found
    if not excludes_exif(graph, other.registration, other.bounds):
        return found
    message = f"{other.verdict.message} {EXIF_LEFT_OUT}"
    return replace(other, graph=graph, verdict=replace(other.verdict, message=message))


def _estimate_from_poses(
    graph: ViewGraph, config: ReconstructionConfig, run: RunContext, offset: Offset | None = None
) -> Reconstruction | None:
    """The estimate whose cameras given poses hold; None where they are not trusted, or cannot hold any.

    `offset` is taken out of all poses.
    """
    if not config.registration.trust_poses or refuse_stereo_or_panorama(graph.keyframes) is not None:
        return None
    registration = register_posed(graph.keyframes, graph.pairs, config.registration, run, offset)
    give_back_memory()
    if registration is None or registration.given is None:
        return None
    return Reconstruction(
        graph, registration, None, decide_posed(graph, registration, registration.given, config.decision)
    )


def estimate_cameras_by_depth(
    graph: ViewGraph, config: ReconstructionConfig, run: RunContext = BACKGROUND
) -> Reconstruction | None:
    """The estimate whose cameras depth images place, in metres, however little the images share.

    None where depth images place fewer than two cameras, or what the images match contradicts them. It pauses about
    once a second, which may raise.
    """
    placed = place_by_depth([each.frame for each in graph.keyframes], run.pause)
    if not placed:
        return None
    poses = {each.name: make_given_pose(each.T_world_camera, each.sigma_m, each.sigma_deg) for each in placed}
    return _hold_by_depth(graph, poses, max(each.scale_sigma for each in placed), config, run)


def add_cameras_by_depth(
    known: Reconstruction, config: ReconstructionConfig, run: RunContext = BACKGROUND
) -> Reconstruction | None:
    """The estimate `known`, in metres, with cameras that it lacks and depth images place beside its own.

    Its own cameras are held within their bounds, and adjusted together with the others. None where no camera is added,
    the depth images do not fit the images, or these contradict the others. It pauses about once a second, which may
    raise.
    """
    graph, registration = known.graph, known.registration
    lacking = {each.name for each in graph.keyframes if each.frame.depth is not None} - known.camera_names
    if not lacking or not known.publishable or registration is None or registration.given is not None:
        return None
    fits = fit_depth_images(make_depth_views(graph, registration))
    if not fits or not all(fit.is_usable for fit in fits):
        return None
    weights = np.array([fit.sigma for fit in fits]) ** -2.0
    unit = float(np.exp(np.average([np.log(fit.metres_per_unit) for fit in fits], weights=weights)))
    own, poses = {}, {}
    for camera in registration.cameras:
        name, T = graph.names[camera.index], camera.T_world_camera.copy()
        T[:3, 3] *= unit
        own[name], bound = T, known.bounds[name]
        sigma_m, sigma_deg = unit * bound.centre / TWO_SIDED_95, bound.rotation_deg / TWO_SIDED_95
        poses[name] = make_given_pose(T, max(sigma_m, LEAST_SIGMA), max(sigma_deg, LEAST_SIGMA))
    placed = place_beside([each.frame for each in graph.keyframes], own, run.pause)
    if not placed:
        return None
    poses |= {each.name: make_given_pose(each.T_world_camera, each.sigma_m, each.sigma_deg) for each in placed}
    posed = _hold_by_depth(graph, poses, float(weights.sum() ** -0.5), config, run)
    if posed is None or posed.registration is None or posed.registration.given is None:
        return None
    by_depth = frozenset(graph.names.index(each.name) for each in placed) & posed.registration.given.held
    verdict = decide_posed(graph, posed.registration, replace(posed.registration.given, held=by_depth), config.decision)
    return replace(posed, verdict=verdict) if by_depth else None


def _hold_by_depth(
    graph: ViewGraph, poses: Mapping[str, GivenPose], scale_sigma: float, config: ReconstructionConfig, run: RunContext
) -> Reconstruction | None:
    """The estimate whose cameras are held by `poses`, of which depth images tell; None where images contradict them.

    `scale_sigma` is the standard deviation of the logarithm of all lengths alike.
    """
    keyframes = [
        replace(keyframe, frame=replace(keyframe.frame, given_pose=poses.get(keyframe.name)))
        for keyframe in graph.keyframes
    ]
    absolute = msgspec.structs.replace(config.registration, poses_drift=0.0, poses_drift_deg=0.0)
    found = register_posed(keyframes, graph.pairs, absolute, run)
    give_back_memory()
    if found is None or found.given is None:
        return None
    given = replace(found.given, from_depth=True, scale_sigma=float(np.hypot(found.given.scale_sigma, scale_sigma)))
    telling = find_telling_pairs(graph.pairs)
    registration = _drop_doubtful_points(replace(found, given=given), telling)
    verdict = decide_posed(graph, registration, given, config.decision)
    posed = Reconstruction(graph, registration, None, verdict)
    is_refuted = _is_contradicted(posed, telling) or _points_contradict_depth(posed)
    return None if is_refuted else posed


def _drop_doubtful_points(registration: Registration, telling: Collection[Pair]) -> Registration:
    """Returns the registration without the points that no `telling` pair, of many matches, shows.

    Between plain walls, few matches are often wrong; cameras that depth images place cannot tell.
    """
    observed, seen_by = registration.observed_point, registration.observed_by
    shown = np.zeros(len(registration.points), bool)
    for pair in telling:
        first, second = (observed[seen_by == index] for index in pair)
        shown[np.intersect1d(first, second)] = True
    kept = shown[observed]
    return replace(
        registration,
        points=registration.points[shown],
        observed_by=seen_by[kept],
        observed_point=(np.cumsum(shown) - 1)[observed[kept]],
        observed_pixels=registration.observed_pixels[kept],
    )


def _points_contradict_depth(posed: Reconstruction) -> bool:
    """Whether points that the images see from the cameras lie elsewhere than depth images have them."""
    if posed.registration is None:
        return False
    fits = fit_depth_images(make_depth_views(posed.graph, posed.registration))
    return any(fit.check.code is DepthCode.CONTRADICTS for fit in fits)


def _is_contradicted(posed: Reconstruction, by: Collection[Pair] | None = None) -> bool:
    """Whether so few matches fit that the poses may be wrong together: then no single one stands out.

    `by` are the pairs that count; None: all.
    """
    if posed.registration is None or not posed.graph.pairs:
        return False
    ratios, counted = posed.registration.inlier_ratios, posed.graph.pairs if by is None else by
    known = {pair: ratio for pair, ratio in ratios.items() if pair in counted}
    return bool(known) and compute_pooled_ratio(known, posed.graph.pairs) < LEAST_FITTING


def _remove_offset(alone: Reconstruction, config: ReconstructionConfig, run: RunContext) -> Reconstruction | None:
    """The estimate held by given poses without what is wrong with all of them alike; None where nothing is."""
    if not config.registration.trust_poses or alone.registration is None or not alone.verdict.publishable:
        return None
    offset = offset_of(alone.graph.keyframes, alone.registration)
    posed = None if offset is None else _estimate_from_poses(alone.graph, config, run, offset)
    return None if posed is None or _is_contradicted(posed) else posed


def estimate_depth(estimate: Reconstruction, prior: Prior, run: RunContext = BACKGROUND) -> Reconstruction:
    """Adds a point map for each camera; none where the verdict forbids a scene. It pauses as above.

    A prior that can end early gives coarser depth from the deadline on.
    """
    if estimate.registration is None or not estimate.verdict.publishable:
        return estimate
    run = run.end_at_deadline() if prior.ends_early else run
    graph, registration = undistort_keyframes(estimate.graph, estimate.registration)
    pointmaps = fill_measured_depth(prior.pointmaps(graph, registration, run), graph, registration)
    give_back_memory()
    return replace(estimate, pointmaps=apply_image_masks(pointmaps, graph))


def extend_reconstruction(
    known: Reconstruction, graph: ViewGraph, config: ReconstructionConfig
) -> Reconstruction | None:
    """A provisional estimate for `graph`, which has the keyframes of `known` and others beside them.

    None where `known` has two cameras only, the others cannot be placed beyond doubt, or the verdict would not be
    publishable.
    """
    if known.registration is None or known.evidence is None or not known.verdict.publishable:
        return None
    if len(known.registration.cameras) <= 2:
        return None  # what is known of two cameras says nothing about a third one
    position = {name: index for index, name in enumerate(graph.names)}
    names = known.graph.names
    if not position.keys() >= set(names):
        return None
    start = [replace(camera, index=position[names[camera.index]]) for camera in known.registration.cameras]
    registration = registration_registration.extend_registration(
        graph.keyframes, graph.pairs, start, config.registration
    )
    further = position.keys() - set(names)
    if registration is None or not _has_cameras_of(registration, [position[name] for name in further]):
        return None
    evidence = verify_further(graph, registration, known.evidence, config.verification)
    if evidence is None:
        return None
    if any(camera.confirmed < MIN_CONFIRMED_POINTS for camera in evidence.cameras if camera.name in further):
        return None
    verdict = decide(graph, registration, evidence, config.decision)
    if not verdict.publishable:
        return None
    message = f"{verdict.message} {PROVISIONAL}"
    return Reconstruction(graph, registration, evidence, replace(verdict, message=message, provisional=True))


def _has_cameras_of(registration: Registration, indices: Collection[int]) -> bool:
    return {camera.index for camera in registration.cameras}.issuperset(indices)
