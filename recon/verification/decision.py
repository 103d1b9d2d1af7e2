"""The verdict on registered poses, before anything is published.

`refuse_before_registration` needs no registration; `decide` asks the checks one after the other, and the first that
refuses gives the reason. A further check is a file with a function of a `VerificationCase`, and its line in CHECKS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from splatnode.capture import keyframe_selection
from splatnode.recon import verification
from splatnode.recon.geometry import distortion
from splatnode.recon.keyframes import Rejected, longer_side
from splatnode.recon.matching.pair_matching import TwoView, median_motion_px
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.snapshot import format_rounded_up
from splatnode.recon.result.verdict import Bounds, Code, Verdict
from splatnode.recon.verification import DecisionConfig, Refusal, refit, refuse
from splatnode.recon.verification.error_model import (
    EvidenceCase,
    VerdictModels,
    VerificationCase,
    compute_log_odds,
    measure_flat_patch,
)
from splatnode.recon.verification.evidence import MAX_PIECES, CameraEvidence, Evidence, find_non_finite
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.input_kinds import refuse_stereo_or_panorama
from splatnode.recon.verification.refit import FreedLens

Pair = tuple[int, int]

# What frames and their pairs say by themselves: why there can be no poses, or why none were found.


def refuse_before_registration(
    graph: ViewGraph, rejected: Sequence[Rejected], config: DecisionConfig
) -> Verdict | None:
    """Why there can be no scene whatever the poses are, or None. `rejected` are the frames that screening left out."""
    kind = refuse_stereo_or_panorama(graph.keyframes)
    return kind or _refuse_insufficient_images(graph, rejected, config) or _refuse_no_motion(graph, config)


def refuse_unplaced(graph: ViewGraph, registration: Registration | None, config: DecisionConfig) -> Verdict:
    """Why registration placed too few cameras to verify them."""
    names = [keyframe.name for keyframe in graph.keyframes]
    doubted = _refuse_doubtful_focal(graph, config)
    if doubted is not None:
        return doubted
    components = graph.components()
    if len(components[0]) < config.min_cameras:
        found = f"Only {len(components[0])} of {len(names)} photographs overlap."
        return refuse(verification.NO_OVERLAP, names, found=found)
    turned = _find_pure_rotations(graph)
    if 2 * len(turned) >= len(graph.pairs):
        return _refuse_pure_rotation(graph, turned)
    placed = 0 if registration is None else len(registration.cameras)
    found = f"Only {placed} of {len(names)} photographs could be placed with certainty."
    return refuse(verification.NO_OVERLAP, names, found=found)


def _refuse_insufficient_images(
    graph: ViewGraph, rejected: Sequence[Rejected], config: DecisionConfig
) -> Verdict | None:
    names = [keyframe.name for keyframe in graph.keyframes]
    if len(names) < config.min_cameras:
        return _refuse_too_few_views(names, rejected, config)
    if graph.pairs:
        return None
    plain = [keyframe.name for keyframe in graph.keyframes if len(keyframe.features.points) < config.min_features]
    if len(plain) > len(names) / 2:
        return refuse(verification.WITHOUT_TEXTURE, plain, plain=len(plain), count=len(names))
    return refuse(verification.NO_OVERLAP, names, found="No two photographs show enough of the same things.")


def _refuse_too_few_views(names: list[str], rejected: Sequence[Rejected], config: DecisionConfig) -> Verdict:
    """Refuses with what most rejected frames have in common, if they would have been enough."""
    by_code = {code: [frame for frame in rejected if frame.code == code] for code in Code}
    copies, blurred, blank = (by_code[code] for code in (Code.STATIC_CAMERA, Code.BLUR, Code.LOW_TEXTURE))
    if len(names) + len(rejected) >= config.min_cameras or (copies and len(names) == 1):
        if copies and len(names) == 1 and not blurred and not blank:
            return refuse(verification.ONLY_COPIES, [*names, *(frame.name for frame in copies)])
        if len(blurred) > max(len(copies), len(blank)):
            of_blurred = [frame.name for frame in blurred]
            reason = blurred[0].reason
            return refuse(verification.ALL_BLURRED, of_blurred, count=len(blurred), first=of_blurred[0], reason=reason)
        if len(blank) > len(copies):
            of_blank = [frame.name for frame in blank]
            return refuse(verification.WITHOUT_TEXTURE, of_blank, plain=len(blank), count=len(names) + len(rejected))
    usable = f"{len(names)} usable photograph{'s' if len(names) != 1 else ''}"
    left_out = f"; {len(rejected)} more were left out ({rejected[0].name}: {rejected[0].reason})" if rejected else ""
    return refuse(verification.TOO_FEW, names, usable=usable, least=config.min_cameras, left_out=left_out)


def _refuse_no_motion(graph: ViewGraph, config: DecisionConfig) -> Verdict | None:
    """The camera stood still, or only turned."""
    still = [pair for pair, view in graph.pairs.items() if _motion_px(graph, pair, view) < config.static_px]
    if len(still) == len(graph.pairs):
        return refuse(verification.ONLY_COPIES, _names(graph, still))
    turned = _find_pure_rotations(graph)
    return _refuse_pure_rotation(graph, turned) if len(turned) >= config.turned_share * len(graph.pairs) else None


def _refuse_doubtful_focal(graph: ViewGraph, config: DecisionConfig) -> Verdict | None:
    """A refusal if all frames were given one focal length, and their pairs vote for quite another."""
    given = {
        keyframe.frame.intrinsics.fx if keyframe.frame.intrinsics is not None else None for keyframe in graph.keyframes
    }
    given_focal = given.pop() if len(given) == 1 else None
    voted = refit.vote_focal(graph.keyframes, list(graph.pairs.values()))
    if given_focal is None or voted is None or abs(np.log(voted / given_focal)) < config.voted_change:
        return None
    names = [keyframe.name for keyframe in graph.keyframes]
    change = 100 * (voted / given_focal - 1.0)
    if _select_exif_keyframes(graph):
        return refuse(verification.WRONG_EXIF, names, given=given_focal, found=voted, change=change)
    return refuse(verification.WRONG_FOCAL_BY_VOTE, names, given=given_focal, voted=voted, change=change)


# EXIF that the images contradict: it stays as it was when an image is cropped or zoomed afterwards.

EXIF_LEFT_OUT = "They contradict the focal length that EXIF tells, as cropped ones do: it was not used."
_EXCLUDED_AT = 2.5  # times the 95 % bound of a focal length: beyond it the measured answers were never wrong
_ALIKE = 0.02  # largest difference of log focals over EXIF's, with which all images refute EXIF alike


def contradicts_exif(
    graph: ViewGraph,
    registration: Registration | None,
    evidence: Evidence | None,
    verdict: Verdict,
    config: DecisionConfig,
) -> bool:
    """Whether images are refused for the focal length that their EXIF tells, or most of them refute it alike."""
    if not _select_exif_keyframes(graph):
        return False
    changes = [] if registration is None else _measure_exif_changes(graph, registration.cameras)
    own = [change for camera, change in changes if camera.own_lens]
    if 2 * len(own) > len(changes) and np.ptp(own) <= _ALIKE:
        return True
    if verdict.code is not Code.FOCAL_SUSPECT:
        return False
    return evidence is None or any(not each.trusted and _is_contradicted(each, config) for each in evidence.freed)


def excludes_exif(graph: ViewGraph, registration: Registration, bounds: Mapping[str, Bounds]) -> bool:
    """Whether a focal length that EXIF tells is far beyond the bounds of one that was estimated without EXIF."""
    for camera, change in _measure_exif_changes(graph, registration.cameras):
        bound = bounds.get(graph.names[camera.index])
        if bound is not None and abs(change) > _EXCLUDED_AT * np.log1p(bound.focal_percent / 100.0):
            return True
    return False


def _measure_exif_changes(
    graph: ViewGraph, cameras: Sequence[RegisteredCamera]
) -> list[tuple[RegisteredCamera, float]]:
    """The cameras of whose lens EXIF tells, with the logarithm of their focal length over EXIF's."""
    found = []
    for camera in cameras:
        lens = graph.keyframes[camera.index].frame.intrinsics
        if lens is not None and lens.source == "exif":
            found.append((camera, float(np.log(camera.focal / lens.fx))))
    return found


