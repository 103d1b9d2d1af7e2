"""Verdicts, each from a view graph, a registration and evidence made by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.recon.keyframes import Rejected
from splatnode.recon.result.verdict import Code
from splatnode.recon.verification.decision import DecisionConfig, decide, refuse_before_registration
from splatnode.recon.verification.evidence import Reflection, WeakestLink
from splatnode.recon.verification.refit import Distortion, FreedLens
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


def test_all_frames_placed_is_ok():
    given = verdict(4)
    assert given.code == Code.OK and given.publishable and given.frames == () and given.advice == ""


def test_frames_left_out_are_named():
    pairs = {key: value for key, value in all_pairs(5).items() if 3 not in key}
    left = (0, 1, 2, 4)
    given = decide(graph(5, pairs), registration(left), evidence(left), DecisionConfig())
    assert given.code == Code.OUTLIER_VIEW and given.publishable
    assert given.frames == names(3) and "3.png" in given.message
    given = decide(graph(5, all_pairs(5)), registration(left), evidence(left), DecisionConfig())
    assert given.code == Code.OK_PARTIAL and given.publishable
    assert given.frames == names(3) and "3.png" in given.advice


def test_two_frames_of_somewhere_else_are_a_place():
    pairs = {**all_pairs(3), (3, 4): pair()}
    given = decide(graph(5, pairs), registration((0, 1, 2)), evidence((0, 1, 2)), DecisionConfig())
    assert given.code == Code.SPLIT and given.publishable and given.frames == names(3, 4)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_frames(count):
    given = refused(
        refuse_before_registration(graph(count, all_pairs(count)), (), DecisionConfig()), Code.TOO_FEW_VIEWS
    )
    assert given.frames == names(*range(count)) and str(count) in given.message


@pytest.mark.parametrize(
    ("kept", "codes", "expected"),
    [
        (1, [Code.STATIC_CAMERA] * 4, Code.STATIC_CAMERA),
        (0, [Code.BLUR] * 3, Code.BLUR),
        (1, [Code.BLUR] * 2, Code.BLUR),
        (0, [Code.LOW_TEXTURE] * 3, Code.LOW_TEXTURE),
    ],
)
def test_what_the_screening_left_out_is_the_reason(kept, codes, expected):
    rejected = [Rejected(f"r{i}.png", code, "that is why") for i, code in enumerate(codes)]
    given = refused(refuse_before_registration(graph(kept, all_pairs(kept)), rejected, DecisionConfig()), expected)
    assert "that is why" in given.message or expected in (Code.STATIC_CAMERA, Code.LOW_TEXTURE)


def test_frames_without_texture():
    given = refused(refuse_before_registration(graph(4, {}, plain=(0, 2, 3)), (), DecisionConfig()), Code.LOW_TEXTURE)
    assert given.frames == names(0, 2, 3)


def test_rich_frames_that_do_not_overlap():
    refused(refuse_before_registration(graph(4, {}, plain=(1,)), (), DecisionConfig()), Code.NO_OVERLAP)


def test_frames_that_stand_still():
    still = {key: replace(value, points2=value.points1 + 0.01) for key, value in all_pairs(3).items()}
    refused(refuse_before_registration(graph(3, still), (), DecisionConfig()), Code.STATIC_CAMERA)


def test_a_camera_that_only_turned():
    pairs = all_pairs(4, turned=((0, 1), (0, 2), (0, 3), (1, 2), (1, 3)))  # 5 of 6
    given = refused(refuse_before_registration(graph(4, pairs), (), DecisionConfig()), Code.NO_PARALLAX)
    assert given.frames == names(0, 1, 2, 3) and "5 of 6" in given.message
    assert refuse_before_registration(graph(4, all_pairs(4, turned=((0, 1), (2, 3)))), (), DecisionConfig()) is None


def test_only_two_frames_that_overlap():
    given = refused(decide(graph(4, {(0, 1): pair()}), registration((0, 1)), None, DecisionConfig()), Code.NO_OVERLAP)
    assert "2 of 4" in given.message


def test_frames_that_overlap_and_still_cannot_be_placed():
    refused(decide(graph(4, all_pairs(4)), None, None, DecisionConfig()), Code.NO_OVERLAP)


def test_frames_that_find_no_place_because_of_the_focal_length_that_was_given():
    pairs = {key: replace(view, focal_ratio=1.4) for key, view in all_pairs(4).items()}
    lens = Intrinsics(64, 48, 64.0, 64.0, 32.0, 24.0, "given")
    silent = graph(4, pairs)
    told = replace(
        silent, keyframes=tuple(replace(k, frame=replace(k.frame, intrinsics=lens)) for k in silent.keyframes)
    )
    given = refused(decide(told, None, None, DecisionConfig()), Code.FOCAL_SUSPECT)
    assert "64 pixels" in given.message and "+40 %" in given.message
    nominal = replace(lens, source="exif")
    told = replace(
        silent, keyframes=tuple(replace(k, frame=replace(k.frame, intrinsics=nominal)) for k in silent.keyframes)
    )
    given = refused(decide(told, None, None, DecisionConfig()), Code.FOCAL_SUSPECT)
    assert "EXIF tells, 64 pixels" in given.message and "cropped" in given.advice


def test_a_given_focal_length_that_the_frames_contradict_is_named_with_how_much():
    given = refused(verdict(3, freed=(FreedLens(1000.0, True, 1000.0, 1430.0, 0.3),)), Code.FOCAL_SUSPECT)
    assert "1000 pixels" in given.message and "1430" in given.message and "+43 %" in given.message
    assert (
        verdict(3, freed=(FreedLens(1000.0, True, 1000.0, 1010.0, 0.3),)).code == Code.OK
    )  # well within a calibration
    assert verdict(3, freed=(FreedLens(1000.0, True, 1000.0, 1100.0, 0.97),)).code == Code.OK  # nothing gained by it
    assert (
        verdict(3, freed=(FreedLens(1000.0, False, 1030.0, 1100.0, 0.9),)).code == Code.OK
    )  # nominal ones are rounded
    told = refused(verdict(3, freed=(FreedLens(1000.0, False, 1300.0, 1430.0, 0.9),)), Code.FOCAL_SUSPECT)
    assert "EXIF tells, 1000 pixels" in told.message and "cropped" in told.advice  # nobody gave a calibration
    assert verdict(3, freed=(FreedLens(1000.0, False, 1420.0, 1430.0, 1.0),)).code == Code.OK  # put right already


def test_a_lens_that_bends_the_picture():
    given = refused(verdict(3, distortion=Distortion(0.1, 0.1)), Code.FOCAL_SUSPECT)
    assert "10 %" in given.message and "coefficients" in given.advice
    assert verdict(3, distortion=Distortion(0.01, 0.5)).code == Code.OK
    refused(verdict(3, distortion=Distortion(0.02, 0.5)), Code.FOCAL_SUSPECT)  # less, and surely
    assert verdict(3, distortion=Distortion(0.02, 0.7)).code == Code.OK


def test_lenses_that_others_fit_far_better_than_are_refused():
    given = refused(verdict(3, own_lens_cost=0.3), Code.AMBIGUOUS)
    assert "errors fall by 70 %" in given.message
    assert verdict(3, own_lens_cost=0.45).code == Code.OK


def test_two_images_of_two_unknown_lenses_are_refused():
    refused(verdict(2, unknown_lenses=2), Code.FOCAL_SUSPECT)
    assert verdict(2, unknown_lenses=1).publishable and verdict(3, unknown_lenses=3).code == Code.OK


def test_two_places_that_almost_no_point_joins():
    link = WeakestLink(names(3, 4), shared_points=3, matches=180, inliers=150.0)
    given = refused(verdict(5, weakest_link=link), Code.SPLIT)
    assert given.frames == names(3, 4)


def test_frames_that_only_contradicted_matches_join_to_the_others():
    assert refused(verdict(5, disconnected=("4.png",)), Code.SPLIT).frames == names(4)


def test_frames_that_fit_better_mirrored_are_named():
    assert refused(verdict(5, reflection=Reflection(("1.png", "3.png"), 0.5)), Code.AMBIGUOUS).frames == names(1, 3)
    assert verdict(5, reflection=Reflection(("1.png",), 0.25)).code == Code.OK  # a symmetric place


def test_a_flat_thing_that_moves_is_not_taken_for_the_scene():
    given = refused(verdict(4, flatness=1.0, inlier_ratio=0.8), Code.MOVING_SCENE)
    assert "80 %" in given.message
    assert verdict(4, flatness=1.0, inlier_ratio=0.99).code == Code.OK  # a wall, and nothing against it
    assert verdict(4, flatness=0.97, inlier_ratio=0.85).code == Code.OK  # a facade in relief


def test_a_camera_that_shares_one_small_flat_thing_is_refused_whatever_else_fits():
    given = refused(verdict(5, {3: {"coverage": 0.1, "flat_share": 0.98}}), Code.MOVING_SCENE)
    assert given.frames == names(3) and "10 % of its picture" in given.message
    assert verdict(5, {3: {"coverage": 0.3, "flat_share": 0.98}}).publishable
    assert verdict(5, {3: {"coverage": 0.1, "flat_share": 0.7}}).publishable


def test_a_camera_is_refused_whose_matches_fill_little_and_contradict_it():
    given = refused(verdict(5, {3: {"coverage": 0.08, "inlier_ratio": 0.76}}), Code.AMBIGUOUS)
    assert given.frames == names(3) and "fills only 8 % of its picture" in given.message
    assert verdict(5, {3: {"coverage": 0.08, "inlier_ratio": 0.9}}).publishable
    assert verdict(5, {3: {"coverage": 0.14, "inlier_ratio": 0.76}}).publishable


def test_what_two_montages_share_is_no_scene():
    given = refused(verdict(2, shifted_share=0.97), Code.MOVING_SCENE)
    assert "97 %" in given.message and "montages" in given.message
    assert verdict(2, shifted_share=0.5).code == Code.OK


def test_different_exposures_are_noted():
    given = verdict(4, {2: {"gain": 0.6}})
    assert given.code == Code.EXPOSURE_SHIFT and given.publishable
    assert given.frames == names(2) and "1.7 times" in given.message


def test_limits_come_from_the_configuration():
    seen = evidence((0, 1, 2), {1: {"errors": unsure(rotation=12.0)}}, travel=10.0)
    wide = DecisionConfig(max_rotation_deg=90.0, min_log_odds=-100.0)
    assert decide(graph(3, all_pairs(3)), registration((0, 1, 2)), seen, wide).code == Code.OK_ROUGH
    refused(refuse_before_registration(graph(3, all_pairs(3)), (), DecisionConfig(min_cameras=4)), Code.TOO_FEW_VIEWS)
