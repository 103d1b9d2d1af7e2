"""Cameras of further keyframes beside those that are known: quick, for the moment until all can be done anew.

The known cameras are where the map begins; what is new is placed by the points that it shares with them, and everything
is adjusted. No other first pairs or focal lengths are tried and no patches aligned, so that errors of the start remain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, principal_point
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle, finishing, incremental, lenses, mapper, mapping_problem, register
from splatnode.recon.registration.config import Config
from splatnode.recon.registration.lenses import Grouping
from splatnode.recon.registration.mapping_problem import Growth, Lens
from splatnode.recon.registration.register import RegisteredCamera, Registration

Array = npt.NDArray[np.float64]


def extended(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    start: Sequence[RegisteredCamera],
    config: Config,
) -> Registration | None:
    """The cameras `start` and those of all keyframes that find their place beside them; None where it fails.

    `start` and `pairs` (i < j) number the keyframes by their positions. The world is as `register` has it.
    """
    grouping = _grouping(keyframes, start)
    if grouping is None:
        return None
    known = lenses.lenses(keyframes, grouping, pairs, config.lenses)
    views, in_lens = register.views_of(keyframes, grouping), register.in_pixels_of_lens(pairs, grouping)
    tracks = config.mapper.growing_tracks
    of = mapping_problem.survey(views, known, in_lens, tracks, tracks)
    begun = incremental.quickly_adjusted(of, _begun(keyframes, grouping, known, start), 2.0, config.mapper.incremental)
    if len(begun.problem.points) < config.mapper.incremental.min_points:
        return None
    grown = incremental.extend(of, begun, config.mapper.incremental)
    finished = finishing.finish(of, grown, (), config.mapper.finishing)
    if finished is None:
        return None
    built = mapper.as_map(of, finished, 0.0, config.mapper)
    return register.in_first_camera(built, keyframes, grouping.enlarged)


def _grouping(keyframes: Sequence[Keyframe], start: Sequence[RegisteredCamera]) -> Grouping | None:
    """The frames by the lenses of `start`; None where one of them has no camera in it, or it has them otherwise."""
    for across_sizes in (True, False):
        grouping = lenses.group(keyframes, across_sizes)
        lens_of = {(grouping.lens_of[camera.index], camera.lens) for camera in start}
        if len(lens_of) == len({now for now, _ in lens_of}) == len({then for _, then in lens_of}):
            return grouping if len(lens_of) == len(grouping.longer_sides) else None
    return None


def _begun(
    keyframes: Sequence[Keyframe], grouping: Grouping, known: Sequence[Lens], start: Sequence[RegisteredCamera]
) -> Growth:
    """The known cameras in the pixels of their lenses, without points."""
    count, num_lenses = len(keyframes), len(known)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    log_focals, radials, shifts = np.zeros(num_lenses), np.zeros(num_lenses), np.zeros((num_lenses, 2))
    for camera in start:
        index, lens = camera.index, grouping.lens_of[camera.index]
        rotations[index] = camera.T_world_camera[:3, :3].T
        translations[index] = -rotations[index] @ camera.T_world_camera[:3, 3]
        log_focals[lens] = np.log(grouping.enlarged[index] * camera.focal)
        radials[lens] = camera.radial
        nominal = principal_point(keyframes[index].frame)
        shifts[lens] = grouping.enlarged[index] * (camera.principal - nominal)
    problem = bundle.Problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.array(grouping.lens_of),
        log_focals=log_focals,
        radials=radials,
        shifts=shifts,
        points=np.zeros((0, 3)),
        camera_of=np.zeros(0, np.int64),
        point_of=np.zeros(0, np.int64),
        pixels=np.zeros((0, 2)),
    )
    prior = bundle.LensPrior(
        log_focals=log_focals,
        sigmas=np.array([lens.sigma for lens in known]),
        radial_sigmas=np.zeros(num_lenses),
        shift_sigmas=np.zeros(num_lenses),
    )
    return Growth(tuple(camera.index for camera in start), problem, prior, np.zeros(0, np.int64))