def forget_exif(graph: ViewGraph) -> ViewGraph:
    """The graph without the focal lengths that EXIF tells."""
    return graph.forget_lenses(_select_exif_keyframes(graph))


def _select_exif_keyframes(graph: ViewGraph) -> set[str]:
    """The names of the keyframes of whose lens EXIF alone tells."""
    lenses = {keyframe.name: keyframe.frame.intrinsics for keyframe in graph.keyframes}
    return {name for name, lens in lenses.items() if lens is not None and lens.source == "exif"}


def _find_pure_rotations(graph: ViewGraph) -> list[Pair]:
    return [pair for pair, view in graph.pairs.items() if view.is_pure_rotation]


def _refuse_pure_rotation(graph: ViewGraph, turned: list[Pair]) -> Verdict:
    found = f"{len(turned)} of {len(graph.pairs)} overlapping pairs show no parallax"
    return refuse(verification.NO_PARALLAX, _names(graph, turned), found=found)


def _names(graph: ViewGraph, pairs: Iterable[Pair]) -> list[str]:
    return sorted({graph.keyframes[i].name for pair in pairs for i in pair})


def _motion_px(graph: ViewGraph, pair: Pair, view: TwoView) -> float:
    side1, side2 = (longer_side(graph.keyframes[index].frame) for index in pair)
    return median_motion_px(view, side1, side2)


