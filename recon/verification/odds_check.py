"""The check of all evidence together: are the poses more likely right than wrong? If not, why?"""

from __future__ import annotations

from splatnode.capture import quality
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.checks import Case, too_close
from splatnode.recon.verification.likelihood import Odds, weigh
from splatnode.recon.verification.refusals import refuse


def odds(case: Case) -> Verdict | None:
    """The evidence speaks against the poses together, or against one of them."""
    found = weigh(case.evidence)
    if found.total >= case.config.min_log_odds and not found.doubtful:
        return None
    return _wrong_frames(case) or _wrong_poses(case, found)


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


def _wrong_poses(case: Case, found: Odds) -> Verdict:
    """What speaks most against the poses."""
    names, evidence = case.names, case.evidence
    if found.total >= case.config.min_log_odds:
        return refuse(refusals.UNCONFIRMED, found.doubtful, count=len(found.doubtful))
    if found.against == "plane":
        return refuse(refusals.MOVING, names, inliers=100 * evidence.inlier_ratio)
    if found.against == "mirror":
        return refuse(refusals.MIRRORED_IN_DEPTH, names)
    if found.against == "inlier_ratio":
        weakest = min(evidence.cameras, key=lambda camera: camera.inlier_ratio)
        frames = found.doubtful or (weakest.name,)
        return refuse(refusals.CONTRADICTING, frames, inliers=100 * evidence.inlier_ratio)
    return too_close(case)


def _through_other_lenses(case: Case) -> list[str]:
    """Frames that were not taken through the lens that took most; none where the camera was calibrated."""
    cameras = case.registration.cameras
    lenses = [camera.lens for camera in cameras]
    common = max(sorted(set(lenses)), key=lenses.count)
    others = [case.graph.keyframes[camera.index] for camera in cameras if camera.lens != common]
    return [keyframe.name for keyframe in others if keyframe.frame.intrinsics is None]
