"""Registration with given poses: cameras in the world of these, whether images share matches or not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from splatnode.recon.geometry import cross_matrix
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import (
    bundle_adjustment,
    guided,
    known_poses,
    mapping_problem,
    posed_mapping,
    self_calibration,
)
from splatnode.recon.registration.bundle_adjustment import differentiate_by_pose
from splatnode.recon.registration.known_poses import Drift, Given, GivenWorld, Offset
from splatnode.recon.registration.posed_mapping import PosedMap
from splatnode.recon.registration.registration import (
    Registration,
    RegistrationConfig,
    convert_to_lens_pixels,
    make_registration,
    make_views,
    patch_images,
    relabel_pairs,
    sort_by_content,
)

Pairs = Mapping[tuple[int, int], TwoView]


def register_posed(
    keyframes: Sequence[Keyframe],
    pairs: Pairs,
    config: RegistrationConfig,
    pause: Callable[[], None] = lambda: None,
    offset: Offset | None = None,
) -> Registration | None:
    """The cameras of the keyframes whose pose is given and true, and of those that images place beside them.

    None where given poses cannot hold a map: fewer than two have a pose and a lens that are told, or the images
    contradict as many of them as they confirm. `offset` is taken out of all poses. `pairs` and `pause`: see `register`.
    """
    order = sort_by_content(keyframes)
    ordered, rank = [keyframes[index] for index in order], np.argsort(order)
    drift = Drift(config.poses_drift, config.poses_drift_deg)
    given = known_poses.collect_known_poses(ordered, offset, drift)
    if given is None:
        return None
    grouping = self_calibration.group(ordered, across_sizes=True)
    matched = guided.add_guided_matches(ordered, relabel_pairs(pairs, rank), given)
    pause()
    views = make_views(ordered, grouping)
    known = self_calibration.candidates(ordered, grouping, matched, config.lenses)
    settings = config.mapper
    problem = mapping_problem.prepare(
        views,
        known,
        convert_to_lens_pixels(matched, grouping),
        settings.max_growing_tracks,
        settings.max_final_tracks,
    )
    focals, images = [lens.focals[0] for lens in known], patch_images(ordered, grouping, config)
    built = posed_mapping.build_map(problem, focals, given, images, settings, pause)
    if built is None:
        return None
    moved = replace(built, map=built.map.relabel(order))
    found = make_registration(moved.map, keyframes, [grouping.scales[i] for i in rank], config)
    return replace(found, given=_world(moved, found, given, order, offset))


def _world(
    built: PosedMap, found: Registration, given: Given, order: Sequence[int], offset: Offset | None
) -> GivenWorld:
    """How the registration `found` of `built`, whose views are keyframes, lies in the given world.

    View i of `built.deviations` is keyframe `order[i]`.
    """
    estimate, views = built.map.estimate, [camera.index for camera in found.cameras]
    first, unit = views[0], _unit(built, found)
    to_first, from_first = estimate.rotations[first], estimate.translations[first]
    held = [] if estimate.given is None else [view for view in views if estimate.given.is_held[view]]
    covariance = bundle_adjustment.covariance(estimate, built.map.prior, built.map.loss, -1)
    turns, moves = differentiate_by_pose(estimate.rotations[views], estimate.translations[views])
    rows = (6 * np.array(views)[:, None] + np.arange(6)).ravel()
    joint = covariance.joint[np.ix_(rows, rows)]
    blocks = [slice(3 * i, 3 * i + 3) for i in range(len(views))]
    in_world = [(to_first @ turns[b], unit * to_first @ moves[b]) for b in blocks]
    # What is not known of the offset is not known of any camera.
    turn_sigma, shift_sigma = (0.0, 0.0) if offset is None else (offset.turn_sigma, offset.shift_sigma)
    of_turn, of_shift = turn_sigma**2 * np.eye(3), (shift_sigma * unit / given.metres) ** 2 * np.eye(3)
    return GivenWorld(
        scale=given.metres / unit,
        rotation=to_first.T,
        translation=given.origin - given.metres * to_first.T @ from_first,
        scale_sigma=0.0 if estimate.given is None else compute_scale_sigma(estimate.given),
        deviations=tuple(replace(each, index=order[each.index]) for each in built.deviations),
        offset=offset,
        turn_covariances=np.stack([turn @ joint @ turn.T + of_turn for turn, _ in in_world]),
        centre_covariances=np.stack([move @ joint @ move.T + of_shift for _, move in in_world]),
        held=frozenset(held),
    )


def compute_scale_sigma(given: bundle_adjustment.GivenPoses) -> float:
    """Standard deviation of the logarithm of the scale at which cameras of a known shape fit given poses."""
    held = np.flatnonzero(given.is_held)
    middle = given.centres[held].mean(0)
    by_similarity = np.zeros((6 * len(given.centres), 7))
    for camera in held.tolist():
        rotation, off = given.rotations[camera], given.centres[camera] - middle
        own = slice(6 * camera, 6 * camera + 3), slice(6 * camera + 3, 6 * camera + 6)
        by_similarity[own[0], :3], by_similarity[own[1], 3:6] = rotation, rotation
        by_similarity[own[1], :3], by_similarity[own[1], 6] = -rotation @ cross_matrix(off[None])[0], rotation @ off
    covariance = np.linalg.pinv(by_similarity.T @ given.information @ by_similarity)
    return float(np.sqrt(covariance[6, 6]))


def _unit(built: PosedMap, found: Registration) -> float:
    """A length in `found` over the same in `built`: the registration scaled it."""
    return 1.0 / known_poses.distance(built.map.estimate, [camera.index for camera in found.cameras])