# Checks of registered poses, each of one piece of evidence: a refusal, or None where nothing speaks against them.
#
# A limit is asked so that NaN refuses: "not (value <= limit)", never "value > limit".


def check_given_lens(case: EvidenceCase) -> Verdict | None:
    """Most images refute the lens that was given for them: it is wrong, not they."""
    changes = [camera.refuted_focal for camera in case.evidence.cameras if camera.refuted_focal > 0]
    refuted = [change for change in changes if change != 1.0]
    if 2 * len(refuted) <= len(changes):
        return None
    change = 100 * (float(np.median(refuted)) - 1.0)
    return refuse(verification.WRONG_LENS, case.names, refuted=len(refuted), count=len(changes), change=change)


def check_given_focal(case: EvidenceCase) -> Verdict | None:
    """The photographs contradict a focal length that came with them."""
    doubted = [freed for freed in case.evidence.freed if _is_contradicted(freed, case.config)]
    if not doubted:
        return None
    worst = max(doubted, key=lambda lens: abs(lens.found / lens.given - 1.0))
    change = 100 * (worst.found / worst.given - 1.0)
    if worst.trusted:
        return refuse(verification.WRONG_FOCAL, case.names, given=worst.given, found=worst.found, change=change)
    return refuse(verification.WRONG_EXIF, case.names, given=worst.given, found=worst.found, change=change)


def _is_contradicted(freed: FreedLens, config: DecisionConfig) -> bool:
    change = abs(np.log(freed.found / freed.given))
    if freed.trusted:
        return not (change <= config.focal_change or freed.cost_ratio >= config.focal_gain)
    held_back = abs(np.log(freed.found / freed.registered))
    return not (change <= config.nominal_change or held_back <= config.held_back)


def check_distortion(case: EvidenceCase) -> Verdict | None:
    """The lens distorts the picture by more than registration found."""
    found, config = case.evidence.distortion, case.config
    much = found.cost_ratio < config.focal_gain and found.corner_shift > config.corner_shift
    surely = found.cost_ratio < config.sure_gain and found.corner_shift > config.sure_corner_shift
    if not (much or surely):
        return None
    return refuse(verification.DISTORTED, case.names, further=100 * found.corner_shift)


def check_lenses(case: EvidenceCase) -> Verdict | None:
    """Lenses of which nothing was told do not fit: with others the cameras explain the matches far better."""
    if case.evidence.freed or case.evidence.own_lens_cost >= case.config.least_own_lens_cost:
        return None
    return refuse(verification.UNFIT_LENSES, case.names, percent=100 * (1.0 - case.evidence.own_lens_cost))


def check_pair_of_lenses(case: EvidenceCase) -> Verdict | None:
    """Two images through two unknown lenses: a focal length each and the pose fit any matches that have an epipole."""
    if len(case.evidence.cameras) > 2 or case.evidence.unknown_lenses < 2:
        return None
    return refuse(verification.PAIR_OF_LENSES, case.names)


def check_moving_plane(case: EvidenceCase) -> Verdict | None:
    """All that fits is one plane, and much does not fit with it: a flat thing that moves before what stands still."""
    evidence, config = case.evidence, case.config
    explained = evidence.inlier_ratio > config.moving_inlier_ratio
    if evidence.flatness < config.moving_flatness or (explained and np.isfinite(evidence.flatness)):
        return None
    return refuse(verification.MOVING, case.names, inliers=100 * evidence.inlier_ratio)


def check_montage(case: EvidenceCase) -> Verdict | None:
    """Rejects cameras of which any two have common points that moved in a few pieces, as wholes."""
    share = case.evidence.shifted_share
    if share <= case.config.max_shifted_share:
        return None
    return refuse(verification.MONTAGE, case.names, percent=100 * share, pieces=MAX_PIECES)


def check_weakest_link(case: EvidenceCase) -> Verdict | None:
    """Two groups of frames share almost no points."""
    link = case.evidence.weakest_link
    if link.shared_points >= case.config.min_link_points:
        return None
    return _refuse_split(link.smaller_part)


