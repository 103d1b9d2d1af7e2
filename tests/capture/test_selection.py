"""Which frames become keyframes: those that add parallax or coverage, and can be used."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.frame import Frame
from splatnode.capture.keyframe_selection import (
    LUCAS_KANADE,
    REMEMBERED_BLURS,
    REMEMBERED_VIEWS,
    Config,
    CornerMotion,
    Limits,
    Selector,
    explain_decision,
    measure,
    track,
)
from tests.support import synthetic

EVERY = Config(max_fps=1000.0, patience_s=0.0)
WALL = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (600, 1200, 3)).astype(np.uint8), (0, 0), 2)
WALL = cv2.normalize(WALL, None, 0, 255, cv2.NORM_MINMAX)


def view(left, index=0, top=100):
    """A camera that slides along a wall."""
    return Frame(index, f"{index}.png", index * 10**8, WALL[top : top + 240, left : left + 320].copy(), None)


def taken(frames, config=EVERY, waiting=0):
    selector = Selector(config, Limits())
    return [selector.decide(frame, waiting) for frame in frames]


def test_a_standing_camera_gives_one_keyframe():
    decisions = taken([view(0, index) for index in range(10)])
    assert [decision.take for decision in decisions] == [True] + 9 * [False]
    assert decisions[0].reason == "first view of this stream"
    assert "adds too little" in decisions[-1].reason and not decisions[-1].candidate


def test_a_sliding_camera_gives_one_whenever_it_has_gone_far_enough():
    decisions = taken([view(4 * index, index) for index in range(60)])
    at = [4 * index for index, decision in enumerate(decisions) if decision.take]
    steps = np.diff(at)
    assert (np.abs(steps - 0.08 * 320) <= 4).all(), at
    assert all("motion: " in decisions[left // 4].reason for left in at[1:])


def test_a_view_of_something_else_is_coverage():
    (_, other) = taken([view(0, 0), view(800, 1)])
    assert other.take and "coverage: 100.0% of the last view is out of the image" in other.reason


def test_a_view_that_was_taken_before_is_a_copy():
    decisions = taken([view(0, 0), view(100, 1), view(0, 2), view(101, 3)])
    assert [decision.take for decision in decisions] == [True, True, False, False]
    assert decisions[2].reason == "duplicate: it shows what 0.png shows" and decisions[2].candidate


def test_a_soft_place_after_a_crisp_one_is_taken_after_a_few_candidates():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    crisp = [replace(view(0, index), image=np.roll(noise, 100 * index, axis=1)) for index in range(3)]
    soft = [
        replace(view(0, 3 + index), image=cv2.GaussianBlur(view(40 * index, 0, 350).image, (0, 0), 3))
        for index in range(REMEMBERED_BLURS + 4)
    ]
    decisions = taken([*crisp, *soft])[len(crisp) :]
    first = next(index for index, decision in enumerate(decisions) if decision.take)
    assert all("sharpest" in decision.reason for decision in decisions[:first]) and 0 < first <= REMEMBERED_BLURS
    assert all(decision.take for decision in decisions[first:])


def test_a_soft_view_of_another_camera_is_taken_at_once():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    soft = cv2.GaussianBlur(view(40, 0, 350).image, (0, 0), 3)
    crisp = replace(view(0, 0), image=noise)
    assert "sharpest" in taken([crisp, replace(view(0, 1), image=soft)])[1].reason
    assert taken([crisp, replace(view(0, 1), image=np.ascontiguousarray(soft[:, :-2]))])[1].take


def test_blurred_candidates_are_waited_out():
    blurred = replace(view(100, 1), image=cv2.GaussianBlur(view(100).image, (0, 0), 9))
    decisions = taken([view(0, 0), blurred, view(104, 2)])
    assert [decision.take for decision in decisions] == [True, False, True]
    assert decisions[1].candidate and ("blur" in decisions[1].reason or "focus" in decisions[1].reason)


def test_not_every_frame_is_examined():
    decisions = taken([replace(view(0, index), stamp_ns=index * 10**7) for index in range(101)], Config(max_fps=10))
    assert sum(decision.reason != "between two examinations" for decision in decisions) == 11


def test_while_recon_is_behind_more_is_asked():
    relaxed = taken([view(4 * index, index) for index in range(60)])
    hurried = taken([view(4 * index, index) for index in range(60)], waiting=EVERY.backlog)
    assert sum(decision.take for decision in hurried) <= 0.6 * sum(decision.take for decision in relaxed)


def test_what_could_not_be_kept_may_be_taken_again():
    selector = Selector(EVERY, Limits())
    assert selector.decide(view(0, 0)).take
    selector.forget_last()
    assert not selector.decide(view(0, 1)).take  # there will be no room in a moment
    assert selector.decide(view(0, 20)).take


def test_a_file_that_came_before_is_not_taken_again_however_long_ago():
    selector = Selector(Config(every_frame=True), Limits())
    first = replace(view(0), encoded=b"a photograph's file")
    assert selector.decide(first).take
    for index in range(1, REMEMBERED_VIEWS + 2):
        selector.decide(view(80 * (index % 11), index, top=60 * (index // 11)))
    assert len(selector._views) == REMEMBERED_VIEWS and first.name not in {each.name for each in selector._views}
    again = selector.decide(replace(first, name="again", stamp_ns=10**12))
    assert not again.take and "came before" in again.reason
    selector.decide(replace(view(1, 90), encoded=b"another"))
    selector.forget_last()
    assert selector.decide(replace(view(1, 95), encoded=b"another", stamp_ns=10**13)).take


def test_photographs_are_taken_unless_they_are_copies():
    config = Config(every_frame=True)
    decisions = taken([view(left, index) for index, left in enumerate([0, 1, 2, 1])], config)
    assert [decision.take for decision in decisions] == [True, True, True, False]


def test_corners_are_tracked_to_where_they_went():
    start, now = (cv2.cvtColor(view(left).image, cv2.COLOR_RGB2GRAY) for left in (0, 12))
    corners = cv2.goodFeaturesToTrack(start, 100, 0.01, 8)
    after, tracked = track(start, now, corners, corners)
    assert tracked.mean() > 0.8
    error = np.linalg.norm((after - corners)[tracked] - (-12, 0), axis=-1)
    assert np.quantile(error, 0.9) < 0.1  # some at the border see what has come in
    assert not tracked[corners[:, 0, 0] < 10].any()  # these have left the image


def test_a_corner_that_has_just_left_the_image_is_lost_though_its_surroundings_are_seen():
    """Lucas and Kanade follow it beside the border, where half of its window still is in the image."""
    start, now = (cv2.cvtColor(view(left).image, cv2.COLOR_RGB2GRAY) for left in (20, 23))
    corners = np.array([[[x, y]] for x in (0.5, 1.0, 1.5, 2.0) for y in range(20, 220, 8)], np.float32)
    guess = corners - np.array([3, 0], np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(start, now, corners, guess.copy(), **LUCAS_KANADE)
    assert found.mean() > 0.3 and (there[..., 0] < 0).mean() > 0.8
    positions, tracked = track(start, now, corners, guess)
    assert not (tracked & (there[:, 0, 0] < 0)).any() and (positions[tracked] >= 0).all()


def test_parallax_is_what_no_homography_explains():
    rng = np.random.default_rng(0)
    corners = rng.uniform(20, 300, (60, 1, 2)).astype(np.float32)
    everything = np.ones(60, bool)
    turned = cv2.perspectiveTransform(corners, np.array([[1.1, 0.1, 5], [-0.1, 1, 3], [1e-4, 0, 1]]))
    assert measure(corners, turned, everything, 320).parallax < 1e-4
    depths = rng.uniform(1, 4, (60, 1, 1)).astype(np.float32)
    moved = corners + np.array([30, 0], np.float32) / depths
    motion = measure(corners, moved, everything, 320)
    assert motion.parallax > 0.005
    assert motion.median == pytest.approx(np.median(30 / depths) / 320, rel=1e-5)
    assert measure(corners, moved, np.arange(60) < 5, 320) == CornerMotion(1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("motion", "what"),
    [
        (CornerMotion(0.3, 0.0, 0.0), "coverage"),
        (CornerMotion(0.0, 0.1, 0.0), "motion"),
        (CornerMotion(0.0, 0.05, 0.02), "parallax"),
        (CornerMotion(0.1, 0.05, 0.005), None),
    ],
)
def test_reasons(motion, what):
    reason, adds = explain_decision(motion, Config())
    assert adds == (what is not None) and reason.startswith(what or "adds too little")
    assert not explain_decision(motion, Config(), strictness=10)[1]


def test_the_built_in_capture_is_taken_whole():
    assert all(decision.take for decision in taken(synthetic.photographs()))


@pytest.mark.parametrize("scene", ["fox", "llff_flower", "tum_fr3_office"])
def test_real_photographs_of_a_walk_are_taken(shared, scene):
    frames = folder.stream(folder.Config(shared / "scenes" / scene / "images", fps=2))
    decisions = taken([frame for frame in frames if isinstance(frame, Frame)][:12])
    assert sum(decision.take for decision in decisions) >= 5
    assert not [decision.reason for decision in decisions if decision.candidate and not decision.take]
