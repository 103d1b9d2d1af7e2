"""The verdict on a view graph and what was made of it, before anything is published.

`hopeless` needs no registration, `judge` weighs the evidence for one. Where the odds are against the poses, the reason
is looked for afterwards: what speaks most against them, and what about the frames explains that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from splatnode.capture import quality
from splatnode.recon.frames.keyframe import longer_side
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching.pair_matching import median_motion_px
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification import lens, refusals
from splatnode.recon.verification.acceptances import accepted
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.lens import FreedLens
from splatnode.recon.verification.likelihood import Odds, weigh
from splatnode.recon.verification.undetermined import undetermined

Pair = tuple[int, int]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_cameras: int = 3  # with fewer, an unknown focal length cannot be told from the motion
    min_features: int = 150  # frames with fewer show too little texture
    static_px: float = 1.0  # median motion of a pair's matches, at 1024 px, below which the camera stood still
    turned_share: float = 0.8  # of pairs that show no parallax, at which the camera has only turned
    planar_share: float = 0.9  # of a pair's matches on one plane; a facade with its relief reaches 0.84
    min_log_odds: float = 0.0  # of poses that are published: more likely right than not, after all bounds
    min_joint_points: int = 20  # that hold two parts together; mirror images share 3, the loosest right answer 62
    max_reflection: float = 0.4  # gain of a group of frames when mirrored; right answers reach 0.25, mirrored frames 1
    min_angle_deg: float = 1.5  # median of the points' widest viewing angles
    max_focal_sigma: float = 0.1  # of log focal; right up to 0.073, wrong from 0.13
    focal_gain: float = 0.8  # a given lens is doubted when setting it free lowers the cost to this share
    focal_change: float = 0.04  # and moves its focal length by more than this, if it was calibrated,
    nominal_change: float = 0.15  # a nominal one, when it ends as far off as this and the registration was held back
    held_back: float = 0.03  # from it by as much as this
    corner_shift: float = 0.03  # further distortion, of the corners' distance, that is doubted at the same gain
    voted_change: float = 0.15  # a given focal length that leads nowhere is doubted when pairs vote for one so far off
    blurred_px: float = 5.0  # width of edges, at 640 px, that explains why frames do not fit
    exposure_ratio: float = 1.6  # between the brightest and the darkest exposure, worth a note


def hopeless(graph: ViewGraph, rejected: Sequence[Rejected], config: Config) -> Verdict | None:
    """Why there can be no scene whatever the poses are, or None."""
    return _too_little(graph, rejected, config) or _no_motion(graph, config)


def judge(graph: ViewGraph, registration: Registration | None, evidence: Evidence | None, config: Config) -> Verdict:
    """OK, or another code that is publishable, or the reason why there is no scene.

    `evidence` is that of `recon.verification.verify` for this registration, which `hopeless` let pass.
    """
    if registration is None or evidence is None or len(registration.cameras) < config.min_cameras:
        return _not_placed(graph, registration, config)
    return (
        undetermined(registration, evidence)
        or _refused(graph, registration, evidence, weigh(evidence), config)
        or accepted(graph, registration, evidence, config.exposure_ratio)
    )


def _too_little(graph: ViewGraph, rejected: Sequence[Rejected], config: Config) -> Verdict | None:
    names = [keyframe.name for keyframe in graph.keyframes]
    if len(names) < config.min_cameras:
        return _too_few(names, rejected, config)
    if graph.pairs:
        return None
    plain = [keyframe.name for keyframe in graph.keyframes if len(keyframe.features.points) < config.min_features]
    if len(plain) > len(names) / 2:
        return refusals.without_texture(plain, len(names))
    return refusals.no_overlap(names, "No two frames show enough of the same things.")


def _too_few(names: list[str], rejected: Sequence[Rejected], config: Config) -> Verdict:
    """What most of the frames that were left out have in common is the reason, if they would have been enough."""
    by_code = {code: [frame for frame in rejected if frame.code == code] for code in Code}
    copies, blurred, blank = (by_code[code] for code in (Code.STATIC_CAMERA, Code.BLUR, Code.LOW_TEXTURE))
    if len(names) + len(rejected) >= config.min_cameras or (copies and len(names) == 1):
        if copies and len(names) == 1 and not blurred and not blank:
            return refusals.only_copies([*names, *(frame.name for frame in copies)])
        if len(blurred) > max(len(copies), len(blank)):
            return refusals.all_blurred([frame.name for frame in blurred], blurred[0].reason)
        if len(blank) > len(copies):
            return refusals.without_texture([frame.name for frame in blank], len(names) + len(rejected))
    return refusals.too_few(names, config.min_cameras, rejected)


def _no_motion(graph: ViewGraph, config: Config) -> Verdict | None:
    """The camera stood still, or only turned, or all that it saw is a plane."""
    still = [pair for pair, view in graph.pairs.items() if _motion_px(graph, pair, view) < config.static_px]
    if len(still) == len(graph.pairs):
        return refusals.only_copies(_names(graph, still))
    turned = _turned(graph)
    if len(turned) >= config.turned_share * len(graph.pairs):
        return refusals.no_parallax(_names(graph, turned), _without_parallax(graph, turned))
    flat = [
        pair for pair, view in graph.pairs.items() if view.num_homography >= config.planar_share * len(view.matches)
    ]
    return refusals.planar(_names(graph, flat)) if len(flat) == len(graph.pairs) else None


def _not_placed(graph: ViewGraph, registration: Registration | None, config: Config) -> Verdict:
    names = [keyframe.name for keyframe in graph.keyframes]
    doubted = _doubted_focal(graph, config)
    if doubted is not None:
        return doubted
    components = graph.components()
    if len(components[0]) < config.min_cameras:
        return refusals.no_overlap(names, f"Only {len(components[0])} of {len(names)} frames overlap.")
    turned = _turned(graph)
    if 2 * len(turned) >= len(graph.pairs):
        return refusals.no_parallax(_names(graph, turned), _without_parallax(graph, turned))
    found = 0 if registration is None else len(registration.cameras)
    return refusals.no_overlap(names, f"Only {found} of {len(names)} frames could be placed with certainty.")


def _doubted_focal(graph: ViewGraph, config: Config) -> Verdict | None:
    """A refusal if all frames were given one focal length, and their pairs vote for quite another."""
    given = {
        keyframe.frame.intrinsics.fx if keyframe.frame.intrinsics is not None else None for keyframe in graph.keyframes
    }
    told = given.pop() if len(given) == 1 else None
    voted = lens.voted_focal(graph.keyframes, list(graph.pairs.values()))
    if told is None or voted is None or abs(np.log(voted / told)) < config.voted_change:
        return None
    return refusals.wrong_given_focal([keyframe.name for keyframe in graph.keyframes], told, voted)


def _refused(
    graph: ViewGraph, registration: Registration, evidence: Evidence, odds: Odds, config: Config
) -> Verdict | None:
    names = [camera.name for camera in evidence.cameras]
    doubted = [freed for freed in evidence.freed if _contradicted(freed, config)]
    if doubted:
        return refusals.wrong_focal(names, doubted)
    distortion = evidence.distortion
    if not (distortion.cost_ratio >= config.focal_gain or distortion.corner_shift <= config.corner_shift):
        return refusals.distorted(names, distortion.corner_shift)
    if not evidence.joint.points >= config.min_joint_points:
        return refusals.apart([graph.keyframes[index].name for index in evidence.joint.group])
    if evidence.loose:
        return refusals.apart(evidence.loose)
    if not evidence.reflection.gain <= config.max_reflection:
        return refusals.reflected(evidence.reflection.frames)
    if not evidence.median_angle_deg >= config.min_angle_deg:
        return _too_close(graph, evidence)
    if not odds.total >= config.min_log_odds or odds.doubtful:
        return _reason(graph, registration, evidence, odds, config)
    if not evidence.focal_sigma <= config.max_focal_sigma:
        return refusals.uncertain_focal(names, evidence.focal_sigma)
    return None


def _contradicted(freed: FreedLens, config: Config) -> bool:
    off = abs(np.log(freed.found / freed.given))
    if freed.trusted:
        return not (off <= config.focal_change or freed.cost_ratio >= config.focal_gain)
    pulled = abs(np.log(freed.found / freed.registered))
    return not (off <= config.nominal_change or pulled <= config.held_back)


def _reason(graph: ViewGraph, registration: Registration, evidence: Evidence, odds: Odds, config: Config) -> Verdict:
    """Why the odds are against the poses: first what is wrong with the frames, then what is wrong with the poses."""
    names = [camera.name for camera in evidence.cameras]
    foreign = _through_other_lenses(graph, registration)
    if foreign:
        return refusals.mixed_cameras(foreign, len(names))
    widths = {
        keyframe.name: quality.blur_width(keyframe.image) or 0.0
        for keyframe in graph.keyframes
        if keyframe.name in names
    }
    if max(widths.values()) > config.blurred_px:
        return refusals.blurred([name for name in names if widths[name] > config.blurred_px], max(widths.values()))
    if odds.total >= config.min_log_odds:
        return refusals.unconfirmed(odds.doubtful)
    if odds.against == "plane":
        return refusals.moving(names, evidence.agreement)
    if odds.against == "mirror":
        return refusals.mirrored(names)
    if odds.against == "agreement":
        weakest = min(evidence.cameras, key=lambda camera: camera.agreement)
        return refusals.contradicting(odds.doubtful or (weakest.name,), evidence.agreement)
    return _too_close(graph, evidence)


def _too_close(graph: ViewGraph, evidence: Evidence) -> Verdict:
    """The positions are too uncertain: because the camera turned instead of moving, or moved too little."""
    names = [camera.name for camera in evidence.cameras]
    matches = sum(len(view.matches) for view in graph.pairs.values())
    turned = sum(view.num_rotation for view in graph.pairs.values()) / max(1, matches)
    if turned > 0.6:
        return refusals.no_parallax(names, f"a turn explains {100 * turned:.0f} % of all matches")
    if sum(view.num_homography for view in graph.pairs.values()) > 0.85 * matches:
        return refusals.planar(names)
    angle = evidence.median_angle_deg
    return refusals.too_close(
        names,
        f"The positions are uncertain by {100 * evidence.centre_rel:.1f} % of their distances, the directions by "
        f"{evidence.rotation_deg:.1f} degrees; points are seen under {angle:.1f} degrees.",
    )


def _through_other_lenses(graph: ViewGraph, registration: Registration) -> list[str]:
    """Frames that were not taken through the lens that took most; none where the camera was calibrated."""
    lenses = [camera.lens for camera in registration.cameras]
    common = max(sorted(set(lenses)), key=lenses.count)
    others = [graph.keyframes[camera.index] for camera in registration.cameras if camera.lens != common]
    return [keyframe.name for keyframe in others if keyframe.frame.intrinsics is None]


def _turned(graph: ViewGraph) -> list[Pair]:
    return [pair for pair, view in graph.pairs.items() if view.is_pure_rotation]


def _without_parallax(graph: ViewGraph, turned: list[Pair]) -> str:
    return f"{len(turned)} of {len(graph.pairs)} overlapping pairs show no parallax"


def _names(graph: ViewGraph, pairs: Iterable[Pair]) -> list[str]:
    return sorted({graph.keyframes[i].name for pair in pairs for i in pair})


def _motion_px(graph: ViewGraph, pair: Pair, view: TwoView) -> float:
    side1, side2 = (longer_side(graph.keyframes[index].frame) for index in pair)
    return median_motion_px(view, side1, side2)
