"""Why a scene is refused or rough: the cause of wide bounds, and what speaks most against the poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.extras.evaluate.stability.fitting import FOR
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.decision import DecisionConfig, decide
from splatnode.recon.verification.error_model import OddsModel, VerdictModels, predict_bounds
from splatnode.recon.verification.evidence import CycleConsistency, Reflection
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.refit import Errors
from tests.support.verdicts import (
    all_pairs,
    evidence,
    graph,
    names,
    pair,
    refused,
    registration,
    unsure,
    verdict,
)


def flat(count: int) -> ViewGraph:
    return graph(count, {key: replace(value, num_homography=195) for key, value in all_pairs(count).items()})


def turning(count: int) -> ViewGraph:
    return graph(count, {key: replace(value, num_rotation=150) for key, value in all_pairs(count).items()})


WHATEVER_THE_ODDS = DecisionConfig(min_log_odds=-100.0)
OPEN_FOCAL = Errors(0.5, 0.5, 0.5)
ROUGH_FOCAL = Errors(0.06, 0.06, 0.06)


@pytest.mark.parametrize(
    ("graph", "what", "code", "said"),
    [
        (turning, {}, Code.NO_PARALLAX, "a turn explains 75 % of all matches"),
        (turning, {"focal": OPEN_FOCAL}, Code.NO_PARALLAX, "a turn explains"),  # it leaves the focal length open, too
        (flat, {"focal": OPEN_FOCAL}, Code.PLANAR_ONLY, "one plane"),
        (flat, {"median_angle_deg": 2.0}, Code.BASELINE_TOO_SMALL, "under 2.0 degrees"),  # its focal length is known
        (lambda n: graph(n, all_pairs(n)), {"focal": OPEN_FOCAL}, Code.FOCAL_SUSPECT, "focal length is not known"),
        (lambda n: graph(n, all_pairs(n)), {"focal": ROUGH_FOCAL}, Code.FOCAL_SUSPECT, "focal length is known to"),
        (lambda n: graph(n, all_pairs(n)), {"median_angle_deg": 2.0}, Code.BASELINE_TOO_SMALL, "under 2.0 degrees"),
        (lambda n: graph(n, all_pairs(n)), {}, Code.AMBIGUOUS, "disagree about 2.png"),
    ],
)
def test_bounds_that_are_too_wide_are_refused_for_their_cause(graph, what, code, said):
    seen = evidence((0, 1, 2, 3), {2: {"errors": unsure(rotation=20.0)}}, **what)
    given = refused(decide(graph(4), registration((0, 1, 2, 3)), seen, DecisionConfig()), code)
    assert said in given.message
    assert ("further to the side" in given.advice) == (code == Code.BASELINE_TOO_SMALL)


def test_a_camera_that_hangs_on_few_points_is_named_with_its_neighbour():
    pairs = {**all_pairs(4), (1, 2): pair(300)}
    seen = evidence((0, 1, 2, 3), {2: {"errors": unsure(centre=0.3), "confirmed": 18}})
    given = refused(decide(graph(4, pairs), registration((0, 1, 2, 3)), seen, DecisionConfig()), Code.NO_OVERLAP)
    assert given.frames == names(2, 1) and "2.png shares only 18 points" in given.message
    assert given.advice == "Add a photograph between 2.png and 1.png."


def test_a_camera_that_no_third_one_confirms_is_refused_however_sure_it_seems():
    given = refused(verdict(4, {2: {"confirmed": 14}}), Code.NO_OVERLAP)
    assert given.frames == names(2) and "Only 14 points of 2.png are seen by two others at once" in given.message
    assert verdict(4, {2: {"confirmed": 15}}).code == Code.OK


def test_a_lens_of_its_own_that_fits_few_matches_is_none():
    """One image corrected for its keystone got a longer lens, which fits 82 % of its matches, 6 degrees off."""
    unfit = {2: {"own_lens": True, "inlier_ratio": 0.82}}
    given = refused(verdict(4, unfit), Code.AMBIGUOUS)
    assert given.frames == names(2) and "2.png does not have the lens that it was taken for" in given.message
    assert "only 82 % of its matches fit" in given.message and given.advice.endswith("2.png by --intrinsics.")
    assert "taken for" not in verdict(4, {2: {"own_lens": True, "inlier_ratio": 0.86}}).message
    assert "taken for" not in verdict(4, {2: {"inlier_ratio": 0.82}}).message


@pytest.mark.parametrize("errors", [unsure(rotation=20.0), unsure(centre=0.3)])
def test_what_is_known_of_one_camera_only_roughly_makes_nothing_of_the_others(errors):
    refused(verdict(4, {2: {"errors": errors}}), Code.AMBIGUOUS)


def test_a_rough_scene_is_published_and_says_how_rough_it_is():
    rough = evidence((0, 1, 2, 3), {2: {"errors": unsure(centre=0.01)}})
    given = decide(graph(4, all_pairs(4)), registration((0, 1, 2, 3)), rough, WHATEVER_THE_ODDS)
    assert given.code == Code.OK_ROUGH and given.publishable and given.frames == () and given.advice.endswith(".")
    assert "All 4 photographs were placed, roughly: positions are known to" in given.message
    assert "% of the distance to the scene" in given.message and "of how far the camera moved" in given.message
    pairs = {key: value for key, value in all_pairs(5).items() if 3 not in key}
    left = (0, 1, 2, 4)
    rough = evidence(left, {2: {"errors": unsure(rotation=2.0)}})
    given = decide(graph(5, pairs), registration(left), rough, WHATEVER_THE_ODDS)
    assert (
        given.code == Code.OK_ROUGH and given.frames == names(3) and "4 of 5 photographs were placed" in given.message
    )


def test_who_requires_more_than_is_known_gets_a_refusal_that_says_what_is_known():
    rough = {2: {"errors": unsure(centre=0.01)}}
    seen = evidence((0, 1, 2, 3), rough)
    positions = max(bounds.centre_percent for bounds in predict_bounds(seen, FITTED.many.claims).values())
    given = decide(
        graph(4, all_pairs(4)),
        registration((0, 1, 2, 3)),
        seen,
        DecisionConfig(max_position_error_percent=positions + 0.1, min_log_odds=-100.0),
    )
    assert given.code == Code.OK_ROUGH
    given = decide(
        graph(4, all_pairs(4)),
        registration((0, 1, 2, 3)),
        seen,
        DecisionConfig(max_position_error_percent=positions - 0.1, min_log_odds=-100.0),
    )
    assert f"{positions:.2g} % of the distance" in refused(given, Code.TOO_ROUGH).message


def test_cameras_that_moved_less_than_their_centres_are_uncertain_show_no_depth():
    given = refused(verdict(3, travel=0.001, median_angle_deg=0.3), Code.BASELINE_TOO_SMALL)
    assert "0.3 degrees" in given.message


def doubting(measure: str) -> VerdictModels:
    """Numbers by which only one measure counts, against the poses where it is worse than in right registrations."""
    term = replace(FITTED.many.odds.terms[measure], slope=30.0 if measure in FOR else -30.0)
    numbers = replace(FITTED.many, odds=OddsModel(2.0, {measure: term}))
    return VerdictModels(numbers, numbers)


@pytest.mark.parametrize(
    ("measure", "what", "whole", "code", "frames", "said"),
    [
        ("inlier_ratio", {2: {"inlier_ratio": 0.45}}, {"inlier_ratio": 0.5}, Code.AMBIGUOUS, (2,), "50 % of their"),
        ("camera_inlier_ratio", {2: {"inlier_ratio": 0.45}}, {}, Code.AMBIGUOUS, (2,), "45 % of its matches fit"),
        (
            "directions",
            {2: {"inlier_ratio": 0.45}},
            {"cycles": CycleConsistency(4, 0.5, 1.0, 25.0, 30.0)},
            Code.AMBIGUOUS,
            (2,),
            "disagree by 25 degrees",
        ),
        (
            "link_inlier_ratio",
            {2: {"inlier_ratio": 0.45}},
            {"weakest_link": replace(evidence((0, 1, 2, 3)).weakest_link, smaller_part=("2.png",), inliers=20.0)},
            Code.AMBIGUOUS,
            (2,),
            "The smaller part has 1 of them",
        ),
        ("coverage", {2: {"coverage": 0.06}}, {}, Code.AMBIGUOUS, (2,), "fills only 6 % of its picture"),
        ("reflection", {}, {"reflection": Reflection(("1.png",), 0.3)}, Code.AMBIGUOUS, (1,), "the wrong way round"),
        ("flat_patch", {2: {"coverage": 0.04, "flat_share": 0.99}}, {}, Code.MOVING_SCENE, (2,), "4 % of its picture"),
        ("own_lens", {2: {"own_lens": True}}, {}, Code.AMBIGUOUS, (2,), "1 of 4 photographs does not have the lens"),
        (  # most have: they are not left out, the photograph that fits least is
            "own_lens",
            {index: {"own_lens": True, "inlier_ratio": 0.9 + 0.01 * index} for index in (1, 2, 3)},
            {},
            Code.AMBIGUOUS,
            (1,),
            "3 of 4",
        ),
        ("travel_bound", {2: {"errors": unsure(centre=0.05)}}, {}, Code.AMBIGUOUS, (2,), "disagree about 2.png"),
        (
            "rotation_bound",
            {2: {"errors": unsure(4.0)}},
            {"median_angle_deg": 2.0},
            Code.BASELINE_TOO_SMALL,
            None,
            "2.0 d",
        ),
    ],
)
def test_what_speaks_most_against_the_poses_is_the_reason(measure, what, whole, code, frames, said):
    seen = evidence((0, 1, 2, 3), what, **whole)
    at = (graph(4, all_pairs(4)), registration((0, 1, 2, 3)))
    given = refused(decide(*at, seen, DecisionConfig(), doubting(measure)), code)
    assert said in given.message and given.frames == names(*(frames or (0, 1, 2, 3)))
    assert decide(*at, evidence((0, 1, 2, 3)), DecisionConfig(), doubting(measure)).code == Code.OK


def test_frames_of_another_size_that_do_not_fit_are_named():
    uncertain = evidence((0, 1, 2, 3), {1: {"inlier_ratio": 0.3}})
    found, doubted = graph(4, all_pairs(4)), doubting("camera_inlier_ratio")
    keyframes = list(found.keyframes)
    smaller = np.zeros((30, 40, 3), np.uint8)
    keyframes[1] = replace(keyframes[1], frame=replace(keyframes[1].frame, image=smaller, intrinsics=None))
    found = replace(found, keyframes=tuple(keyframes))
    given = refused(decide(found, registration((0, 1, 2, 3)), uncertain, DecisionConfig(), doubted), Code.MIXED_CAMERAS)
    assert given.frames == names(1)


def test_most_images_that_refute_a_given_lens_refute_its_calibration():
    for many, code in (((0, 1, 2), Code.FOCAL_SUSPECT), ((1,), Code.OK)):
        lenses = {index: {"refuted_focal": 1.2 if index in many else 1.0} for index in range(4)}
        given = verdict(4, lenses)
        assert given.code == code
        assert ("3 of 4 photographs contradict the lens" in given.message) == (code == Code.FOCAL_SUSPECT)


@pytest.mark.parametrize(("cost", "code"), [(1.05, Code.AMBIGUOUS), (1.2, Code.OK)])
def test_a_scene_that_fits_as_well_mirrored_in_depth_is_ambiguous(cost, code):
    given = decide(
        graph(3, all_pairs(3)), registration((0, 1, 2)), evidence((0, 1, 2), mirrored_cost=cost), DecisionConfig()
    )
    assert given.code == code
    assert ("mirror image of the other in depth" in given.message) == (code == Code.AMBIGUOUS)
