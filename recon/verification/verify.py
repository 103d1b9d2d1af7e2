"""The verification of a registration: evidence from sources that the fit did not use, or used otherwise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.inliers import compute_pooled_ratio
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.verification import (
    cycles,
    errors,
    exposure,
    flatness,
    lens,
    refit,
    reflection,
    reversal,
    weakest_link,
)
from splatnode.recon.verification.errors import Errors, PoseErrors
from splatnode.recon.verification.evidence import CameraEvidence, Evidence
from splatnode.recon.verification.reflection import Reflection

Array = npt.NDArray[np.float64]

OUTSIDE = 0.03  # share of a camera's points on each side that the box of its coverage leaves out: wrong matches
MIN_MATCHES = 60  # of a pair whose homography says something: fewer are explained by chance


class VerificationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    tracks_per_camera: int = 300  # tracks of a camera in the bundle that is adjusted again
    cycles: cycles.CycleConfig = cycles.CycleConfig()
    reflection: reflection.ReflectionConfig = reflection.ReflectionConfig()


def verify(
    graph: ViewGraph,
    registration: Registration | None,
    config: VerificationConfig,
    pause: Callable[[], None] = lambda: None,
) -> Evidence | None:
    """Numbers for and against `registration`; None where it has fewer than two cameras.

    `pause` is called between the sources of evidence; it may raise to abandon the work.
    """
    if registration is None or len(registration.cameras) < 2:
        return None
    fit = refit.build_fit(graph.keyframes, registration, config.tracks_per_camera)
    sizes = errors.measure_errors(fit, registration)
    pause()
    cameras = _collect_camera_evidence(graph, registration, sizes.cameras, sizes.focals)
    pause()
    return Evidence(
        cameras=cameras,
        inlier_ratio=compute_inlier_ratio(graph, registration, None),
        weakest_link=weakest_link.measure_weakest_link(registration, graph.names, graph.pairs),
        disconnected=_name_disconnected_frames(graph, registration),
        reflection=_measure_reflection(graph, registration, config.reflection),
        flatness=flatness.compute_share_on_plane(registration.points),
        mirrored_cost=reversal.compute_reversal_cost_ratio(fit),
        cycles=cycles.measure_cycle_consistency(graph.keyframes, registration, graph.pairs, config.cycles),
        median_angle_deg=registration.median_angle_deg,
        rms_px=registration.rms_px,
        focal=sizes.focal,
        travel=errors.compute_travel(registration),
        freed=lens.free_lenses(fit),
        distortion=lens.measure_distortion(fit),
    )


def verify_further(
    graph: ViewGraph, registration: Registration, known: Evidence, config: VerificationConfig
) -> Evidence | None:
    """Evidence for `registration`, which continues the one that `known` is about: provisional, and quick.

    None where a further photograph may be mirrored: a few partners cannot tell that for certain, all evidence must.

    Measured anew: the cameras that `known` does not have, with their exposure and whether their photographs are
    mirrored; and of all cameras the matches, the weakest link, the plane, angles, errors and the focal length, of which
    the larger uncertainty counts. Reused from `known`, because it says little about one camera more: the known cameras'
    exposures and that they are not mirrored, the jackknife, the scene mirrored in depth, cycles, freed lenses and
    distortion. The pose sigmas of a continuation, which aligns no patches, are too large: they are reduced by as much
    as those of the known cameras are.
    """
    before = {camera.name: camera for camera in known.cameras}
    names = {camera.index: graph.keyframes[camera.index].name for camera in registration.cameras}
    further = {index for index, name in names.items() if name not in before}
    reflections = _measure_further_reflections(graph, registration, names.keys() - further, further, config.reflection)
    if not all(each.gain <= config.reflection.max_further_gain for each in reflections):
        return None
    known_errors = {index: before[name].errors for index, name in names.items() if name in before}
    sizes = errors.extrapolate_pose_errors(registration, known_errors)
    known_focals = {index: before[name].focal for index, name in names.items() if name in before}
    focals = errors.extrapolate_focal_errors(registration, known_focals)
    of_further = {index: sizes[index] for index in further}
    measured = {camera.name: camera for camera in _collect_camera_evidence(graph, registration, of_further, focals)}
    return replace(
        known,
        cameras=tuple(
            replace(
                measured.get(names[camera.index]) or before[names[camera.index]],
                inlier_ratio=compute_inlier_ratio(graph, registration, camera.index),
                errors=sizes[camera.index],
                focal=focals[camera.index],
            )
            for camera in registration.cameras
        ),
        inlier_ratio=compute_inlier_ratio(graph, registration, None),
        weakest_link=weakest_link.measure_weakest_link(registration, graph.names, graph.pairs),
        disconnected=_name_disconnected_frames(graph, registration),
        reflection=reflection.select_strongest_reflection([known.reflection, *reflections]),
        flatness=flatness.compute_share_on_plane(registration.points),
        median_angle_deg=registration.median_angle_deg,
        rms_px=registration.rms_px,
        focal=errors.combine_worst(focals.values()),
        travel=errors.compute_travel(registration),
    )


def _collect_camera_evidence(
    graph: ViewGraph,
    registration: Registration,
    sizes: Mapping[int, PoseErrors],
    focals: Mapping[int, Errors],
) -> tuple[CameraEvidence, ...]:
    """Collects the evidence of the cameras that `sizes` has, by keyframe."""
    by = registration.observed_by
    times_seen = np.bincount(registration.observed_point, minlength=len(registration.points))
    by_third = times_seen[registration.observed_point] >= 3
    confirmed = np.bincount(registration.observed_by[by_third], minlength=len(graph.keyframes))
    keyframes = {camera.index: graph.keyframes[camera.index] for camera in registration.cameras}
    greys = {index: cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY) for index, keyframe in keyframes.items()}
    gains = exposure.estimate_gains(
        {index: grey.astype(np.float32) for index, grey in greys.items()},
        registration,
        {index: keyframe.scale for index, keyframe in keyframes.items()},
    )
    return tuple(
        CameraEvidence(
            name=keyframes[camera.index].name,
            inlier_ratio=compute_inlier_ratio(graph, registration, camera.index),
            confirmed=int(confirmed[camera.index]),
            coverage=compute_coverage(keyframes[camera.index], registration.observed_pixels[by == camera.index]),
            flat_share=compute_flat_share(graph, camera.index),
            gain=gains[camera.index],
            errors=sizes[camera.index],
            focal=focals[camera.index],
            own_lens=camera.own_lens or camera.displaced or abs(camera.aspect - 1.0) > refit.SQUARE,
            refuted_focal=_compute_refuted_focal(camera, keyframes[camera.index]),
        )
        for camera in registration.cameras
        if camera.index in sizes
    )


def _compute_refuted_focal(camera: RegisteredCamera, keyframe: Keyframe) -> float:
    given = keyframe.frame.intrinsics
    if given is None or given.source not in ("given", "calibration"):
        return 0.0
    return camera.focal / given.fx if camera.own_lens else 1.0


def compute_coverage(keyframe: Keyframe, pixels: Array) -> float:
    """The share of the picture in the box that holds all of `pixels` (M, 2), but for a few on each side."""
    if len(pixels) == 0:
        return 0.0
    least, most = np.quantile(pixels, (OUTSIDE, 1.0 - OUTSIDE), axis=0)
    return float(np.prod((most - least) / (keyframe.frame.width, keyframe.frame.height)))


def compute_flat_share(graph: ViewGraph, index: int) -> float:
    """The largest share of a pair's matches that one homography explains, of the pairs of the keyframe `index`."""
    of_camera = (pair for key, pair in graph.pairs.items() if index in key and len(pair.matches) >= MIN_MATCHES)
    return max((pair.num_homography / len(pair.matches) for pair in of_camera), default=0.0)


