"""Verdicts, each from a view graph and a registration made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture.frame import Frame
from recon.judge import Config, judge
from recon.keyframe import Features, Keyframe
from recon.registration import register
from recon.registration.register import RegisteredCamera, Registration
from recon.registration.two_view import TwoView
from recon.verdict import Code, Verdict
from recon.view_graph import ViewGraph

PLAIN, RICH = 20, 2000  # features


def keyframe(index: int, num_features: int = RICH) -> Keyframe:
    image = np.zeros((48, 64, 3), np.uint8)
    features = Features(
        points=np.zeros((num_features, 2)),
        descriptors=np.zeros((num_features, 128), np.uint8),
        point_of=np.arange(num_features),
        squeeze=np.ones(num_features),
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
    made = ViewGraph(register.Config())
    made.keyframes = [keyframe(i, PLAIN if i in plain else RICH) for i in range(num_frames)]
    made.pairs = pairs
    return made


def all_pairs(num_frames: int, turned: tuple[tuple[int, int], ...] = ()) -> dict[tuple[int, int], TwoView]:
    return {(i, j): pair(turned=(i, j) in turned) for j in range(num_frames) for i in range(j)}


def registration(
    indices: tuple[int, ...],
    agreement: dict[tuple[int, int], float] | None = None,
    median_angle_deg: float = 10.0,
) -> Registration:
    """Cameras a step apart on a line, known to 0.05 degrees and 0.5 % of their spread, that see the same points."""
    num_points = 20
    cameras = []
    for index in indices:
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.2 * index
        cameras.append(RegisteredCamera(index, T_world_camera, 64.0, np.array([32.0, 24.0]), 0.0, 0.05, 0.005))
    return Registration(
        cameras=tuple(cameras),
        points=np.zeros((num_points, 3)),
        observed_by=np.repeat(np.array(indices, np.int64), num_points),
        observed_point=np.tile(np.arange(num_points), len(indices)),
        observed_pixels=np.zeros((num_points * len(indices), 2)),
        focal_sigma=0.01,
        agreement=agreement or {(i, j): 1.0 for j in indices for i in indices if i < j},
        median_angle_deg=median_angle_deg,
        rms_px=0.3,
    )


def refused(verdict: Verdict, code: Code) -> Verdict:
    assert verdict.code == code and not verdict.publishable
    assert verdict.message.endswith(".") and verdict.advice.endswith(".")
    return verdict


def names(*indices: int) -> tuple[str, ...]:
    return tuple(f"{index}.png" for index in indices)


def test_all_frames_placed_is_ok():
    verdict = judge(graph(4, all_pairs(4)), registration((0, 1, 2, 3)), Config())
    assert verdict.code == Code.OK and verdict.publishable and verdict.frames == () and verdict.advice == ""


def test_frames_left_out_are_named():
    pairs = {key: value for key, value in all_pairs(5).items() if 3 not in key}
    verdict = judge(graph(5, pairs), registration((0, 1, 2, 4)), Config())
    assert verdict.code == Code.OUTLIER_VIEW and verdict.publishable
    assert verdict.frames == names(3) and "3.png" in verdict.message


def test_frames_that_overlap_but_could_not_be_placed_are_named():
    verdict = judge(graph(5, all_pairs(5)), registration((0, 1, 2, 4)), Config())
    assert verdict.code == Code.OK_PARTIAL and verdict.publishable
    assert verdict.frames == names(3) and "3.png" in verdict.advice


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_frames(count):
    verdict = refused(judge(graph(count, all_pairs(count)), None, Config()), Code.TOO_FEW_VIEWS)
    assert verdict.frames == names(*range(count)) and str(count) in verdict.message


def test_frames_without_texture():
    verdict = refused(judge(graph(4, {}, plain=(0, 2, 3)), None, Config()), Code.LOW_TEXTURE)
    assert verdict.frames == names(0, 2, 3)


def test_rich_frames_that_do_not_overlap():
    refused(judge(graph(4, {}, plain=(1,)), None, Config()), Code.NO_OVERLAP)


def test_only_two_frames_that_overlap():
    verdict = refused(judge(graph(4, {(0, 1): pair()}), registration((0, 1)), Config()), Code.NO_OVERLAP)
    assert "2 of 4" in verdict.message


def test_frames_that_overlap_and_still_cannot_be_placed():
    refused(judge(graph(4, all_pairs(4)), None, Config()), Code.NO_OVERLAP)


def test_a_camera_that_only_turned_before_anything_is_said_about_its_places():
    pairs = all_pairs(4, turned=((0, 1), (0, 2), (0, 3), (1, 2), (1, 3)))  # 5 of 6
    for found in (None, registration((0, 1, 2, 3))):
        verdict = refused(judge(graph(4, pairs), found, Config()), Code.NO_PARALLAX)
        assert verdict.frames == names(0, 1, 2, 3) and "5 of 6" in verdict.message


def test_some_pairs_without_parallax_do_no_harm():
    pairs = all_pairs(4, turned=((0, 1), (2, 3)))
    assert judge(graph(4, pairs), registration((0, 1, 2, 3)), Config()).code == Code.OK


def test_views_too_close_together():
    found = registration((0, 1, 2), median_angle_deg=0.8)
    verdict = refused(judge(graph(3, all_pairs(3)), found, Config()), Code.BASELINE_TOO_SMALL)
    assert "0.8" in verdict.message


def test_matches_that_contradict_each_other():
    found = registration((0, 1, 2), agreement={(0, 1): 1.0, (0, 2): 0.9, (1, 2): 0.1})
    verdict = refused(judge(graph(3, all_pairs(3)), found, Config()), Code.AMBIGUOUS)
    assert set(names(1, 2)) <= set(verdict.frames)


@pytest.mark.parametrize("what", [{"rotation_sigma_deg": 2.0}, {"centre_sigma_rel": 0.2}])
def test_an_uncertain_camera(what):
    found = registration((0, 1, 2, 3))
    cameras = tuple(replace(camera, **what) if camera.index == 2 else camera for camera in found.cameras)
    verdict = refused(judge(graph(4, all_pairs(4)), replace(found, cameras=cameras), Config()), Code.BASELINE_TOO_SMALL)
    assert verdict.frames == names(2)


def test_limits_come_from_the_configuration():
    found = registration((0, 1, 2), median_angle_deg=0.8)
    assert judge(graph(3, all_pairs(3)), found, Config(min_angle_deg=0.5)).code == Code.OK
    refused(judge(graph(3, all_pairs(3)), registration((0, 1, 2)), Config(min_cameras=4)), Code.TOO_FEW_VIEWS)


def groups_joined_by_chance() -> tuple[ViewGraph, Registration]:
    """Two places of three views each: what joins them is few matches, half of which the cameras contradict."""
    pairs = {key: pair(1800) for key in ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))}
    joints = {(0, 3): pair(37), (2, 3): pair(46), (2, 4): pair(51)}
    agreement = dict.fromkeys(pairs, 1.0) | {(0, 3): 0.46, (2, 3): 0.61, (2, 4): 0.71}
    return graph(6, pairs | joints), registration((0, 1, 2, 3, 4, 5), agreement)


def test_groups_of_views_that_only_contradicting_pairs_join_are_not_one_scene():
    refused(judge(*groups_joined_by_chance(), Config()), Code.SPLIT)
