"""What is claimed of verified cameras: 95 % bounds of their errors, from what the evidence says of their size.

A bound is a product of powers (a line between logarithms) of what three sources say (refit.py), and of the share of a
camera's matches that its pose explains: each source sees what another is blind to, none is in the unit of a standard
error, and errors of real cameras grow more slowly than any of them. The number of cameras counts, too: the more there
are, the more each source takes errors for independent that are not. `fitted.py` has the powers, which
`python -m tests.bench fit` finds from registrations of real photographs with known cameras.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from splatnode.capture.process.text import sanitize_text
from splatnode.recon import verification
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.known_poses import Deviation, GivenWorld
from splatnode.recon.registration.registration import Registration
from splatnode.recon.registration.rigs import Mount, MountResidual, RigChange, RigEstimate
from splatnode.recon.result.snapshot import format_rounded_up
from splatnode.recon.result.verdict import (
    Array,
    Bounds,
    Code,
    Verdict,
    compute_axes,
    compute_length_95,
    find_widest,
    make_ball,
)
from splatnode.recon.verification import DecisionConfig, refuse
from splatnode.recon.verification.evidence import CameraEvidence, Evidence
from splatnode.recon.verification.refit import Errors

MIN_INLIER_RATIO = 0.05  # a camera with fewer counts as this: a logarithm is taken
# At least so many times what the focal length leaves open within one standard error: two standard errors.
OF_PROFILE = 2.0
# At least so many standard errors of the bundle adjustment, in which each image's lens may differ a little from the
# common one. Of the first 240 sets that break what is assumed of lenses 14 were beyond their claim, and 25 with 1
OF_SIGMA = 2.5
# At least so many times how far the camera would move if each image had a lens of its own. Of 251 published sets that
# break what is assumed of lenses 42 were beyond 2.5 bounds without it, and with .6 bounds held for 89 to 94 % of their
# rotations and centres instead of 95
OF_LENSES = 0.8
# The same of two cameras, which no third one confirms: with .8, 92 % were within, and of 36 two were 2.5 bounds off
OF_LENSES_OF_TWO = 1.6

MAX_LOG_FOCAL = math.log(10.0)  # a factor of ten: who knows the focal length no better knows nothing


@dataclass(frozen=True)
class BoundModel:
    """The powers of one kind of bound, and what is added (in quadrature) to each source before it counts."""

    factor: float
    floor: float
    sigma: float
    regions: float
    profile: float
    inlier_ratio: float
    link: float  # of the share of matches explained across the weakest link: parts may lean against each other
    count: float  # of the number of cameras
    own_lens: float = 1.0  # times, where an image has a lens of its own: which images have one is not certain

    def predict_bound(
        self, errors: Errors, count: int, inlier_ratio: float = 1.0, link: float = 1.0, own_lens: bool = False
    ) -> float:
        """The bound in the unit of `errors`: never less than a source says. NaN and infinity stay what they are."""
        sources = {"sigma": errors.sigma, "regions": errors.regions, "profile": errors.profile}
        product = self.factor * count**self.count * (self.own_lens if own_lens else 1.0)
        product *= max(inlier_ratio, MIN_INLIER_RATIO) ** self.inlier_ratio * max(link, MIN_INLIER_RATIO) ** self.link
        for name, value in sources.items():
            product *= math.hypot(value, self.floor) ** getattr(self, name)
        parts = (
            product,
            OF_SIGMA * errors.sigma,
            errors.regions,
            OF_PROFILE * errors.profile,
            (OF_LENSES_OF_TWO if count == 2 else OF_LENSES) * errors.lenses,
        )
        return math.nan if any(math.isnan(part) for part in parts) else max(parts)


@dataclass(frozen=True)
class ErrorModel:
    """The models of the bounds. A length counts in the distance to the scene, a focal length in its logarithm."""

    rotation: BoundModel  # degrees
    centre: BoundModel
    focal: BoundModel


def predict_bounds(evidence: Evidence, model: ErrorModel) -> dict[str, Bounds]:
    """The bounds of each camera, by its name, with balls for ellipsoids; the distance to the scene is 1."""
    count, link = len(evidence.cameras), evidence.weakest_link.inlier_ratio
    own, found = any(camera.own_lens for camera in evidence.cameras), {}
    for camera in evidence.cameras:
        focal = model.focal.predict_bound(camera.focal, count, own_lens=own)
        centre = model.centre.predict_bound(camera.errors.centre, count, camera.inlier_ratio, link, own)
        found[camera.name] = Bounds(
            rotation_deg=model.rotation.predict_bound(camera.errors.rotation, count, camera.inlier_ratio, link, own),
            centre=centre,
            centre_percent=100.0 * centre,
            focal_percent=100.0 * math.expm1(min(focal, MAX_LOG_FOCAL)),
            axes=make_ball(centre),
        )
    return found


def shape_bounds(bounds: Mapping[str, Bounds], covariances: Mapping[str, Array]) -> dict[str, Bounds]:
    """The bounds with ellipsoids of the shape of each centre's covariance (3, 3), by the cameras' names."""
    return {name: replace(each, axes=compute_axes(covariances[name], each.centre)) for name, each in bounds.items()}


def compute_travel_percent(bounds: Mapping[str, Bounds], evidence: Evidence) -> float:
    """How far off a centre may be, in percent of how far the camera moved: of the RMS distance from their mean."""
    farthest = max((each.centre for each in bounds.values()), default=math.nan)
    return 100.0 * farthest / evidence.travel if evidence.travel > 0 else math.inf


# What the evidence amounts to: log odds that the poses are right, as a sum of terms (logistic regression).
#
# Wrong are poses whose errors are beyond their bounds. Each term is linear in one measure of
# all cameras together, counted from its value in right registrations; where one camera is worse than the others, the
# worst one counts. A measure is clipped where more of it says nothing more, so that none decides by its extremes.
# `fitted.py` has the slopes, which `python -m tests.bench fit` finds from registrations of real photographs: right
# ones, and wrong ones as they come, or made on purpose (frames that pose as others, mirrored frames, posters, moving
# things, crops).

# A camera whose matches lie on one plane that fills little of its picture may see a poster, a screen or a thing that
# moves: from this share of the matches on, and fully from the other.
FLAT_FROM, FLAT_FULLY = 0.8, 0.95
SMALL = 0.35  # share of the picture that the plane fills, below which it counts; half of it counts as much again
MIN_SHARE = 0.02  # a smaller one counts as this: a logarithm is taken


@dataclass(frozen=True)
class Term:
    """`slope` times how far a measure is from what it is in right registrations, in nats (natural log odds)."""

    typical: float
    slope: float

    def evaluate(self, measure: float) -> float:
        return self.slope * (measure - self.typical)


@dataclass(frozen=True)
class OddsModel:
    prior: float  # nats: where all measures are typical
    terms: Mapping[str, Term]  # by what `compute_measures` calls them


@dataclass(frozen=True)
class Odds:
    """In nats; NaN where a number behind them could not be computed."""

    prior: float
    terms: Mapping[str, float]  # by the measure that they rest on

    @property
    def total(self) -> float:
        return self.prior + sum(self.terms.values())

    @property
    def strongest_rejection(self) -> str:
        """The term that speaks most against the poses."""
        return min(self.terms, key=lambda name: self.terms[name])


def compute_measures(evidence: Evidence, model: ErrorModel) -> dict[str, float]:
    """Computes the measures that the terms rest on; NaN where a number behind one is not finite."""
    bounds, cameras = predict_bounds(evidence, model), evidence.cameras
    link = evidence.weakest_link
    return {
        "inlier_ratio": _clip(evidence.inlier_ratio, 0.0, 0.95),
        "camera_inlier_ratio": _clip(min(camera.inlier_ratio for camera in cameras), 0.0, 0.95),
        "link_inlier_ratio": _clip(link.inlier_ratio, 0.0, 1.0),
        "coverage": _clip_log(min(camera.coverage for camera in cameras), 0.05, 0.5),
        "flat_patch": max(measure_flat_patch(camera) for camera in cameras),
        "reflection": _clip(evidence.reflection.gain, 0.1, 1.0),
        "directions": _clip_log(evidence.cycles.direction_sigmas, 1.0, 30.0),
        "own_lens": float(any(camera.own_lens for camera in cameras)),
        "rotation_bound": _clip_log(max(each.rotation_deg for each in bounds.values()), 0.3, 30.0),
        "travel_bound": _clip_log(compute_travel_percent(bounds, evidence), 0.5, 100.0),
    }


def compute_log_odds(evidence: Evidence, claim_model: ErrorModel, model: OddsModel) -> Odds:
    """NaN for every term that rests on a number that is not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):  # what comes of it is told as NaN
        found = compute_measures(evidence, claim_model)
    return Odds(model.prior, {name: term.evaluate(found[name]) for name, term in model.terms.items()})