def _measure_reflection(
    graph: ViewGraph, registration: Registration, config: reflection.ReflectionConfig
) -> Reflection:
    """Measures the registered pairs that are worth matching: each keyframe has enough of them."""
    place = {camera.index: position for position, camera in enumerate(registration.cameras)}
    worth = {(place[i], place[j]) for i, j in graph.select_pairs_worth_matching() if i in place and j in place}
    pairs = {(min(pair), max(pair)) for pair in worth}
    return reflection.measure_reflection([graph.keyframes[index] for index in place], pairs, config)


def _measure_further_reflections(
    graph: ViewGraph,
    registration: Registration,
    known: Collection[int],
    further: Collection[int],
    config: reflection.ReflectionConfig,
) -> list[Reflection]:
    """Measures each further camera beside the known ones that share most points with it."""
    found = []
    for index in sorted(further):
        others = find_partners(index, known, registration, config.partners)
        beside = [graph.keyframes[other] for other in others]
        found.append(reflection.measure_further(graph.keyframes[index], beside, config))
    return found


def _name_disconnected_frames(graph: ViewGraph, registration: Registration) -> tuple[str, ...]:
    return tuple(
        graph.keyframes[index].name for index in weakest_link.find_disconnected_frames(registration, graph.pairs)
    )


def compute_inlier_ratio(graph: ViewGraph, registration: Registration, index: int | None) -> float:
    """The share of matches that the cameras explain, of all verified pairs or of those of the keyframe `index`."""
    return compute_pooled_ratio(registration.inlier_ratios, graph.pairs, index)


def find_partners(index: int, among: Collection[int], registration: Registration, count: int) -> list[int]:
    """The `count` views of `among` that share most points with the view `index`."""
    mine = registration.observed_point[registration.observed_by == index]
    shared = np.bincount(registration.observed_by[np.isin(registration.observed_point, mine)], minlength=max(among) + 1)
    return sorted((other for other in among if other != index), key=lambda other: (-shared[other], other))[:count]