def check_connectivity(case: EvidenceCase) -> Verdict | None:
    """Only contradicted matches join some frames to most of the others."""
    return _refuse_split(case.evidence.disconnected) if case.evidence.disconnected else None


def _refuse_split(frames: Sequence[str]) -> Verdict:
    return refuse(verification.APART, frames, count=len(frames))


def check_confirmed_points(case: EvidenceCase) -> Verdict | None:
    """A camera hangs on the others by points of one pair, which tell its direction and not how far it is away."""
    cameras = case.evidence.cameras
    weakest = min(cameras, key=lambda camera: camera.confirmed)
    if len(cameras) == 2 or weakest.confirmed >= case.config.min_confirmed:
        return None
    return refuse(verification.UNCONFIRMED, (weakest.name,), name=weakest.name, points=weakest.confirmed)


def check_flat_patch(case: EvidenceCase) -> Verdict | None:
    """Rejects a camera that shares but one flat thing with the others, which fills little of its picture."""
    patch = max(case.evidence.cameras, key=measure_flat_patch)
    return _refuse_flat_patch(patch) if measure_flat_patch(patch) > case.config.max_flat_patch else None


def _refuse_flat_patch(camera: CameraEvidence) -> Verdict:
    return refuse(verification.FLAT_PATCH, (camera.name,), name=camera.name, percent=100 * camera.coverage)


def check_small_parts(case: EvidenceCase) -> Verdict | None:
    """Rejects a camera whose matches fill little of its picture, and contradict it in good part."""
    config = case.config
    small = [camera for camera in case.evidence.cameras if not camera.coverage >= config.small_part]
    doubted = [camera for camera in small if not camera.inlier_ratio >= config.min_small_part_ratio]
    if not doubted or len(case.evidence.cameras) == 2:
        return None
    return _refuse_small_part(min(doubted, key=lambda camera: camera.inlier_ratio))


def _refuse_small_part(camera: CameraEvidence) -> Verdict:
    return refuse(verification.SMALL_PART, (camera.name,), name=camera.name, percent=100 * camera.coverage)


def check_own_lenses(case: EvidenceCase) -> Verdict | None:
    """A camera got a lens of its own, and its matches contradict it all the same, or it is that of a part."""
    inset = next((camera for camera in case.evidence.cameras if camera.inset), None)
    if inset is not None:
        return refuse(verification.INSET, (inset.name,), name=inset.name, percent=100 * inset.coverage)
    own = [camera for camera in case.evidence.cameras if camera.own_lens]
    weakest = min(own, key=lambda camera: camera.inlier_ratio, default=None)
    if weakest is None or weakest.inlier_ratio >= case.config.min_own_lens_ratio:
        return None
    inliers = 100 * weakest.inlier_ratio
    return refuse(verification.UNFIT_LENS, (weakest.name,), name=weakest.name, inliers=inliers)


def check_mirrored_images(case: EvidenceCase) -> Verdict | None:
    """Some photographs match the others better when they are turned left to right."""
    found = case.evidence.reflection
    if found.gain <= case.config.max_reflection:
        return None
    return refuse(verification.MIRRORED_PHOTOGRAPHS, found.frames, count=len(found.frames))


def check_mirrored_scene(case: EvidenceCase) -> Verdict | None:
    """The scene mirrored in depth fits nearly as well."""
    if case.evidence.mirrored_cost >= case.config.min_mirrored_cost:
        return None
    return refuse(verification.MIRRORED_IN_DEPTH, case.names)


def check_required_precision(case: EvidenceCase) -> Verdict | None:
    """The centres are known less well than the user requires."""
    needed = case.config.max_position_error_percent
    if needed is None or case.widest_bounds.centre_percent <= needed:
        return None
    return refuse(verification.ROUGHER, case.names, found=case.widest_bounds.centre_percent, needed=needed)


# Why bounds are wide: which of parallax, depth, focal length and shared points was missing, and between which frames.
#
# The causes are asked one after the other, those first that bring the others about: a camera that only turned leaves
# the focal length open, too. Each looks at its own evidence, so that no remedy is advised for something that is fine.

FEW_CONFIRMED = 30  # points of a camera that two others see; with fewer a pose hangs on single ones
SMALL_ANGLE_DEG = 5.0  # of the points' viewing angles, in the median, below which more parallax helps


def check_bounds(case: VerificationCase) -> Verdict | None:
    """The bounds of the cameras are so wide that nothing is known that could be used."""
    return None if case.is_usable else explain_wide_bounds(case)


def explain_wide_bounds(case: VerificationCase) -> Verdict:
    """The refusal that names the cause."""
    return (
        _check_pure_rotation(case)
        or _check_planarity(case)
        or _check_focal(case)
        or _check_shared_points(case)
        or _check_viewing_angle(case)
        or _refuse_scattered(case)
    )


