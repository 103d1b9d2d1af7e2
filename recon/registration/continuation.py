"""Continuation: further keyframes registered beside known cameras, quickly, until all can be registered anew.

The known cameras start the map; new views are resected from the points that they share with them, and everything is
adjusted. No other first pair or focal length is tried and no patches are aligned, so that errors of the start remain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, principal_point
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import (
    bundle,
    finishing,
    incremental,
    lenses,
    mapper,
    mapping_problem,
    own_lenses,
    register,
)
from splatnode.recon.registration.config import RegistrationConfig
from splatnode.recon.registration.lenses import Grouping
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, PartialMap
from splatnode.recon.registration.register import RegisteredCamera, Registration

Array = npt.NDArray[np.float64]


def extend_registration(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    start: Sequence[RegisteredCamera],
    config: RegistrationConfig,
) -> Registration | None:
    """The cameras `start` and those of all keyframes that can be registered beside them; None where it fails.

    `start` and `pairs` (i < j) number the keyframes by their positions. The world is as `register` has it.
    """
    grouping = _grouping(keyframes, start)
    if grouping is None:
        return None
    known = lenses.candidates(keyframes, grouping, pairs, config.lenses)
    views, scaled = register.make_views(keyframes, grouping), register.convert_to_lens_pixels(pairs, grouping)
    max_tracks = config.mapper.max_growing_tracks
    problem = mapping_problem.prepare(views, known, scaled, max_tracks, max_tracks)
    first = _make_camera_map(keyframes, grouping, known, start)
    problem, first = _add_own_lenses(problem, first, keyframes, grouping, start)
    settings = config.mapper.incremental
    partial = incremental.adjust_quickly(problem, first, incremental.SETTLED_TOLERANCE, settings)
    if len(partial.estimate.points) < settings.min_points:
        return None
    finished = finishing.run_final_adjustment(
        problem, incremental.extend(problem, partial, settings), (), config.mapper.finishing
    )
    if finished is None:
        return None
    problem, finished = mapper.give_own_lenses(problem, finished, (), config.mapper)
    found = mapper.make_map(problem, finished, settings.triangulation.max_error_px, len(known))
    return register.make_registration(found, keyframes, grouping.scales, config)


def _grouping(keyframes: Sequence[Keyframe], start: Sequence[RegisteredCamera]) -> Grouping | None:
    """The frames grouped by lens as the cameras `start` are; None where no grouping fits, or a lens has no camera."""
    shared = [camera for camera in start if not camera.own_lens]
    for across_sizes in (True, False):
        grouping = lenses.group(keyframes, across_sizes)
        if not shared:
            return grouping if len(set(grouping.lens_of)) == 1 else None
        lens_of = {(grouping.lens_of[camera.index], camera.lens) for camera in shared}
        if len(lens_of) == len({now for now, _ in lens_of}) == len({then for _, then in lens_of}):
            return grouping if len(lens_of) == len(set(grouping.lens_of)) else None
    return None


def _make_camera_map(
    keyframes: Sequence[Keyframe], grouping: Grouping, known: Sequence[Lens], start: Sequence[RegisteredCamera]
) -> PartialMap:
    """A map of the known cameras without points, in the pixels of their lenses; only focal lengths are free."""
    count, num_lenses = len(keyframes), len(known)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    log_focals, radials, shifts = np.zeros(num_lenses), np.zeros((num_lenses, 2)), np.zeros((num_lenses, 2))
    for camera in sorted(start, key=lambda each: each.own_lens):
        index, lens = camera.index, grouping.lens_of[camera.index]
        rotations[index] = camera.T_world_camera[:3, :3].T
        translations[index] = -rotations[index] @ camera.T_world_camera[:3, 3]
        if camera.own_lens and log_focals[lens] != 0.0:
            continue
        log_focals[lens] = np.log(grouping.scales[index] * camera.focal)
        radials[lens] = camera.radial
        nominal = principal_point(keyframes[index].frame)
        shifts[lens] = grouping.scales[index] * (camera.principal - nominal)
    estimate = bundle.make_empty_problem(
        rotations, translations, np.array(grouping.lens_of), log_focals, radials, shifts
    )
    prior = bundle.focal_prior(log_focals, np.array([lens.sigma for lens in known]))
    return PartialMap(tuple(camera.index for camera in start), estimate, prior, np.zeros(0, np.int64))


def _add_own_lenses(
    problem: MapperInput,
    first: PartialMap,
    keyframes: Sequence[Keyframe],
    grouping: Grouping,
    start: Sequence[RegisteredCamera],
) -> tuple[MapperInput, PartialMap]:
    """Both, with lenses of their own for the known cameras that have one."""
    registered = first.registered
    for camera in start:
        if not camera.own_lens:
            continue
        scale = grouping.scales[camera.index]
        problem, first = own_lenses.add_lens(problem, first, camera.index, scale * camera.focal)
        radials, shifts = first.estimate.radials.copy(), first.estimate.shifts.copy()
        radials[-1] = camera.radial
        shifts[-1] = scale * (camera.principal - principal_point(keyframes[camera.index].frame))
        first = replace(first, estimate=replace(first.estimate, radials=radials, shifts=shifts))
    return problem, replace(first, registered=registered)
