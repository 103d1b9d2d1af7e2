"""Verdicts, each from a view graph, a registration and evidence made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.recon.frames.keyframe import Features, Keyframe
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching import config as matching
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.cycles import Cycles
from splatnode.recon.verification.decision import Config, decide, refuse_before_registration
from splatnode.recon.verification.epipolar_consistency import Score
from splatnode.recon.verification.evidence import CameraEvidence, Evidence
from splatnode.recon.verification.jackknife import Spread
from splatnode.recon.verification.lens import Distortion, FreedLens
from splatnode.recon.verification.reflection import Reflection
from splatnode.recon.verification.weakest_link import WeakestLink

PLAIN, RICH = 20, 2000  # features
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
    return replace(CameraEvidence(f"{index}.png", 1.0, 200, 1.0, FOUND, 0.05, 0.005), **what)


def evidence(
    indices: tuple[int, ...], doubtful: dict[int, dict[str, object]] | None = None, **what: object
) -> Evidence:
    """Evidence for cameras about which there is no doubt, but for `doubtful` ones and `what` concerns all."""
    good = Evidence(
        cameras=tuple(camera(index, **(doubtful or {}).get(index, {})) for index in indices),
        inlier_ratio=1.0,
        weakest_link=WeakestLink((indices[-1],), shared_points=500, matches=200, inliers=200.0, patches=FOUND),
        disconnected=(),
        reflection=Reflection(("0.png",), 0.0),
        flatness=0.5,
        spread=Spread(0.1, 0.005, 0.01),
        mirrored_cost=10.0,
        cycles=Cycles(1, 0.1, 0.1, 0.1),
        median_angle_deg=10.0,
        rms_px=0.3,
        focal_sigma=0.01,
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


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_frames(count):
    given = refused(refuse_before_registration(graph(count, all_pairs(count)), (), Config()), Code.TOO_FEW_VIEWS)
    assert given.frames == names(*range(count)) and str(count) in given.message


@pytest.mark.parametrize(
    ("kept", "codes", "expected"),
    [
        (1, [Code.STATIC_CAMERA] * 4, Code.STATIC_CAMERA),
        (2, [Code.STATIC_CAMERA] * 4, Code.TOO_FEW_VIEWS),
        (0, [Code.BLUR] * 3, Code.BLUR),
        (2, [Code.BLUR] * 2, Code.BLUR),
        (0, [Code.LOW_TEXTURE] * 3, Code.LOW_TEXTURE),
        (1, [Code.BLUR], Code.TOO_FEW_VIEWS),
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


def test_frames_that_stand_still_and_those_that_see_one_plane():
    still = {key: replace(value, points2=value.points1 + 0.01) for key, value in all_pairs(3).items()}
    refused(refuse_before_registration(graph(3, still), (), Config()), Code.STATIC_CAMERA)
    flat = {key: replace(value, num_homography=195) for key, value in all_pairs(3).items()}
    refused(refuse_before_registration(graph(3, flat), (), Config()), Code.PLANAR_ONLY)


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


def test_views_too_close_together():
    given = refused(verdict(3, median_angle_deg=0.8), Code.BASELINE_TOO_SMALL)
    assert "0.8 degrees" in given.message


def test_uncertain_views_of_a_camera_that_hardly_moved_have_turned():
    turning = graph(3, {key: replace(value, num_rotation=150) for key, value in all_pairs(3).items()})
    seen = evidence((0, 1, 2), median_angle_deg=0.8)
    refused(decide(turning, registration((0, 1, 2)), seen, Config()), Code.NO_PARALLAX)


@pytest.mark.parametrize("what", [{"rotation_sigma_deg": 4.0}, {"centre_sigma_rel": 0.1}])
def test_an_uncertain_camera(what):
    refused(verdict(4, {2: what}), Code.BASELINE_TOO_SMALL)


@pytest.mark.parametrize("spread", [Spread(8.0, 0.005, 0.01), Spread(0.1, 0.2, 0.01)])
def test_an_answer_that_hangs_on_one_region_of_the_pictures(spread):
    refused(verdict(4, spread=spread), Code.BASELINE_TOO_SMALL)


def test_centres_that_may_be_wrong_by_more_than_what_counts_as_right():
    """Covariance and what leaving out regions changes are both half of the truth: together they decide."""
    assert verdict(4, spread=Spread(0.1, 0.014, 0.01)).code == Code.OK
    refused(verdict(4, {2: {"centre_sigma_rel": 0.012}}, spread=Spread(0.1, 0.016, 0.01)), Code.BASELINE_TOO_SMALL)


def test_a_focal_length_that_is_not_known_well_enough():
    refused(verdict(3, focal_sigma=0.2), Code.FOCAL_SUSPECT)


def test_matches_that_contradict_each_other():
    given = refused(verdict(3, {2: {"inlier_ratio": 0.45}}, inlier_ratio=0.5), Code.AMBIGUOUS)
    assert given.frames == names(2) and "50 %" in given.message


def test_a_frame_that_poses_as_another_is_told_by_its_pixels():
    """Half of its matches agree; only of a frame that is where it seems to be, the pixels do too."""
    given = refused(verdict(6, {4: {"inlier_ratio": 0.55, "patches": BY_CHANCE}}, inlier_ratio=0.84), Code.AMBIGUOUS)
    assert given.frames == names(4)
    assert verdict(6, {4: {"inlier_ratio": 0.55}}, inlier_ratio=0.84).code == Code.OK
    assert verdict(6, {4: {"patches": BY_CHANCE}}).code == Code.OK  # seen from too far aside to be compared


def test_a_camera_that_nothing_confirms():
    given = refused(verdict(4, {3: {"confirmed": 0}, 1: {"confirmed": 6}}), Code.AMBIGUOUS)
    assert given.frames == names(3)


def test_an_answer_that_is_as_good_as_its_mirror_image():
    given = refused(verdict(3, mirrored_cost=1.0), Code.AMBIGUOUS)
    assert "mirror" in given.message


def test_two_places_that_almost_no_point_joins():
    link = WeakestLink((3, 4), shared_points=3, matches=180, inliers=150.0, patches=BY_CHANCE)
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
    uncertain = evidence((0, 1, 2, 3), spread=Spread(0.1, 0.2, 0.01))
    given = refused(decide(graph(4, all_pairs(4)), mixed, uncertain, Config()), Code.MIXED_CAMERAS)
    assert given.frames == names(1)


def test_different_exposures_are_noted():
    given = verdict(4, {2: {"gain": 0.6}})
    assert given.code == Code.EXPOSURE_SHIFT and given.publishable
    assert given.frames == names(2) and "1.7 times" in given.message


def test_limits_come_from_the_configuration():
    seen = evidence((0, 1, 2), median_angle_deg=0.8)
    assert decide(graph(3, all_pairs(3)), registration((0, 1, 2)), seen, Config(min_angle_deg=0.5)).code == Code.OK
    refused(refuse_before_registration(graph(3, all_pairs(3)), (), Config(min_cameras=4)), Code.TOO_FEW_VIEWS)
