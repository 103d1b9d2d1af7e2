"""The check of all evidence together: are the poses more likely right than wrong? If not, why?"""

from __future__ import annotations

from splatnode.capture import quality
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.causes import explain_wide_bounds
from splatnode.recon.verification.checks import VerificationCase
from splatnode.recon.verification.likelihood import compute_log_odds
from splatnode.recon.verification.refusals import refuse


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
        return refuse(refusals.MIXED_CAMERAS, foreign, others=len(foreign), count=len(names))
    widths = {
        keyframe.name: quality.blur_width(keyframe.image) or 0.0
        for keyframe in case.graph.keyframes
        if keyframe.name in names
    }
    widest = max(widths.values())
    if widest > limit:
        return refuse(refusals.BLURRED, [name for name in names if widths[name] > limit], width_px=widest)
    return None


def _refuse_wrong_poses(case: VerificationCase, against: str) -> Verdict:
    """Refuses for the reason that speaks most against the poses."""
    cameras = case.evidence.cameras
    if against == "mirrored_cost":
        return refuse(refusals.MIRRORED_IN_DEPTH, case.names)
    if against == "reflection":
        mirrored = case.evidence.reflection.frames
        return refuse(refusals.MIRRORED_PHOTOGRAPHS, mirrored, count=len(mirrored))
    if against == "flat_patch":
        smallest = min(cameras, key=lambda camera: camera.coverage)
        percent = 100 * smallest.coverage
        return refuse(refusals.FLAT_PATCH, (smallest.name,), name=smallest.name, percent=percent)
    if against == "coverage":
        smallest = min(cameras, key=lambda camera: camera.coverage)
        percent = 100 * smallest.coverage
        return refuse(refusals.SMALL_PART, (smallest.name,), name=smallest.name, percent=percent)
    if against in ("rotation_bound", "travel_bound"):
        return explain_wide_bounds(case)
    return _refuse_contradictions(case, against)


def _refuse_contradictions(case: VerificationCase, against: str) -> Verdict:
    """Photographs, pairs of them, or two parts do not fit together. It is about the photograph that fits least."""
    weakest = min(case.evidence.cameras, key=lambda camera: camera.inlier_ratio)
    if against == "directions":
        return refuse(refusals.DISAGREEING, (weakest.name,), degrees=case.evidence.cycles.direction_deg)
    if against == "link_inlier_ratio":
        link, inliers = case.evidence.weakest_link, 100 * case.evidence.weakest_link.inlier_ratio
        count, points = len(link.smaller_part), link.shared_points
        return refuse(refusals.WEAKLY_JOINED, (weakest.name,), count=count, points=points, inliers=inliers)
    if against == "camera_inlier_ratio":
        return refuse(refusals.CONTRADICTED, (weakest.name,), name=weakest.name, inliers=100 * weakest.inlier_ratio)
    return refuse(refusals.CONTRADICTING, (weakest.name,), inliers=100 * case.evidence.inlier_ratio)


def _find_other_lens_frames(case: VerificationCase) -> list[str]:
    """Frames whose size says that another lens took them than most; none where the camera was calibrated."""
    keyframes = [case.graph.keyframes[camera.index] for camera in case.registration.cameras]
    sizes = [tuple(sorted((keyframe.frame.width, keyframe.frame.height))) for keyframe in keyframes]
    common = max(sorted(set(sizes)), key=sizes.count)
    others = [keyframe for keyframe, size in zip(keyframes, sizes, strict=True) if size != common]
    return [keyframe.name for keyframe in others if keyframe.frame.intrinsics is None]
