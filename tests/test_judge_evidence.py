"""Verdicts on registrations that look whole: loose groups, cameras that stand still, planes, doubtful lenses."""

from __future__ import annotations

from dataclasses import replace

from recon.judge import Config, judge
from recon.verdict import Code
from tests.test_judge import all_pairs, graph, names, pair, refused, registration


def test_two_places_that_a_few_contradicted_matches_join_are_not_one():
    pairs = {**all_pairs(3), (3, 4): pair(), (2, 3): pair(matches=45)}
    agreement = {**dict.fromkeys(pairs, 1.0), (2, 3): 0.6}
    verdict = refused(judge(graph(5, pairs), registration((0, 1, 2, 3, 4), agreement), Config()), Code.SPLIT)
    assert verdict.frames == names(3, 4)
    agreement[2, 3] = 0.95
    assert judge(graph(5, pairs), registration((0, 1, 2, 3, 4), agreement), Config()).code == Code.OK


def test_frames_that_stand_still_and_those_that_see_one_plane():
    still = {key: replace(value, points2=value.points1 + 0.01) for key, value in all_pairs(3).items()}
    refused(judge(graph(3, still), registration((0, 1, 2)), Config()), Code.STATIC_CAMERA)
    flat = {key: replace(value, num_homography=195) for key, value in all_pairs(3).items()}
    refused(judge(graph(3, flat), registration((0, 1, 2)), Config()), Code.PLANAR_ONLY)


def test_a_focal_length_that_is_not_known_well_enough():
    found = replace(registration((0, 1, 2)), focal_sigma=0.09)
    refused(judge(graph(3, all_pairs(3)), found, Config()), Code.FOCAL_SUSPECT)


def test_cameras_that_nothing_confirms():
    found = registration((0, 1, 2, 3))
    alone = (found.observed_by == 3) & (found.observed_point >= 3)
    found = replace(found, observed_by=found.observed_by[~alone], observed_point=found.observed_point[~alone])
    verdict = refused(judge(graph(4, all_pairs(4)), found, Config()), Code.AMBIGUOUS)
    assert verdict.frames == names(3)


def test_two_frames_of_somewhere_else_are_a_place():
    verdict = judge(graph(5, {**all_pairs(3), (3, 4): pair()}), registration((0, 1, 2)), Config())
    assert verdict.code == Code.SPLIT and verdict.publishable and verdict.frames == names(3, 4)
