"""Matches of a facade's windows with the windows beside them: told by their depth, and left out of the tracks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment, mapping_problem
from splatnode.recon.registration.mapping_problem import Lens, MapperInput, MapperView, SparseModel

FOCAL, SIDE, PERIOD, COLUMNS, ROWS = 900.0, 1024, 0.5, 9, 40
KEYS = ((0, 1), (0, 2), (1, 2), (1, 3), (2, 3))
REPEATED = (2, 3)  # the pair half of whose matches are of other windows


def make_facade(num_near: int = 0) -> tuple[MapperInput, SparseModel, np.ndarray]:
    """Views of a wall whose columns of points repeat, the model of their true poses, and which matches are wrong.

    Of the points, `num_near` stand halfway before the wall.
    """
    generator = np.random.default_rng(0)
    column = generator.uniform([-0.2, -1.2, 0.0], [0.2, 1.2, 0.05], (ROWS, 3))  # one window above the other
    across = PERIOD * (np.arange(COLUMNS) - COLUMNS // 2)
    points = (column[None] + np.pad(across[:, None], ((0, 0), (0, 2)))[:, None]).reshape(-1, 3)
    points[generator.permutation(len(points))[:num_near]] *= [0.5, 0.5, 0.0]
    points[(points[:, 2] == 0.0), 2] = -2.0
    rotations = np.stack([cv2.Rodrigues(np.array([0.0, 0.12 * (view - 1.5), 0.01 * view]))[0] for view in range(4)])
    translations = np.array([[-0.5 * (view - 1.5), 0.06 * view, 4.0 + 0.1 * view] for view in range(4)])
    in_cameras = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    pixels = FOCAL * in_cameras[..., :2] / in_cameras[..., 2:] + generator.normal(scale=0.3, size=(4, len(points), 2))
    same = np.arange(len(points))
    pairs, wrong = {}, np.zeros(0, bool)
    for key in KEYS:
        matches = np.stack([same, same], 1)
        if key == REPEATED:
            # Of every second window, the one beside it, to which the same epipolar line leads
            beside = (same % 2 == 0) & (same < len(points) - ROWS)
            matches[:, 1] += np.where(beside, ROWS, 0)
            wrong = beside
        pairs[key] = TwoView(
            matches, pixels[key[0]][matches[:, 0]], pixels[key[1]][matches[:, 1]], len(matches), -99.0, 0, 0, 1.0
        )
    views = [MapperView(each, 0, SIDE) for each in pixels]
    problem = mapping_problem.prepare(views, [Lens((FOCAL,), 0.0)], pairs, 300, 300)
    estimate = bundle_adjustment.make_empty_problem(
        rotations=rotations,
        translations=translations,
        lens_of_camera=np.zeros(4, np.int64),
        log_focals=np.log([FOCAL]),
        radials=np.zeros((1, 2)),
        shifts=np.zeros((1, 2)),
    )
    prior = bundle_adjustment.LensPrior(np.log([FOCAL]), np.zeros(1), np.zeros((1, 2)), np.zeros(1))
    return problem, SparseModel((0, 1, 2, 3), estimate, prior, np.zeros(0, np.int64)), wrong


@pytest.fixture(scope="module")
def facade() -> tuple[MapperInput, SparseModel, np.ndarray]:
    return make_facade()


def test_near_things_that_other_pairs_see_as_well_are_no_repeated_structures():
    problem, model, wrong = make_facade(num_near=60)
    found = mapping_problem.find_other_depths(problem, model)
    near = _inverse_depth(problem, model, REPEATED) > 0.38  # the wall is 4 away
    assert (near & ~wrong).sum() > 20 and found[REPEATED][near & ~wrong].mean() < 0.1
    assert all(found[key].mean() < 0.05 for key in KEYS if key != REPEATED)


def test_matches_of_the_windows_beside_are_found_by_their_depth(facade):
    problem, model, wrong = facade
    found = mapping_problem.find_other_depths(problem, model)
    assert found[REPEATED][wrong].mean() > 0.9
    assert found[REPEATED][~wrong].mean() < 0.05
    assert all(found[key].mean() < 0.02 for key in KEYS if key != REPEATED)


def test_tracks_are_made_without_them_and_all_matches_still_count(facade):
    problem, model, _ = facade
    less = mapping_problem.drop_repeated_structures(problem, model, 300, 300)
    assert less.pairs is problem.pairs and less.views is problem.views
    # A wrong match contradicts its point: its track is dropped as a whole, and comes back without it
    assert less.final_tracks.num_tracks > problem.final_tracks.num_tracks
    errors = [_count_torn_tracks(each) for each in (problem, less)]
    assert errors[1] <= 0.1 * errors[0]


def test_a_few_matches_at_other_depths_are_edges_and_stay(facade):
    problem, model, wrong = facade
    pair = problem.pairs[REPEATED]
    few = ~wrong | (np.cumsum(wrong) <= 15)
    pairs = {**problem.pairs, REPEATED: pair.select(few)}
    problem = mapping_problem.prepare(problem.views, problem.lenses, pairs, 300, 300)
    assert mapping_problem.find_other_depths(problem, model)[REPEATED].sum() >= 10
    assert mapping_problem.drop_repeated_structures(problem, model, 300, 300) is problem


def test_views_that_are_not_registered_say_nothing(facade):
    problem, model, _ = facade
    without = replace(model, registered=(0, 1, 2))
    assert set(mapping_problem.find_other_depths(problem, without)) == {(0, 1), (0, 2), (1, 2)}
    assert mapping_problem.drop_repeated_structures(problem, without, 300, 300) is problem


def _count_torn_tracks(problem: MapperInput) -> int:
    """How many tracks join features of two windows."""
    tracks = problem.final_tracks
    feature = {tuple(pixel): index for view in problem.views for index, pixel in enumerate(view.points)}
    of_track: dict[int, set[int]] = {}
    for track, pixel in zip(tracks.track_of, tracks.pixels, strict=True):
        of_track.setdefault(int(track), set()).add(feature[tuple(pixel)])
    return sum(len(each) > 1 for each in of_track.values())


def _inverse_depth(problem: MapperInput, model: SparseModel, key: tuple[int, int]) -> np.ndarray:
    return mapping_problem._inverse_depths(model.estimate, key, problem.pairs[key])[0]