def _check_pure_rotation(case: VerificationCase) -> Verdict | None:
    pairs = case.graph.pairs.values()
    matches = sum(len(view.matches) for view in pairs)
    share = sum(view.num_rotation for view in pairs) / max(1, matches)
    if share <= case.config.explained_by_turning:
        return None
    return refuse(verification.NO_PARALLAX, case.names, found=f"a turn explains {100 * share:.0f} % of all matches")


def _check_planarity(case: VerificationCase) -> Verdict | None:
    """Views of one plane fix neither the focal length nor which way it leans."""
    pairs = case.graph.pairs.values()
    on_plane = sum(view.num_homography for view in pairs)
    if on_plane <= case.config.explained_by_plane * sum(len(view.matches) for view in pairs):
        return None
    return (
        None
        if case.widest_bounds.focal_percent <= case.config.exact_focal_percent
        else refuse(verification.PLANAR, case.names)
    )


UNKNOWN_PERCENT = 100.0  # bound of a focal length from which on it is not known


def _check_focal(case: VerificationCase) -> Verdict | None:
    worst = case.widest_bounds
    if worst.focal_percent <= case.config.exact_focal_percent:
        return None
    centre, rotation = worst.centre_percent, worst.rotation_deg
    if worst.focal_percent >= UNKNOWN_PERCENT:
        return refuse(verification.UNKNOWN_FOCAL, case.names, centre=centre, rotation=rotation)
    return refuse(verification.UNCERTAIN_FOCAL, case.names, focal=worst.focal_percent, centre=centre, rotation=rotation)


def _check_shared_points(case: VerificationCase) -> Verdict | None:
    """Refuses the camera with the widest bound among those that share few points."""
    weak = [camera for camera in case.evidence.cameras if camera.confirmed < FEW_CONFIRMED]
    if not weak or len(case.evidence.cameras) == 2:  # nobody else sees the points of two
        return None
    weakest = max(weak, key=lambda camera: case.bounds[camera.name].centre_percent)
    partners = case.graph.partners(case.graph.names.index(weakest.name))
    nearest = case.graph.names[max(partners, key=lambda index: (partners[index], -index))]
    return refuse(
        verification.FEW_SHARED_POINTS,
        (weakest.name, nearest),
        name=weakest.name,
        points=weakest.confirmed,
        partner=nearest,
        centre=case.bounds[weakest.name].centre_percent,
        rotation=case.bounds[weakest.name].rotation_deg,
    )


def _check_viewing_angle(case: VerificationCase) -> Verdict | None:
    angle = case.evidence.median_angle_deg
    if angle >= SMALL_ANGLE_DEG:
        return None
    rotation = case.widest_bounds.rotation_deg
    return refuse(verification.TOO_CLOSE, case.names, angle=angle, travel=case.travel_percent, rotation=rotation)


def _refuse_scattered(case: VerificationCase) -> Verdict:
    """None of these: the parts of the photographs disagree, most about one camera."""
    config = case.config

    def width(name: str) -> float:
        found = case.bounds[name]
        return max(found.rotation_deg / config.max_rotation_deg, found.centre_percent / config.max_centre_percent)

    worst = max(case.bounds, key=width)
    bounds = case.bounds[worst]
    return refuse(
        verification.SCATTERED, (worst,), name=worst, centre=bounds.centre_percent, rotation=bounds.rotation_deg
    )


# The verdicts with which a scene is published, in words: which frames it has, and what is to be said of them.


def accept(case: VerificationCase) -> Verdict:
    """OK where all photographs were placed, exactly; else what the others show, or how roughly they are placed."""
    left_out = _find_unplaced_frames(case)
    rough = _describe_roughness(case)
    if rough:
        missing = f" No place was found for {', '.join(left_out)}." if left_out else ""
        message = f"{_summarize_placement(case)}, roughly: {rough}.{missing}"
        found = Verdict(Code.OK_ROUGH, message, _advise_remedy(case), left_out, publishable=True)
    else:
        found = _accept_partial(case, left_out) if left_out else _accept_all(case)
    lenses = _describe_own_lenses(case)
    return replace(found, message=f"{found.message} {lenses}") if lenses else found


_SAME_FOCAL = 0.01  # of a focal length: an own lens that differs by less is displaced, not longer


