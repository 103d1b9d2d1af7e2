"""Copies, blank and blurred frames are left out, and named with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.keyframes import ScreeningConfig, screen, summarise
from splatnode.recon.result.verdict import Code
from tests.support.synthetic import blurred, exposed, photographs, renumbered, repeated


def screened(frames):
    return screen([summarise(frame) for frame in frames], ScreeningConfig())


def test_views_of_a_capture_are_all_kept():
    kept, rejected = screened(photographs())
    assert kept == list(range(len(photographs()))) and rejected == []


def test_of_copies_the_first_is_kept_whatever_the_noise():
    grain = np.random.default_rng(0)
    frames = repeated(photographs()[:3], 3)
    noisy = [
        replace(f, image=np.clip(f.image + grain.normal(scale=2.0, size=f.image.shape), 0, 255).astype(np.uint8))
        for f in frames
    ]
    for tried in (frames, noisy):
        kept, rejected = screened(tried)
        assert kept == [0, 3, 6]
        assert [r.name for r in rejected] == [tried[i].name for i in (1, 2, 4, 5, 7, 8)]
        assert all(r.code == Code.STATIC_CAMERA for r in rejected) and tried[0].name in rejected[0].reason


def test_a_blurred_frame_is_left_out_wherever_it_stands():
    for position in (0, 2):
        frames = list(photographs()[:4])
        frames[position] = blurred(frames[position], length=15)
        kept, (rejected,) = screened(frames)
        assert position not in kept and len(kept) == 3
        assert rejected.code == Code.BLUR and rejected.name == frames[position].name


def test_a_soft_frame_of_another_camera_is_kept():
    """The width of edges is compared among frames of one size."""
    crisp, soft = photographs()[0], blurred(photographs()[1], length=15)
    assert screened([crisp, soft])[0] == [0]
    cut = replace(soft, image=np.ascontiguousarray(soft.image[:, :-2]))
    assert screened([crisp, cut]) == ([0, 1], [])


def test_blank_and_black_frames_show_nothing():
    frames = renumbered([np.full((240, 320, 3), 128, np.uint8), np.zeros((240, 320, 3), np.uint8)])
    kept, rejected = screened(frames)
    assert kept == [] and [r.code for r in rejected] == [Code.LOW_TEXTURE] * 2


def test_a_darker_photograph_from_elsewhere_is_no_copy():
    first, second = photographs()[:2]
    kept, _ = screened([first, exposed(second, 0.5)])
    assert kept == [0, 1]
