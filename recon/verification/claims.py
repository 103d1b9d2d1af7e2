"""What is claimed of cameras that a rig places or given poses hold, and the verdict on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splatnode.capture.process.text import sanitize_text
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.known_poses import Deviation, GivenWorld
from splatnode.recon.registration.registration import Registration
from splatnode.recon.registration.rigs import Mount, RigChange, RigEstimate
from splatnode.recon.result.snapshot import format_rounded_up
from splatnode.recon.result.verdict import (
    Bounds,
    Code,
    Verdict,
    compute_axes,
    compute_length_95,
    find_widest,
    make_ball,
)
from splatnode.recon.verification import rejections
from splatnode.recon.verification.rejections import DecisionConfig, refuse

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
        told = "; ".join(map(_format_change, rig.changes[:_MOST_NAMED]))
        more = f", and {len(rig.changes) - _MOST_NAMED} more" if len(rig.changes) > _MOST_NAMED else ""
        sentences.append(f"Cameras do not stand on the rig as in most frame sets: {told}{more}.")
        advice.append("Fasten these cameras, and calibrate the rig anew.")
    if rig.refuted:
        names = ", ".join(map(sanitize_text, rig.refuted))
        which = "is not where the given rig has it" if len(rig.refuted) == 1 else "are not where the given rig has them"
        sentences.append(f"The photographs contradict the given rig, which is not believed there: {names} {which}.")
        advice.append("Calibrate the rig anew, or leave it out: it is estimated then.")
    left = tuple(name for name in verdict.frames if name not in {graph.names[i] for i in rig.placed})
    return replace(verdict, message=" ".join(sentences), advice=" ".join(filter(None, advice)), frames=left)


def _format_change(change: RigChange) -> str:
    named = " or ".join(map(sanitize_text, change.camera_ids))
    return (
        f"{named} from frame set {change.first + 1} on ({change.count} sets) by {change.degrees:.2g} degrees and "
        f"{100 * change.shift:.2g} % of the distance"
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
        return refuse(rejections.ROUGHER, sorted(bounds), found=found, needed=config.max_position_error_percent)
    placed = {camera.index for camera in registration.cameras}
    left_out = tuple(name for index, name in enumerate(graph.names) if index not in placed)
    count = f"{'All' if not left_out else f'{len(placed)} of'} {len(graph.names)} photographs were placed"
    code, message = (Code.OK_PARTIAL if left_out else Code.OK), f"{count}, {len(given.held)} of them by given poses."
    if rough := _rough(registration, worst, config):
        code, message = Code.OK_ROUGH, f"{message[:-1]}, roughly: {rough}."
    advice = f"Give a pose of {sanitize_text(left_out[0])}, or add a photograph beside it." if left_out else ""
    verdict = Verdict(code, message, advice, left_out, publishable=True)
    return _naming(verdict, graph, given, placed)


def _rough(registration: Registration, worst: Bounds, config: DecisionConfig) -> str:
    """Says what is known less well than an exact scene knows it; empty where nothing is."""
    # What the given world leaves open for all cameras alike bends no scene.
    shape = _TWO_SIDED_95 * max(camera.centre_sigma_rel for camera in registration.cameras)
    travel_percent = 100.0 * float(np.nan_to_num(shape, nan=np.inf))
    if travel_percent <= config.exact_travel_percent and worst.rotation_deg <= config.exact_rotation_deg:
        return ""
    return (
        f"positions are known to {worst.centre_percent:.2g} % of the distance to the scene ({travel_percent:.2g} % of "
        f"how far the camera moved), directions to {worst.rotation_deg:.2g} degrees"
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
        told = [_residual(graph, each, placed) for each in given.deviations[:_MOST_NAMED]]
        more = f", and {len(given.deviations) - _MOST_NAMED} more" if len(given.deviations) > _MOST_NAMED else ""
        sentences.append(f"The photographs contradict given poses: {'; '.join(told)}{more}.")
        advice.append("Check these poses, and whether their photographs were taken there.")
    names = tuple(graph.names[each.index] for each in given.deviations)
    frames = (*verdict.frames, *(name for name in names if name not in verdict.frames))
    return replace(verdict, message=" ".join(sentences), advice=" ".join(filter(None, advice)), frames=frames)


def _format_sigma(sigma: float) -> str:
    return format_rounded_up(_TWO_SIDED_95 * sigma)


def _residual(graph: ViewGraph, deviation: Deviation, placed: set[int]) -> str:
    done = "placed by the photographs alone" if deviation.index in placed else "left out"
    name = sanitize_text(graph.names[deviation.index])
    return f"that of {name} is {deviation.metres:.2g} m and {deviation.degrees:.2g} degrees off ({done})"