def _describe_own_lenses(case: VerificationCase) -> str:
    """A sentence about images whose lens is not the one that they were taken to share, or that was given."""
    own = [camera for camera in case.registration.cameras if camera.own_lens]
    if not own:
        return ""
    others = [camera.focal for camera in case.registration.cameras if not camera.own_lens]
    beside = f"; the others have {np.median(others):.0f}" if others else ""
    least, most = min(camera.focal for camera in own), max(camera.focal for camera in own)
    if len(own) > 1:
        focals = f"{least:.0f} to {most:.0f} pixels{beside}"
        return f"{len(own)} images have lenses of their own, with focal lengths of {focals}."
    frame = case.graph.keyframes[own[0].index].frame
    if others and abs(most / np.median(others) - 1.0) < _SAME_FOCAL:
        across, down = own[0].principal - np.array([frame.width, frame.height]) / 2.0
        where = f"{across:+.0f} pixels across and {down:+.0f} down from the middle"
        return f"{frame.name} has a lens of its own: its principal point is {where}."
    return f"{frame.name} has a lens of its own, with a focal length of {most:.0f} pixels{beside}."


def _find_unplaced_frames(case: VerificationCase) -> tuple[str, ...]:
    placed = {camera.index for camera in case.registration.cameras}
    return tuple(name for index, name in enumerate(case.graph.names) if index not in placed)


def _summarize_placement(case: VerificationCase) -> str:
    placed, count = len(case.registration.cameras), len(case.graph.keyframes)
    return f"{'All' if placed == count else f'{placed} of'} {count} photographs were placed"


def _describe_roughness(case: VerificationCase) -> str:
    """Describes what is known less well than in an exact scene; empty where nothing is."""
    if case.is_exact:
        return ""
    worst = case.widest_bounds
    centre, travel, rotation, focal = map(
        format_rounded_up, (worst.centre_percent, case.travel_percent, worst.rotation_deg, worst.focal_percent)
    )
    return (
        f"positions are known to {centre} % of the distance to the scene ({travel} % of how far the camera moved), "
        f"directions to {rotation} degrees, the focal length to {focal} %"
    )


def _advise_remedy(case: VerificationCase) -> str:
    """Returns the remedy for the cause that made the scene rough."""
    return explain_wide_bounds(case).advice


def _accept_partial(case: VerificationCase, left_out: tuple[str, ...]) -> Verdict:
    graph, summary = case.graph, _summarize_placement(case)
    names, placed = graph.names, {camera.index for camera in case.registration.cameras}
    apart = [part for part in graph.components() if not placed & set(part)]
    if any(len(part) > 1 for part in apart):
        return Verdict(
            Code.SPLIT,
            f"{summary}; others show a place of their own: {'; '.join(', '.join(names[i] for i in p) for p in apart)}.",
            "Add photographs that connect the places, or take them one after the other.",
            left_out,
            publishable=True,
        )
    if len(apart) == len(left_out) == 1 and len(placed) > 3:
        return Verdict(
            Code.OUTLIER_VIEW,
            f"{summary}; {left_out[0]} shows nothing of what the others show.",
            "Leave it out, or add a photograph between it and the others.",
            left_out,
            publishable=True,
        )
    return Verdict(
        Code.OK_PARTIAL,
        f"{summary}; {len(left_out)} share too little with them.",
        f"Add a photograph between the others and {left_out[0]}.",
        left_out,
        publishable=True,
    )


def _accept_all(case: VerificationCase) -> Verdict:
    exposure_ratio, cameras = case.config.exposure_ratio, case.evidence.cameras
    gains = {camera.name: camera.gain for camera in cameras}  # finite, for `check_finite` let them pass
    ratio = max(gains.values()) / min(gains.values())
    if ratio <= exposure_ratio:
        return Verdict(Code.OK, f"{_summarize_placement(case)}.", "", (), publishable=True)
    limit = exposure_ratio**0.5
    return Verdict(
        Code.EXPOSURE_SHIFT,
        f"{_summarize_placement(case)}; the brightest is exposed {ratio:.1f} times as much as the darkest.",
        "Lock exposure and white balance.",
        tuple(name for name, gain in gains.items() if not 1 / limit < gain < limit),
        publishable=True,
    )


def make_overfit_verdict(names: Sequence[str], iterations: int, kept: int, before: float, after: float) -> Verdict:
    """OVERFIT: the scene after `kept` iterations is published in place of the one after `iterations`.

    `before` and `after` are their misfits between the photographs.
    """
    return Verdict(
        Code.OVERFIT,
        f"The refinement overfitted the photographs: between them the scene misses what stereo shows by {after:.2g} "
        f"after {iterations} iterations, and by {before:.2g} after {kept}, which is the scene that is given.",
        "Take smaller steps (optimize.lr) or fewer (optimize.iterations), or a preset as it is.",
        tuple(names),
        publishable=True,
    )


