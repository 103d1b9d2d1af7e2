"""What is claimed of cameras that a rig places, and what a verdict says of the rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splatnode.capture.process.text import sanitize_text
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.given_rig import MountResidual
from splatnode.recon.registration.registration import Registration
from splatnode.recon.registration.rigs import Mount, RigChange, RigEstimate
from splatnode.recon.result.verdict import Bounds, Verdict, find_widest, make_ball

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
        told = "; ".join(map(_format_change, rig.changes[:_MOST_NAMED]))
        more = f", and {len(rig.changes) - _MOST_NAMED} more" if len(rig.changes) > _MOST_NAMED else ""
        sentences.append(f"Cameras do not stand on the rig as in most frame sets: {told}{more}.")
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
