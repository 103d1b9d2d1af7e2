"""Verdicts, each from a view graph, a registration and evidence made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.evaluate.stability.fitting.odds import FOR
from splatnode.recon.frames.keyframe import Features, Keyframe
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching import config as matching
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.claims import claims
from splatnode.recon.verification.cycles import Cycles
from splatnode.recon.verification.decision import Config, decide, refuse_before_registration
from splatnode.recon.verification.epipolar_consistency import Score
from splatnode.recon.verification.errors import Errors, PoseErrors
from splatnode.recon.verification.evidence import CameraEvidence, Evidence
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.lens import Distortion, FreedLens
from splatnode.recon.verification.likelihood import OddsModel
from splatnode.recon.verification.models import Fitted
from splatnode.recon.verification.reflection import Reflection
from splatnode.recon.verification.weakest_link import WeakestLink

PLAIN, RICH = 20, 2000  # features
SURE = PoseErrors(Errors(0.05, 0.05, 0.05), Errors(0.001, 0.001, 0.001))
FOUND, BY_CHANCE = Score(300, 0.8, 0.2), Score(300, 0.2, 0.2)


def keyframe(index: int, num_features: int = RICH, size: tuple[int, int] = (64, 48)) -> Keyframe:
    image = np.zeros((size[1], size[0], 3), np.uint8)
    features = Features(
        points=np.zeros((num_features, 2)),
        descriptors=np.zeros((num_features, 128), np.uint8),
        point_of=np.arange(num_features),
        tilt=np.ones(num_features),
    )
    return Keyframe(Frame(index, f"{index}.png", index, image, None), image, features)


def pair(matches: int = 200, turned: bool = False) -> TwoView:
    return TwoView(
        matches=np.zeros((matches, 2), np.int64),
        points1=np.zeros((matches, 2)),
        points2=np.full((matches, 2), 5.0),
        num_candidates=2 * matches,
        log10_nfa=-100.0,
        num_homography=matches if turned else matches // 2,
        num_rotation=matches if turned else matches // 10,
        focal_ratio=1.0,
        rotation_focal_ratio=1.0,
    )


def graph(num_frames: int, pairs: dict[tuple[int, int], TwoView], plain: tuple[int, ...] = ()) -> ViewGraph:
    keyframes = tuple(keyframe(i, PLAIN if i in plain else RICH) for i in range(num_frames))
    return ViewGraph(matching.Config(), keyframes, pairs)


def all_pairs(num_frames: int, turned: tuple[tuple[int, int], ...] = ()) -> dict[tuple[int, int], TwoView]:
    return {(i, j): pair(turned=(i, j) in turned) for j in range(num_frames) for i in range(j)}


def registration(indices: tuple[int, ...]) -> Registration:
    """Cameras a step apart on a line. What the verdict needs to know of them is in the evidence."""
    cameras = []
    for index in indices:
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.2 * index
        principal, still = np.array([32.0, 24.0]), np.zeros((3, 3))
        cameras.append(RegisteredCamera(index, T_world_camera, 0, 64.0, principal, 0.0, 0.05, 0.005, still))
    return Registration(
        cameras=tuple(cameras),
        points=np.zeros((0, 3)),
        observed_by=np.zeros(0, np.int64),
        observed_point=np.zeros(0, np.int64),
        observed_pixels=np.zeros((0, 2)),
        inlier_ratios={},
        focal_sigma=0.01,
        median_angle_deg=10.0,
        rms_px=0.3,
    )


def camera(index: int, **what: object) -> CameraEvidence:
    """A camera about which there is no doubt, but for `what`."""
    return replace(CameraEvidence(f"{index}.png", 1.0, 200, 0.7, 0.5, 1.0, FOUND, SURE), **what)


def unsure(rotation: float = 0.05, centre: float = 0.001) -> PoseErrors:
    """Errors of these sizes, degrees and in the distance to the scene, as every source says."""
    return PoseErrors(Errors(rotation, rotation, rotation), Errors(centre, centre, centre))


def evidence(
    indices: tuple[int, ...], doubtful: dict[int, dict[str, object]] | None = None, **what: object
) -> Evidence:
    """Evidence for cameras about which there is no doubt, but for `doubtful` ones and `what` concerns all."""
    good = Evidence(
        cameras=tuple(camera(index, **(doubtful or {}).get(index, {})) for index in indices),
        inlier_ratio=1.0,
        weakest_link=WeakestLink((f"{indices[-1]}.png",), shared_points=500, matches=200, inliers=200.0, patches=FOUND),
        disconnected=(),
        reflection=Reflection(("0.png",), -0.2),
        flatness=0.5,
        mirrored_cost=10.0,
        cycles=Cycles(1, 0.1, 0.1, 0.1),
        median_angle_deg=10.0,
        rms_px=0.3,
        focal=Errors(0.01, 0.01, 0.01),
        travel=0.2,
        freed=(),
        distortion=Distortion(0.0, 1.0),
    )
    return replace(good, **what)


def verdict(count: int, doubtful: dict[int, dict[str, object]] | None = None, **what: object) -> Verdict:
    """Of `count` frames that were all placed."""
    indices = tuple(range(count))
    return decide(graph(count, all_pairs(count)), registration(indices), evidence(indices, doubtful, **what), Config())


def refused(given: Verdict | None, code: Code) -> Verdict:
    assert given is not None and given.code == code and not given.publishable
    assert given.message.endswith(".") and given.advice.endswith(".")
    return given


def names(*indices: int) -> tuple[str, ...]:
    return tuple(f"{index}.png" for index in indices)


def test_all_frames_placed_is_ok():
    given = verdict(4)
    assert given.code == Code.OK and given.publishable and given.frames == () and given.advice == ""


def test_frames_left_out_are_named():
    pairs = {key: value for key, value in all_pairs(5).items() if 3 not in key}
    left = (0, 1, 2, 4)
    given = decide(graph(5, pairs), registration(left), evidence(left), Config())
    assert given.code == Code.OUTLIER_VIEW and given.publishable
    assert given.frames == names(3) and "3.png" in given.message
    given = decide(graph(5, all_pairs(5)), registration(left), evidence(left), Config())
    assert given.code == Code.OK_PARTIAL and given.publishable
    assert given.frames == names(3) and "3.png" in given.advice


def test_two_frames_of_somewhere_else_are_a_place():
    pairs = {**all_pairs(3), (3, 4): pair()}
    given = decide(graph(5, pairs), registration((0, 1, 2)), evidence((0, 1, 2)), Config())
    assert given.code == Code.SPLIT and given.publishable and given.frames == names(3, 4)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_frames(count):
    given = refused(refuse_before_registration(graph(count, all_pairs(count)), (), Config()), Code.TOO_FEW_VIEWS)
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
    given = refused(refuse_before_registration(graph(kept, all_pairs(kept)), rejected, Config()), expected)
    assert "that is why" in given.message or expected in (Code.STATIC_CAMERA, Code.LOW_TEXTURE)


def test_frames_without_texture():
    given = refused(refuse_before_registration(graph(4, {}, plain=(0, 2, 3)), (), Config()), Code.LOW_TEXTURE)
    assert given.frames == names(0, 2, 3)


def test_rich_frames_that_do_not_overlap():
    refused(refuse_before_registration(graph(4, {}, plain=(1,)), (), Config()), Code.NO_OVERLAP)


def test_frames_that_stand_still():
    still = {key: replace(value, points2=value.points1 + 0.01) for key, value in all_pairs(3).items()}
    refused(refuse_before_registration(graph(3, still), (), Config()), Code.STATIC_CAMERA)


def test_a_camera_that_only_turned():
    pairs = all_pairs(4, turned=((0, 1), (0, 2), (0, 3), (1, 2), (1, 3)))  # 5 of 6
    given = refused(refuse_before_registration(graph(4, pairs), (), Config()), Code.NO_PARALLAX)
    assert given.frames == names(0, 1, 2, 3) and "5 of 6" in given.message
    assert refuse_before_registration(graph(4, all_pairs(4, turned=((0, 1), (2, 3)))), (), Config()) is None


def test_only_two_frames_that_overlap():
    given = refused(decide(graph(4, {(0, 1): pair()}), registration((0, 1)), None, Config()), Code.NO_OVERLAP)
    assert "2 of 4" in given.message


def test_frames_that_overlap_and_still_cannot_be_placed():
    refused(decide(graph(4, all_pairs(4)), None, None, Config()), Code.NO_OVERLAP)


def test_frames_that_find_no_place_because_of_the_focal_length_that_was_given():
    pairs = {key: replace(view, focal_ratio=1.4) for key, view in all_pairs(4).items()}
    lens = Intrinsics(64, 48, 64.0, 64.0, 32.0, 24.0, "given")
    silent = graph(4, pairs)
    told = replace(
        silent, keyframes=tuple(replace(k, frame=replace(k.frame, intrinsics=lens)) for k in silent.keyframes)
    )
    given = refused(decide(told, None, None, Config()), Code.FOCAL_SUSPECT)
    assert "64 pixels" in given.message and "+40 %" in given.message


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
    refused(verdict(3, freed=(FreedLens(1000.0, False, 1300.0, 1430.0, 0.9),)), Code.FOCAL_SUSPECT)
    assert verdict(3, freed=(FreedLens(1000.0, False, 1420.0, 1430.0, 1.0),)).code == Code.OK  # put right already


def test_a_lens_that_bends_the_picture():
    given = refused(verdict(3, distortion=Distortion(0.1, 0.1)), Code.FOCAL_SUSPECT)
    assert "10 %" in given.message and "coefficients" in given.advice
    assert verdict(3, distortion=Distortion(0.01, 0.5)).code == Code.OK


def flat(count: int) -> ViewGraph:
    return graph(count, {key: replace(value, num_homography=195) for key, value in all_pairs(count).items()})


def turning(count: int) -> ViewGraph:
    return graph(count, {key: replace(value, num_rotation=150) for key, value in all_pairs(count).items()})


WHATEVER_THE_ODDS = Config(min_log_odds=-100.0)
OPEN_FOCAL = Errors(0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    ("graph", "what", "code", "said"),
    [
        (turning, {}, Code.NO_PARALLAX, "a turn explains 75 % of all matches"),
        (turning, {"focal": OPEN_FOCAL}, Code.NO_PARALLAX, "a turn explains"),  # it leaves the focal length open, too
        (flat, {"focal": OPEN_FOCAL}, Code.PLANAR_ONLY, "one plane"),
        (flat, {"median_angle_deg": 2.0}, Code.BASELINE_TOO_SMALL, "under 2.0 degrees"),  # its focal length is known
        (lambda n: graph(n, all_pairs(n)), {"focal": OPEN_FOCAL}, Code.FOCAL_SUSPECT, "focal length is known to"),
        (lambda n: graph(n, all_pairs(n)), {"median_angle_deg": 2.0}, Code.BASELINE_TOO_SMALL, "under 2.0 degrees"),
        (lambda n: graph(n, all_pairs(n)), {}, Code.AMBIGUOUS, "disagree about 2.png"),
    ],
)
def test_bounds_that_are_too_wide_are_refused_for_their_cause(graph, what, code, said):
    seen = evidence((0, 1, 2, 3), {2: {"errors": unsure(rotation=20.0)}}, **what)
    given = refused(decide(graph(4), registration((0, 1, 2, 3)), seen, Config()), code)
    assert said in given.message
    assert ("further to the side" in given.advice) == (code == Code.BASELINE_TOO_SMALL)


def test_a_camera_that_hangs_on_few_points_is_named_with_its_neighbour():
    pairs = {**all_pairs(4), (1, 2): pair(300)}
    seen = evidence((0, 1, 2, 3), {2: {"errors": unsure(centre=0.3), "confirmed": 8}})
    given = refused(decide(graph(4, pairs), registration((0, 1, 2, 3)), seen, Config()), Code.NO_OVERLAP)
    assert given.frames == names(2, 1) and "2.png shares only 8 points" in given.message
    assert given.advice == "Add a photograph between 2.png and 1.png."


@pytest.mark.parametrize("errors", [unsure(rotation=20.0), unsure(centre=0.3)])
def test_what_is_known_of_one_camera_only_roughly_makes_nothing_of_the_others(errors):
    refused(verdict(4, {2: {"errors": errors}}), Code.AMBIGUOUS)


def test_a_rough_scene_is_published_and_says_how_rough_it_is():
    rough = evidence((0, 1, 2, 3), {2: {"errors": unsure(centre=0.01)}})
    given = decide(graph(4, all_pairs(4)), registration((0, 1, 2, 3)), rough, WHATEVER_THE_ODDS)
    assert given.code == Code.OK_ROUGH and given.publishable and given.frames == () and given.advice.endswith(".")
    assert "All 4 frames were placed, roughly: positions are known to" in given.message
    assert "% of the distance to the scene" in given.message and "of how far the camera moved" in given.message
    pairs = {key: value for key, value in all_pairs(5).items() if 3 not in key}
    left = (0, 1, 2, 4)
    rough = evidence(left, {2: {"errors": unsure(rotation=2.0)}})
    given = decide(graph(5, pairs), registration(left), rough, WHATEVER_THE_ODDS)
    assert given.code == Code.OK_ROUGH and given.frames == names(3) and "4 of 5 frames were placed" in given.message


def test_who_requires_more_than_is_known_gets_a_refusal_that_says_what_is_known():
    rough = {2: {"errors": unsure(centre=0.01)}}
    seen = evidence((0, 1, 2, 3), rough)
    positions = max(bounds.centre_percent for bounds in claims(seen, FITTED.many.claims).values())
    given = decide(
        graph(4, all_pairs(4)),
        registration((0, 1, 2, 3)),
        seen,
        Config(require_percent=positions + 0.1, min_log_odds=-100.0),
    )
    assert given.code == Code.OK_ROUGH
    given = decide(
        graph(4, all_pairs(4)),
        registration((0, 1, 2, 3)),
        seen,
        Config(require_percent=positions - 0.1, min_log_odds=-100.0),
    )
    assert f"{positions:.2g} % of the distance" in refused(given, Code.TOO_ROUGH).message


def test_cameras_that_moved_less_than_their_centres_are_uncertain_show_no_depth():
    given = refused(verdict(3, travel=0.001, median_angle_deg=0.3), Code.BASELINE_TOO_SMALL)
    assert "0.3 degrees" in given.message


def doubting(measure: str) -> Fitted:
    """Numbers by which only one measure counts, against the poses where it is worse than in right registrations."""
    term = replace(FITTED.many.odds.terms[measure], slope=30.0 if measure in FOR else -30.0)
    numbers = replace(FITTED.many, odds=OddsModel(2.0, {measure: term}))
    return Fitted(numbers, numbers)


@pytest.mark.parametrize(
    ("measure", "what", "whole", "code", "frames", "said"),
    [
        ("inlier_ratio", {2: {"inlier_ratio": 0.45}}, {"inlier_ratio": 0.5}, Code.AMBIGUOUS, (2,), "50 % of their"),
        ("camera_inlier_ratio", {2: {"inlier_ratio": 0.45}}, {}, Code.AMBIGUOUS, (2,), "of their matches fit"),
        ("confirmed", {3: {"confirmed": 2}, 1: {"confirmed": 60}}, {}, Code.AMBIGUOUS, (3,), "only 2 of its points"),
        ("patches", {1: {"patches": BY_CHANCE, "confirmed": 80}}, {}, Code.AMBIGUOUS, (1,), "could stand elsewhere"),
        (
            "mirrored_cost",
            {},
            {"mirrored_cost": 0.9},
            Code.AMBIGUOUS,
            (0, 1, 2, 3),
            "mirror image of the other in depth",
        ),
        ("reflection", {}, {"reflection": Reflection(("1.png",), 0.3)}, Code.AMBIGUOUS, (1,), "the wrong way round"),
        ("flat_patch", {2: {"coverage": 0.04, "flat_share": 0.99}}, {}, Code.MOVING_SCENE, (2,), "4 % of its picture"),
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
    given = refused(decide(*at, seen, Config(), doubting(measure)), code)
    assert said in given.message and given.frames == names(*(frames or (0, 1, 2, 3)))
    assert decide(*at, evidence((0, 1, 2, 3)), Config(), doubting(measure)).code == Code.OK


def test_two_places_that_almost_no_point_joins():
    link = WeakestLink(names(3, 4), shared_points=3, matches=180, inliers=150.0, patches=BY_CHANCE)
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


def test_frames_through_another_lens_that_do_not_fit_are_named():
    mixed = registration((0, 1, 2, 3))
    mixed = replace(mixed, cameras=tuple(replace(camera, lens=int(camera.index == 1)) for camera in mixed.cameras))
    uncertain = evidence((0, 1, 2, 3), {1: {"inlier_ratio": 0.3, "patches": BY_CHANCE}})
    doubted = doubting("camera_inlier_ratio")
    given = refused(decide(graph(4, all_pairs(4)), mixed, uncertain, Config(), doubted), Code.MIXED_CAMERAS)
    assert given.frames == names(1)


def test_different_exposures_are_noted():
    given = verdict(4, {2: {"gain": 0.6}})
    assert given.code == Code.EXPOSURE_SHIFT and given.publishable
    assert given.frames == names(2) and "1.7 times" in given.message


def test_limits_come_from_the_configuration():
    seen = evidence((0, 1, 2), {1: {"errors": unsure(rotation=12.0)}}, travel=10.0)
    wide = Config(max_rotation_deg=90.0, min_log_odds=-100.0)
    assert decide(graph(3, all_pairs(3)), registration((0, 1, 2)), seen, wide).code == Code.OK_ROUGH
    refused(refuse_before_registration(graph(3, all_pairs(3)), (), Config(min_cameras=4)), Code.TOO_FEW_VIEWS)