# The check of all evidence together: are the poses more likely right than wrong? If not, why?


def check_odds(case: VerificationCase) -> Verdict | None:
    """The evidence speaks against the poses."""
    found = compute_log_odds(case.evidence, case.numbers.claims, case.numbers.odds)
    if found.total >= case.config.min_log_odds:
        return None
    return _refuse_wrong_frames(case) or _refuse_wrong_poses(case, found.strongest_rejection)


def _refuse_wrong_frames(case: VerificationCase) -> Verdict | None:
    """Refuses the images that explain why their poses are unlikely; None where none do."""
    names, limit = case.names, case.config.blurred_px
    foreign = _find_other_lens_frames(case)
    if foreign:
        return refuse(verification.MIXED_CAMERAS, foreign, others=len(foreign), count=len(names))
    widths = {
        keyframe.name: keyframe_selection.blur_width(keyframe.image) or 0.0
        for keyframe in case.graph.keyframes
        if keyframe.name in names
    }
    widest = max(widths.values())
    if widest > limit:
        return refuse(verification.BLURRED, [name for name in names if widths[name] > limit], width_px=widest)
    return None


def _refuse_wrong_poses(case: VerificationCase, against: str) -> Verdict:
    """Refuses for the reason that speaks most against the poses."""
    cameras = case.evidence.cameras
    if against == "reflection":
        mirrored = case.evidence.reflection.frames
        return refuse(verification.MIRRORED_PHOTOGRAPHS, mirrored, count=len(mirrored))
    if against == "flat_patch":
        return _refuse_flat_patch(max(cameras, key=measure_flat_patch))
    if against == "coverage":
        return _refuse_small_part(min(cameras, key=lambda camera: camera.coverage))
    if against in ("rotation_bound", "travel_bound"):
        return explain_wide_bounds(case)
    return _refuse_contradictions(case, against)


def _refuse_contradictions(case: VerificationCase, against: str) -> Verdict:
    """Photographs, pairs of them, or two parts do not fit together. It is about the photograph that fits least."""
    weakest = min(case.evidence.cameras, key=lambda camera: camera.inlier_ratio)
    if against == "directions":
        return refuse(verification.DISAGREEING, (weakest.name,), degrees=case.evidence.cycles.direction_deg)
    if against == "link_inlier_ratio":
        link, inliers = case.evidence.weakest_link, 100 * case.evidence.weakest_link.inlier_ratio
        count, points = len(link.smaller_part), link.shared_points
        return refuse(verification.WEAKLY_JOINED, (weakest.name,), count=count, points=points, inliers=inliers)
    if against == "camera_inlier_ratio":
        return refuse(verification.CONTRADICTED, (weakest.name,), name=weakest.name, inliers=100 * weakest.inlier_ratio)
    if against == "own_lens":
        own = [camera.name for camera in case.evidence.cameras if camera.own_lens]
        few = 2 * len(own) < len(case.names)  # then the others are judged without them
        return refuse(verification.NO_COMMON_LENS, own if few else (weakest.name,), own=len(own), count=len(case.names))
    return refuse(verification.CONTRADICTING, (weakest.name,), inliers=100 * case.evidence.inlier_ratio)


def _find_other_lens_frames(case: VerificationCase) -> list[str]:
    """Frames whose size says that another lens took them than most; none where the camera was calibrated.

    A camera with an id has its own lens anyhow, of which all of its images tell.
    """
    keyframes = [case.graph.keyframes[camera.index] for camera in case.registration.cameras]
    sizes = [tuple(sorted((keyframe.frame.width, keyframe.frame.height))) for keyframe in keyframes]
    common = max(sorted(set(sizes)), key=sizes.count)
    others = [keyframe for keyframe, size in zip(keyframes, sizes, strict=True) if size != common]
    unknown = [keyframe for keyframe in others if keyframe.frame.intrinsics is None]
    return [keyframe.name for keyframe in unknown if not keyframe.frame.camera_id]


# The check of lenses that bend lines by more than two radial coefficients can tell, as a fisheye's do.
#
# Beyond, the coefficients fit the middle of the picture and not its corners, and may fold the picture over.

STRONG = 0.25  # by which a corner moves at most, of its distance from the middle: of 25 % it is 9 pixels of 1024 off
_RADII = 100  # at which the lens is looked at

BENDS_STRONGLY = Refusal(
    Code.FOCAL_SUSPECT,
    "The lens bends lines strongly: it moves the corners of the picture by more than {moved:.0f} % of their distance "
    "from the middle, and what it does there cannot be told from the photographs.",
    "Calibrate the camera (splatnode calibrate) and give its lens by --intrinsics.",
)


