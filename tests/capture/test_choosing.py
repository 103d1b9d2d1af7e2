"""Keyframes of a recording: few where little changes, at most so many, none of them lost without a word."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.keyframe_selection import THINNED, Config, Limits, choose

WALK = synthetic.Config(views=8, width=160, height=120)
FRAMES = 40


@pytest.fixture(scope="module")
def film() -> list[Frame]:
    """A walk along the built-in path, at 8 frames a second."""
    positions = np.linspace(0, WALK.views - 1, FRAMES)
    cameras = [synthetic._camera_on_path(WALK, float(position)) for position in positions]
    return [
        Frame(i, f"{i:03d}.png", i * 125_000_000, synthetic.render_image(WALK, camera, i), intrinsics=None)
        for i, camera in enumerate(cameras)
    ]


def test_keyframes_are_fewer_than_frames_and_every_frame_is_counted(film):
    choice = choose(film, Config(), Limits(), most=30)
    assert 4 <= len(choice.keyframes) <= 20 and choice.keyframes[0].name == "000.png"
    assert sum(choice.taken.values()) == len(choice.keyframes)
    assert sum(choice.left_out.values()) == choice.examined - len(choice.keyframes) == FRAMES - len(choice.keyframes)
    assert str(choice).startswith(f"{len(choice.keyframes)} of {FRAMES} frames are keyframes (1 first view")
    assert choice.record()["keyframes"] == len(choice.keyframes)


def test_more_keyframes_than_asked_for_are_thinned_evenly(film):
    every = choose(film, Config(), Limits(), most=30).keyframes
    choice = choose(film, Config(), Limits(), most=4)
    assert 2 < len(choice.keyframes) <= 4 and choice.left_out[THINNED] > 0
    names = [frame.name for frame in every]
    places = [names.index(frame.name) for frame in choice.keyframes]
    assert len(set(np.diff(places))) == 1 and places[-1] >= len(names) - 4
    assert sum(choice.left_out.values()) == FRAMES - len(choice.keyframes)


def test_what_could_not_be_read_is_named(film):
    lost = DroppedFrame("rest", "damaged")
    choice = choose([*film[:3], lost], Config(), Limits(), most=30)
    assert choice.dropped == (lost,) and choice.examined == 3


def test_of_frames_that_show_the_same_one_is_taken(film):
    still = [Frame(i, f"{i}.png", i * 10**9, film[0].image, intrinsics=None) for i in range(5)]
    choice = choose(still, Config(), Limits(), most=30)
    assert [frame.name for frame in choice.keyframes] == ["0.png"]
