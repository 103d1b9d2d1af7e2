"""What is claimed of cameras that a rig alone places, and what the verdict says of the rig."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.rig import FrameSet
from splatnode.recon.registration.rigs import Mount, MountResidual, RigChange, RigEstimate
from splatnode.recon.result.verdict import Bounds, Code, Verdict, make_ball
from splatnode.recon.verification.error_model import compute_placed_bounds, describe_rig

NAMES = ("front_0", "left_0", "front_1", "left_1")
AT = Stamp(0, Clock.RECORDING)
GRAPH = cast(Any, SimpleNamespace(names=list(NAMES)))
SAID = Verdict(Code.OK_PARTIAL, "3 of 4 photographs were placed.", "", frames=("left_1",), publishable=True)


def make_rig(sigma_deg: float = 0.0, sigma: float = 0.0, scatter: tuple[float, float] = (0.0, 0.0)) -> RigEstimate:
    """Two cameras in two frame sets, of which the left one of the second is placed by the rig alone."""
    covariance = np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma**2] * 3)
    front = Mount("front", np.eye(4), np.zeros((6, 6)), (0, 1), given=False)
    left = Mount("left", np.eye(4), covariance, (0,), given=False, scatter=scatter)
    sets = tuple(FrameSet({"front": f"front_{i}", "left": f"left_{i}"}, AT) for i in range(2))
    return RigEstimate((front, left), sets, (), (), None, np.inf, placed=(3,))


def make_registration(apart: float = 0.5) -> Any:
    """Cameras in a row; the left ones stand `apart` from the front ones."""
    cameras = []
    for index in range(4):
        T = np.eye(4)
        T[0, 3], T[1, 3] = index // 2, apart * (index % 2)
        cameras.append(SimpleNamespace(index=index, T_world_camera=T))
    return SimpleNamespace(cameras=tuple(cameras))


def make_bounds(rotation_deg: float, centre: float) -> Bounds:
    return Bounds(rotation_deg, centre, 100 * centre, 1.0, make_ball(centre))


KNOWN = {"front_0": make_bounds(3.0, 0.3), "left_0": make_bounds(1.0, 0.1), "front_1": make_bounds(0.5, 0.02)}


def test_a_placed_camera_is_as_unsure_as_its_set_and_the_rig_together() -> None:
    rig = make_rig(sigma_deg=0.1, sigma=0.01)
    found = compute_placed_bounds(GRAPH, make_registration(), rig, KNOWN)
    assert set(found) == {"left_1"}
    wide = 1.96 * np.sqrt(3)
    assert found["left_1"].rotation_deg == pytest.approx(0.5 + wide * 0.1)
    lever = np.radians(0.5 + wide * 0.1) * 0.5  # a turn of the set moves a camera that stands apart
    assert found["left_1"].centre == pytest.approx(0.02 + wide * 0.01 + lever)
    assert found["left_1"].centre_percent == pytest.approx(100 * found["left_1"].centre)
    assert found["left_1"].focal_percent == 1.0


def test_single_frame_sets_are_as_unsure_as_they_scatter() -> None:
    found = compute_placed_bounds(GRAPH, make_registration(), make_rig(scatter=(np.radians(0.4), 0.03)), KNOWN)[
        "left_1"
    ]
    assert found.rotation_deg >= 0.5 + 1.96 * 0.4 and found.centre >= 0.02 + 1.96 * 0.03


def test_a_set_without_bounds_has_the_widest_of_all() -> None:
    known = {name: each for name, each in KNOWN.items() if name != "front_1"}
    found = compute_placed_bounds(GRAPH, make_registration(0.0), make_rig(), known)
    assert (found["left_1"].rotation_deg, found["left_1"].centre) == (3.0, 0.3)
    assert compute_placed_bounds(GRAPH, make_registration(), make_rig(), {}) == {}


def test_a_verdict_counts_what_the_rig_places_and_does_not_miss_it() -> None:
    said = describe_rig(SAID, GRAPH, make_rig())
    assert said.message.endswith("The rig of 2 cameras places 1 more.")
    assert said.frames == () and said.code is SAID.code


def test_a_verdict_names_a_camera_that_moved_and_one_that_was_given_wrongly() -> None:
    change = RigChange(("left",), first=1, count=1, stamp=AT, degrees=2.9, shift=0.004)
    said = describe_rig(SAID, GRAPH, replace(make_rig(), changes=(change,), refuted=("front",)))
    assert "left from frame set 2 on (1 sets) by 2.9 degrees and 0.4 % of the distance" in said.message
    assert "contradict the given rig, which is not believed there: front is not where" in said.message
    assert "Fasten these cameras" in said.advice and "Calibrate the rig anew" in said.advice
    many = replace(make_rig(), changes=(change,) * 7)
    assert "and 2 more" in describe_rig(SAID, GRAPH, many).message


def test_what_is_not_believed_is_told_with_how_far_it_is_off_and_what_to_do() -> None:
    off = MountResidual("left", "front", degrees=11.6, metres=0.0312, sigma_deg=0.142, sigma_m=0.0021)
    rig = replace(make_rig(), refuted=("front", "left"), residuals=(off,))
    said = describe_rig(SAID, GRAPH, rig)
    assert "left beside front by 12 degrees and 0.031 m, where 0.14 degrees and 0.0021 m are one" in said.message
    assert said.message.endswith("The rig gives no metres.") and "sigma_m and sigma_deg" in said.advice
    said = describe_rig(SAID, GRAPH, replace(rig, is_inverse=True, metres_per_unit=1.0))
    assert "Invert them" in said.advice and "no metres" not in said.message


def test_a_refusal_says_nothing_of_a_rig() -> None:
    refused = replace(SAID, publishable=False)
    assert describe_rig(refused, GRAPH, make_rig()) is refused


def test_names_of_strangers_are_printable() -> None:
    said = describe_rig(SAID, GRAPH, replace(make_rig(), refuted=("le\x1b[2Jft",)))
    assert said.message.isprintable()
