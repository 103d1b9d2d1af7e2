"""The check of all evidence together: are the poses more likely right than wrong? If not, why?"""

from __future__ import annotations

from splatnode.capture import quality
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.causes import why_wide
from splatnode.recon.verification.checks import Case
from splatnode.recon.verification.likelihood import weigh
from splatnode.recon.verification.refusals import refuse


def odds(case: Case) -> Verdict | None:
    """The evidence speaks against the poses."""
    found = weigh(case.evidence, case.numbers.claims, case.numbers.odds)
    if found.total >= case.config.min_log_odds:
        return None
    return _wrong_frames(case) or _wrong_poses(case, found.against)


def _wrong_frames(case: Case) -> Verdict | None:
    """What about the photographs explains that their poses are unlikely, or None."""
    names, limit = case.names, case.config.blurred_px
    foreign = _through_other_lenses(case)
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


def _wrong_poses(case: Case, against: str) -> Verdict:
    """What speaks most against the poses."""
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
        return why_wide(case)
    return _contradictions(case, against)


def _contradictions(case: Case, against: str) -> Verdict:
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


def _through_other_lenses(case: Case) -> list[str]:
    """Frames whose size says that another lens took them than most; none where the camera was calibrated."""
    keyframes = [case.graph.keyframes[camera.index] for camera in case.registration.cameras]
    sizes = [tuple(sorted((keyframe.frame.width, keyframe.frame.height))) for keyframe in keyframes]
    common = max(sorted(set(sizes)), key=sizes.count)
    others = [keyframe for keyframe, size in zip(keyframes, sizes, strict=True) if size != common]
    return [keyframe.name for keyframe in others if keyframe.frame.intrinsics is None]
