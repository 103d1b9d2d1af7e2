"""What is claimed of cameras that given poses hold, and the verdict on them.

Images that alone cannot tell where they were taken are no reason to refuse here: the poses tell it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.capture.process.text import sanitize_text
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.known_poses import Deviation, GivenWorld
from splatnode.recon.registration.registration import Registration
from splatnode.recon.result.snapshot import format_rounded_up
from splatnode.recon.result.verdict import Bounds, Code, Verdict, compute_axes, compute_length_95, find_widest
from splatnode.recon.verification import rejections
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.rejections import refuse

_TWO_SIDED_95 = 1.96
_MOST_NAMED = 5  # poses whose residuals a sentence tells


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