def check_strong_distortion(case: VerificationCase) -> Verdict | None:
    """An estimated lens moves the corners of its pictures too far, or folds them over."""
    for camera in case.registration.cameras:
        frame = case.graph.keyframes[camera.index].frame
        if not _is_well_modelled(camera, frame.width, frame.height):
            return refuse(BENDS_STRONGLY, case.names, moved=100 * STRONG)
    return None


def _is_well_modelled(camera: RegisteredCamera, width: int, height: int) -> bool:
    """Whether the lens shows each pixel as far as its farthest corner one ray, and that corner's within STRONG."""
    if not camera.radial.any():
        return True
    across, down = camera.principal
    corner = float(np.hypot(max(across, width - across), max(down, height - down)) / camera.focal)
    radii = np.linspace(0.0, 1.0 + STRONG, _RADII) * corner
    seen = radii * distortion(radii**2, camera.radial)
    nearer = (1.0 - STRONG) * corner
    least = nearer * float(distortion(np.square(nearer), camera.radial))
    return bool((np.diff(seen) > 0).all() and least <= corner <= seen[-1])


# The check that comes before all others: was everything computed that the verdict rests on?
#
# A comparison with NaN is false whatever it asks, and infinity lies beyond every limit on one side. Therefore no limit
# is asked about such a number: poses of which something could not be computed are not published.

UNDETERMINED = Refusal(
    Code.UNDETERMINED,
    "The poses cannot be verified: these could not be computed: {missing}.",
    "Leave out the photographs named, or add photographs from further to the side between them and the others.",
)

WORDS = {  # what each field of the evidence says, for the user
    "cameras": "how certain each pose is",
    "inlier_ratio": "how many matches the poses explain",
    "weakest_link": "what connects the photographs",
    "disconnected": "which photographs belong together",
    "reflection": "whether photographs are mirrored",
    "flatness": "whether everything lies in one plane",
    "mirrored_cost": "how much worse the scene mirrored in depth fits",
    "cycles": "whether pairs of photographs agree with each other",
    "median_angle_deg": "the angle under which points are seen",
    "rms_px": "the reprojection error",
    "focal": "how certain the focal length is",
    "travel": "how far the camera moved",
    "freed": "whether the given focal length is right",
    "distortion": "whether the lens bends the picture",
    "unknown_lenses": "how many lenses are unknown",
    "own_lens_cost": "whether the lenses that were found fit",
    "shifted_share": "whether pieces of the pictures only shifted",
}


def check_finite(case: VerificationCase) -> Verdict | None:
    """A number of the registration or of its evidence is NaN or infinite."""
    paths = list(find_non_finite(case.evidence))
    of_cameras = [case.names[int(path[1])] for path in paths if path[0] == "cameras"]
    found = [WORDS[path[0]] for path in paths]
    if any(find_non_finite(case.registration)):
        found.append("the poses themselves")
    if not found:
        return None
    frames = tuple(dict.fromkeys(of_cameras)) or case.names
    return refuse(UNDETERMINED, frames, missing="; ".join(dict.fromkeys(found)))


__all__ = ["DecisionConfig", "decide", "refuse_before_registration"]

LIMITS = (  # each asks one piece of the evidence, and decides by itself
    check_given_lens,
    check_given_focal,
    check_distortion,
    check_lenses,
    check_pair_of_lenses,
    check_moving_plane,
    check_montage,
    check_weakest_link,
    check_connectivity,
    check_confirmed_points,
    check_flat_patch,
    check_small_parts,
    check_own_lenses,
    check_mirrored_images,
    check_mirrored_scene,
)
CHECKS = (  # what is surer about the reason comes first; those after the first may take all numbers for finite
    check_finite,
    *LIMITS,
    check_strong_distortion,
    check_odds,
    check_bounds,
    check_required_precision,
)


def decide(
    graph: ViewGraph,
    registration: Registration | None,
    evidence: Evidence | None,
    config: DecisionConfig,
    fitted: VerdictModels = FITTED,
) -> Verdict:
    """OK, or another code that is publishable, or the reason why there is no scene.

    `evidence` is that of `evidence.verify` for this registration, which `refuse_before_registration` let pass.
    """
    if registration is None or evidence is None or len(registration.cameras) < config.min_cameras:
        return refuse_unplaced(graph, registration, config)
    case = VerificationCase(evidence, config, fitted.select_model(evidence), graph, registration)
    for check in CHECKS:
        refusal = check(case)
        if refusal is not None:
            return refusal
    return accept(case)
