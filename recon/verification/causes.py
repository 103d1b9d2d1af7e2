"""Why bounds are wide: which of parallax, depth, focal length and shared points was missing, and between which frames.

The causes are asked one after the other, those first that bring the others about: a camera that only turned leaves the
focal length open, too. Each looks at its own evidence, so that no remedy is advised for something that is fine.
"""

from __future__ import annotations

from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import refusals
from splatnode.recon.verification.checks import VerificationCase
from splatnode.recon.verification.refusals import refuse

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
    return refuse(refusals.NO_PARALLAX, case.names, found=f"a turn explains {100 * share:.0f} % of all matches")


def _check_planarity(case: VerificationCase) -> Verdict | None:
    """Views of one plane fix neither the focal length nor which way it leans."""
    pairs = case.graph.pairs.values()
    on_plane = sum(view.num_homography for view in pairs)
    if on_plane <= case.config.explained_by_plane * sum(len(view.matches) for view in pairs):
        return None
    return (
        None
        if case.widest_bounds.focal_percent <= case.config.exact_focal_percent
        else refuse(refusals.PLANAR, case.names)
    )


def _check_focal(case: VerificationCase) -> Verdict | None:
    worst = case.widest_bounds
    if worst.focal_percent <= case.config.exact_focal_percent:
        return None
    centre, rotation = worst.centre_percent, worst.rotation_deg
    return refuse(refusals.UNCERTAIN_FOCAL, case.names, focal=worst.focal_percent, centre=centre, rotation=rotation)


def _check_shared_points(case: VerificationCase) -> Verdict | None:
    """Refuses the camera with the widest bound among those that share few points."""
    weak = [camera for camera in case.evidence.cameras if camera.confirmed < FEW_CONFIRMED]
    if not weak or len(case.evidence.cameras) == 2:  # nobody else sees the points of two
        return None
    weakest = max(weak, key=lambda camera: case.bounds[camera.name].centre_percent)
    partners = case.graph.partners(case.graph.names.index(weakest.name))
    nearest = case.graph.names[max(partners, key=lambda index: (partners[index], -index))]
    return refuse(
        refusals.FEW_SHARED_POINTS,
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
    return refuse(refusals.TOO_CLOSE, case.names, angle=angle, travel=case.travel_percent, rotation=rotation)


def _refuse_scattered(case: VerificationCase) -> Verdict:
    """None of these: the parts of the photographs disagree, most about one camera."""
    config = case.config

    def width(name: str) -> float:
        found = case.bounds[name]
        return max(found.rotation_deg / config.max_rotation_deg, found.centre_percent / config.max_centre_percent)

    worst = max(case.bounds, key=width)
    bounds = case.bounds[worst]
    return refuse(refusals.SCATTERED, (worst,), name=worst, centre=bounds.centre_percent, rotation=bounds.rotation_deg)
