"""No clock decides over a result, unless somebody asked for a deadline: a busy machine gives what a quiet one does."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.frame import Frame
from splatnode.recon.config import FallbackConfig, ReconstructionConfig
from splatnode.recon.optimize import training
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code
from tests.support.synthetic import SMALL, places

CONFIG = ReconstructionConfig(
    size=160, fallbacks=FallbackConfig(budget=1.0), optimize=training.RefinementConfig(iterations=10, checkpoints=())
)
A_DAY_S = 86400.0


@pytest.fixture
def slow(monkeypatch):
    """Makes the machine slow: between any two looks at the clock a day passes."""

    def begins() -> None:
        clock = itertools.count(float(int(time.monotonic())), A_DAY_S)  # whole seconds: their sums are exact
        monkeypatch.setattr(time, "monotonic", lambda: next(clock))

    return begins


def last(frames: list[Frame]) -> Snapshot:
    *_, final = reconstruct(frames, CONFIG)
    return final


@pytest.mark.parametrize(
    ("seeds", "views", "code"),
    [((0, 1, 2), 3, Code.NO_OVERLAP), ((0, 1), 6, Code.SPLIT)],
    ids=["refused", "with a scene"],
)
def test_photographs_of_several_places_get_the_same_work_and_the_same_result_to_the_bit(seeds, views, code, slow):
    frames = places(replace(SMALL, views=views), seeds)
    quiet = last(frames)
    slow()
    busy = last(frames)
    assert quiet.verdict == busy.verdict and quiet.verdict.code is code
    assert "Also tried: " in quiet.verdict.message
    assert busy.seconds["fallbacks"] >= A_DAY_S > quiet.seconds["fallbacks"]
    for name in ("means", "quats", "scales", "opacities", "sh", "source_frame"):
        assert np.array_equal(getattr(quiet.gaussians, name), getattr(busy.gaussians, name)), name
    for one, other in zip(quiet.cameras, busy.cameras, strict=True):
        assert np.array_equal(one.T_world_camera, other.T_world_camera) and np.array_equal(one.K, other.K)