def make_evidence_record(evidence: Evidence, odds: Odds) -> dict[str, object]:
    """The evidence and what it amounts to, for report.json: None stands for a number that could not be computed."""
    log_odds = {"total": odds.total, "terms": dict(odds.terms)}
    return {name: _replace_non_finite(value) for name, value in {**asdict(evidence), "log_odds": log_odds}.items()}


def measure_flat_patch(camera: CameraEvidence) -> float:
    """0 where a camera's points fill much of its picture, or do not lie on a plane; else how small the plane is."""
    flat = _clip((camera.flat_share - FLAT_FROM) / (FLAT_FULLY - FLAT_FROM), 0.0, 1.0)
    return flat * max(0.0, _clip_log(SMALL / max(camera.coverage, MIN_SHARE), MIN_SHARE, 1.0 / MIN_SHARE))


def _replace_non_finite(value: Any) -> Any:
    """The value of dictionaries, lists and tuples with None for every number that is not finite."""
    if isinstance(value, dict):
        return {key: _replace_non_finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_replace_non_finite(each) for each in value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _clip_log(value: float, least: float, most: float) -> float:
    return math.log(clipped) if math.isfinite(clipped := _clip(value, least, most)) else math.nan


def _clip(value: float, least: float, most: float) -> float:
    """NaN where the value is not finite: clipping must not hide that something could not be computed."""
    return float(np.clip(value, least, most)) if math.isfinite(value) else math.nan


# The models of the verdict, with the numbers that a fitting found for them.


@dataclass(frozen=True)
class VerdictModel:
    claims: ErrorModel
    odds: OddsModel


@dataclass(frozen=True)
class VerdictModels:
    """Two cameras have numbers of their own: no third one sees their points, and no similarity takes out an error."""

    many: VerdictModel
    pair: VerdictModel

    def select_model(self, evidence: Evidence) -> VerdictModel:
        return self.pair if len(evidence.cameras) == 2 else self.many


# What is claimed of cameras that a rig places or given poses hold, and the verdict on them.

# What is claimed of cameras that a rig places, and what a verdict says of the rig.

_TWO_SIDED_95 = 1.96
_MOST_NAMED = 5  # changes that a sentence tells


def compute_placed_bounds(
    graph: ViewGraph, registration: Registration, rig: RigEstimate, bounds: Mapping[str, Bounds]
) -> dict[str, Bounds]:
    """The 95 % bounds of the cameras that the rig alone places: those of their frame set, and the rig's beside them."""
    cameras = {graph.names[camera.index]: camera for camera in registration.cameras}
    widest = find_widest(bounds.values())
    found: dict[str, Bounds] = {}
    for index in rig.placed:
        name = graph.names[index]
        frame_set = next(each for each in rig.frame_sets if name in each.names.values())
        beside = find_widest(bounds[other] for other in frame_set.names.values() if other in bounds) or widest
        if beside is None or name not in cameras:
            continue
        turn, shift = _mount_bounds(rig.mounts)
        levers = [
            np.linalg.norm(cameras[name].T_world_camera[:3, 3] - cameras[other].T_world_camera[:3, 3])
            for other in frame_set.names.values()
            if other in bounds and other in cameras
        ]
        lever = float(max(levers, default=0.0))
        centre = beside.centre + shift + np.radians(beside.rotation_deg + turn) * lever
        found[name] = Bounds(
            rotation_deg=beside.rotation_deg + turn,
            centre=centre,
            centre_percent=100.0 * centre,
            focal_percent=widest.focal_percent if widest else 0.0,
            axes=make_ball(centre),
        )
    return found


def _mount_bounds(mounts: tuple[Mount, ...]) -> tuple[float, float]:
    """Degrees and a length: the largest of all mounts, with how much single frame sets scatter about them."""
    wide = _TWO_SIDED_95 * np.sqrt(3.0)
    turn = max(float(np.hypot(mount.sigma_deg, np.degrees(mount.scatter[0]))) for mount in mounts)
    return wide * turn, wide * max(float(np.hypot(mount.sigma, mount.scatter[1])) for mount in mounts)


def describe_rig(verdict: Verdict, graph: ViewGraph, rig: RigEstimate) -> Verdict:
    """Adds to a publishable verdict what the rig placed, which of its cameras moved, and what was given wrongly."""
    if not verdict.publishable:
        return verdict
    sentences, advice = [verdict.message], [verdict.advice]
    ids = sorted({mount.camera_id for mount in rig.mounts})
    if rig.placed:
        sentences.append(f"The rig of {len(ids)} cameras places {len(rig.placed)} more.")
    if rig.changes:
        phrases = "; ".join(map(_format_change, rig.changes[:_MOST_NAMED]))
        more = f", and {len(rig.changes) - _MOST_NAMED} more" if len(rig.changes) > _MOST_NAMED else ""
        sentences.append(f"Cameras do not stand on the rig as in most frame sets: {phrases}{more}.")
        advice.append("Fasten these cameras, and calibrate the rig anew.")
    if rig.refuted:
        names = ", ".join(map(sanitize_text, rig.refuted))
        which = "is not where the given rig has it" if len(rig.refuted) == 1 else "are not where the given rig has them"
        off = "; ".join(map(_format_residual, rig.residuals[:_MOST_NAMED]))
        sentences.append(
            f"The photographs contradict the given rig, which is not believed there: {names} {which}"
            f"{f' ({off})' if off else ''}."
        )
        if rig.metres_per_unit is None:
            sentences.append("The rig gives no metres.")
        advice.append(_advise_on_refuted(rig))
    left = tuple(name for name in verdict.frames if name not in {graph.names[i] for i in rig.placed})
    return replace(verdict, message=" ".join(sentences), advice=" ".join(filter(None, advice)), frames=left)


def _format_change(change: RigChange) -> str:
    named = " or ".join(map(sanitize_text, change.camera_ids))
    return (
        f"{named} from frame set {change.first + 1} on ({change.count} sets) by {change.degrees:.2g} degrees and "
        f"{100 * change.shift:.2g} % of the distance"
    )


def _format_residual(residual: MountResidual) -> str:
    camera, beside = sanitize_text(residual.camera_id), sanitize_text(residual.beside)
    return (
        f"{camera} beside {beside} by {residual.degrees:.2g} degrees and {residual.metres:.2g} m, where "
        f"{residual.sigma_deg:.2g} degrees and {residual.sigma_m:.2g} m are one standard deviation"
    )


def _advise_on_refuted(rig: RigEstimate) -> str:
    if rig.is_inverse:
        return (
            "The photographs fit the inverses of the given poses: T_rig_camera leads from the camera to the rig "
            "(p_rig = T_rig_camera @ p_camera). Invert them."
        )
    return (
        "See that each camera is called as in the rig, that its pose leads from the camera to the rig, in metres, and "
        "that sigma_m and sigma_deg are not too small. Calibrate the rig anew, or leave it out: it is estimated "
        "then."
    )


# What is claimed of cameras that given poses hold, and the verdict on them.
#
# Images that alone cannot tell where they were taken are no reason to refuse here: the poses tell it.


def compute_posed_bounds(graph: ViewGraph, registration: Registration, given: GivenWorld) -> dict[str, Bounds]:
    """The 95 % bounds of each camera in the given world, by its name: of its given pose and the images together."""
    found = {}
    for position, camera in enumerate(registration.cameras):
        of_centre = given.centre_covariances[position]
        centre = compute_length_95(of_centre)
        focal = _TWO_SIDED_95 * camera.focal_sigma if np.isfinite(camera.focal_sigma) else 0.0
        found[graph.names[camera.index]] = Bounds(
            rotation_deg=float(np.degrees(compute_length_95(given.turn_covariances[position]))),
            centre=centre,
            centre_percent=100.0 * centre,
            focal_percent=100.0 * float(np.expm1(focal)),
            axes=compute_axes(of_centre, centre),
        )
    return found


def decide_posed(graph: ViewGraph, registration: Registration, given: GivenWorld, config: DecisionConfig) -> Verdict:
    """OK, or another code that is publishable; TOO_ROUGH where more was required than poses and images tell."""
    bounds = compute_posed_bounds(graph, registration, given)
    worst = find_widest(bounds.values())
    if worst is None:
        raise ValueError("there must be a camera to be judged")
    if config.max_position_error_percent is not None and worst.centre_percent > config.max_position_error_percent:
        found = worst.centre_percent
        return refuse(verification.ROUGHER, sorted(bounds), found=found, needed=config.max_position_error_percent)
    placed = {camera.index for camera in registration.cameras}
    left_out = tuple(name for index, name in enumerate(graph.names) if index not in placed)
    count = f"{'All' if not left_out else f'{len(placed)} of'} {len(graph.names)} photographs were placed"
    by = "what their depth images measured" if given.from_depth else "given poses"
    code, message = (Code.OK_PARTIAL if left_out else Code.OK), f"{count}, {len(given.held)} of them by {by}."
    if rough := _rough(registration, worst, config):
        code, message = Code.OK_ROUGH, f"{message[:-1]}, roughly: {rough}."
    give = "Take a depth image" if given.from_depth else "Give a pose"
    advice = f"{give} of {sanitize_text(left_out[0])}, or add a photograph beside it." if left_out else ""
    verdict = Verdict(code, message, advice, left_out, publishable=True)
    return _naming(verdict, graph, given, placed)


_LEAST_TRAVEL_PERCENT = 0.01  # of how far the camera moved, that is told


def _rough(registration: Registration, worst: Bounds, config: DecisionConfig) -> str:
    """Says what is known less well than an exact scene knows it; empty where nothing is."""
    # What the given world leaves open for all cameras alike bends no scene.
    shape = _TWO_SIDED_95 * max(camera.centre_sigma_rel for camera in registration.cameras)
    travel_percent = 100.0 * float(np.nan_to_num(shape, nan=np.inf))
    if travel_percent <= config.exact_travel_percent and worst.rotation_deg <= config.exact_rotation_deg:
        return ""
    # Two cameras are at their places whatever their errors, but for a similarity
    travel = f" ({travel_percent:.2g} % of how far the camera moved)" if travel_percent >= _LEAST_TRAVEL_PERCENT else ""
    return (
        f"positions are known to {worst.centre_percent:.2g} % of the distance to the scene{travel}, directions to "
        f"{worst.rotation_deg:.2g} degrees"
    )


def _naming(verdict: Verdict, graph: ViewGraph, given: GivenWorld, placed: set[int]) -> Verdict:
    """Adds the poses that the images contradict, and what all given poses have wrong in common."""
    sentences, advice = [verdict.message], [verdict.advice]
    if given.offset is not None:
        off = f"{given.offset.degrees:.2g} degrees and {given.offset.metres:.2g} m"
        turn = _format_sigma(float(np.degrees(given.offset.turn_sigma)))
        known = f"{turn} degrees and {_format_sigma(given.offset.shift_sigma)} m"
        sentences.append(
            f"All given poses are off alike, by {off} in the camera's frame (known to {known}), which was taken out."
        )
        advice.append("Calibrate how the camera sits on what carries it (hand-eye).")
    if given.deviations:
        phrases = [_residual(graph, each, placed) for each in given.deviations[:_MOST_NAMED]]
        more = f", and {len(given.deviations) - _MOST_NAMED} more" if len(given.deviations) > _MOST_NAMED else ""
        poses = "the poses by depth images" if given.from_depth else "given poses"
        sentences.append(f"The photographs contradict {poses}: {'; '.join(phrases)}{more}.")
        at = "that each depth image goes with its photograph" if given.from_depth else _CHECK_POSES
        advice.append(f"Check {at}.")
    names = tuple(graph.names[each.index] for each in given.deviations)
    frames = (*verdict.frames, *(name for name in names if name not in verdict.frames))
    return replace(verdict, message=" ".join(sentences), advice=" ".join(filter(None, advice)), frames=frames)


_CHECK_POSES = "these poses, and whether their photographs were taken there"


def _format_sigma(sigma: float) -> str:
    return format_rounded_up(_TWO_SIDED_95 * sigma)


def _residual(graph: ViewGraph, deviation: Deviation, placed: set[int]) -> str:
    done = "placed by the photographs alone" if deviation.index in placed else "left out"
    name = sanitize_text(graph.names[deviation.index])
    return f"that of {name} is {deviation.metres:.2g} m and {deviation.degrees:.2g} degrees off ({done})"


# What a check of registered poses judges: decision.py asks them one after the other.


@dataclass(frozen=True, eq=False)
class EvidenceCase:
    """The evidence of registered poses, and the numbers to judge it by."""

    evidence: Evidence
    config: DecisionConfig
    numbers: VerdictModel

    @cached_property
    def bounds(self) -> Mapping[str, Bounds]:
        """Returns the bounds of each camera's errors, by its name."""
        return predict_bounds(self.evidence, self.numbers.claims)

    @property
    def widest_bounds(self) -> Bounds:
        """The widest bound of each kind. Raises ValueError where there is no camera."""
        found = find_widest(self.bounds.values())
        if found is None:
            raise ValueError("there must be a camera to be judged")
        return found

    @property
    def travel_percent(self) -> float:
        """The widest bound of a centre, of how far the camera moved."""
        return compute_travel_percent(self.bounds, self.evidence)

    @property
    def is_exact(self) -> bool:
        """Whether what is known is as good as a right answer; else it is rough."""
        worst, config = self.widest_bounds, self.config
        return (
            worst.rotation_deg <= config.exact_rotation_deg
            and worst.focal_percent <= config.exact_focal_percent
            and self.travel_percent <= config.exact_travel_percent
        )

    @property
    def is_usable(self) -> bool:
        """Whether the bounds are narrow enough for anything to be done with the cameras."""
        worst, config = self.widest_bounds, self.config
        return (
            worst.rotation_deg <= config.max_rotation_deg
            and worst.centre_percent <= config.max_centre_percent
            and self.travel_percent <= config.max_travel_percent
        )

    @property
    def names(self) -> list[str]:
        """Returns the names of the frames that were placed."""
        return [camera.name for camera in self.evidence.cameras]


@dataclass(frozen=True, eq=False)
class VerificationCase(EvidenceCase):
    """Registered poses, and where they come from."""

    graph: ViewGraph
    registration: Registration
