"""What the stability matrix counts as right, and how it is counted and drawn, worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.stability.campaign import compute_rate, make_report, summarise
from splatnode.extras.evaluate.stability.trial import Demand, Outcome, classify_outcome, score_cameras
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import Bounds, make_ball
from tests.support.stability_places import HEIGHT, WIDTH, K, on_arc


def world(*degrees: float) -> dict[str, TrueCamera]:
    return {f"{value:g}": TrueCamera(on_arc(value), K, WIDTH, HEIGHT) for value in degrees}


def estimated(*degrees: float, turn: float = 0.0) -> list[CameraEstimate]:
    """Estimates of the cameras of `world`, in another frame and scale; the last one is wrong by `turn` degrees."""
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = cv2.Rodrigues(np.array([0.3, -1.0, 0.2]))[0], [4.0, 5.0, 6.0]
    Ts = [moved @ on_arc(value, 6.0) for value in degrees]
    Ts[-1][:3, :3] = Ts[-1][:3, :3] @ cv2.Rodrigues(np.radians([0.0, 0.0, turn]))[0]
    return [CameraEstimate(f"{value:g}", 0, T, K, WIDTH, HEIGHT) for value, T in zip(degrees, Ts, strict=True)]


def test_right_cameras_are_right_in_any_frame_and_scale():
    score = score_cameras(estimated(0, 10, 20), [world(0, 10, 20)])
    assert score.right
    assert score.rotation_error_deg == pytest.approx(0, abs=1e-5)
    assert score.centre_error_pct == pytest.approx(0, abs=1e-5)


def test_a_camera_turned_too_far_is_wrong():
    """By two thirds of the turn: the best common rotation takes the others along."""
    assert score_cameras(estimated(0, 10, 20, turn=2.9), [world(0, 10, 20)]).exact
    between = score_cameras(estimated(0, 10, 20, turn=7.0), [world(0, 10, 20)])
    assert between.right and not between.exact
    wrong = score_cameras(estimated(0, 10, 20, turn=8.0), [world(0, 10, 20)])
    assert not wrong.right and wrong.rotation_error_deg == pytest.approx(8.0)


def test_a_camera_beyond_its_claim_is_wrong():
    cameras = estimated(0, 10, 20, turn=1.5)
    claimed = [replace(camera, bounds=Bounds(0.3, 0.01, 1.0, 1.0, make_ball(0.01))) for camera in cameras]
    assert score_cameras(cameras, [world(0, 10, 20)]).right and not score_cameras(claimed, [world(0, 10, 20)]).right
    roughly = [
        replace(camera, bounds=Bounds(3.0, 0.1, 10.0, 10.0, make_ball(0.1)))
        for camera in estimated(0, 10, 20, turn=8.0)
    ]
    assert not score_cameras(roughly, [world(0, 10, 20)]).right
    assert score_cameras(roughly, [world(0, 10, 20)], rough=True).right


def test_a_camera_without_a_finite_place_is_wrong():
    cameras = estimated(0, 10, 20)
    cameras[1].T_world_camera[0, 3] = np.nan
    assert not score_cameras(cameras, [world(0, 10, 20)]).right


def test_a_centre_too_far_off_is_wrong():
    cameras = estimated(0, 10, 20, 30)
    cameras[1].T_world_camera[:3, 3] += 0.4  # of a spread of 1.2
    assert not score_cameras(cameras, [world(0, 10, 20, 30)]).right


def test_cameras_of_two_worlds_are_no_scene():
    assert score_cameras(estimated(0, 10, 20), [world(0, 10, 20), world(30, 40)]).right
    assert not score_cameras(estimated(0, 10, 20, 30), [world(0, 10, 20), world(30, 40)]).right
    assert not score_cameras(estimated(0, 10, 20, 99), [world(0, 10, 20)]).right, "a frame of no world is in no scene"


def test_what_did_not_move_is_no_scene():
    still = {name: TrueCamera(on_arc(0), K, WIDTH, HEIGHT) for name in ("0", "10", "20")}
    assert not score_cameras(estimated(0, 10, 20), [still]).right
    assert not score_cameras(estimated(0, 10, 20), []).right
    assert not score_cameras([], [still]).right


@pytest.mark.parametrize(
    ("demand", "published", "right", "fits", "expected"),
    [
        (Demand.ACCEPT, True, True, False, Outcome.ACCEPTED),
        (Demand.ACCEPT, False, False, True, Outcome.FALSE_REFUSE),
        (Demand.ACCEPT, True, False, True, Outcome.FALSE_ACCEPT),
        (Demand.REFUSE, True, False, True, Outcome.FALSE_ACCEPT),
        (Demand.REFUSE, True, True, False, Outcome.ACCEPTED),
        (Demand.REFUSE, False, False, True, Outcome.REFUSED),
        (Demand.REFUSE, False, False, False, Outcome.REFUSED_OTHERWISE),
        (Demand.EITHER, False, False, True, Outcome.REFUSED),
        (Demand.EITHER, True, False, True, Outcome.FALSE_ACCEPT),
    ],
)
def test_outcomes(demand, published, right, fits, expected):
    assert classify_outcome(demand, published, right, fits) is expected


def test_wilson_s_interval():
    none = compute_rate(0, 200)
    assert (none.rate, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1.959964**2 / (200 + 1.959964**2))
    half = compute_rate(5, 10)
    assert (half.low, half.high) == (pytest.approx(0.2366, abs=1e-4), pytest.approx(0.7634, abs=1e-4))
    assert compute_rate(7, 7).high == 1.0
    assert compute_rate(0, 0).rate is None


def record(demand: str, found: str, **other) -> dict:
    fields = {"demand": demand, "outcome": found, "published": found in ("accepted", "false_accept")}
    measured = {"seconds": 2.0, "processor_seconds": 1.0, "held": None}
    return {"row": 1, "name": "a", "seed": 0, "method": "splatnode", **fields, **measured, **other}


TRIALS = [
    record("accept", "accepted"),
    record("accept", "accepted", held=False),
    record("accept", "false_accept", held=True),
    record("accept", "false_refuse", seconds=4.0),
    record("accept", "failed", seconds=None, processor_seconds=None),
    record("refuse", "refused", seconds=1.0),
    record("refuse", "refused_otherwise"),
    record("either", "refused"),
    record("either", "false_accept"),
    record("accept", "false_refuse", method="colmap"),
]


def test_rates_of_one_method():
    summary = summarise(TRIALS, "splatnode")
    assert summary.trials == 9
    assert (summary.false_accept.count, summary.false_accept.of) == (2, 9)
    assert (summary.wrong_of_published.count, summary.wrong_of_published.of) == (2, 4)
    assert (summary.false_refuse.count, summary.false_refuse.of) == (2, 5), "no answer is no scene"
    assert (summary.other_code.count, summary.other_code.of) == (1, 3)
    assert (summary.missed_limits.count, summary.missed_limits.of) == (1, 2)
    assert summary.confusion["either"] == {
        **dict.fromkeys((o.value for o in Outcome), 0),
        "refused": 1,
        "false_accept": 1,
    }
    assert summary.seconds_median == 2.0 and summary.refusal_seconds_median == 2.0
    assert summary.processor_seconds_mean == 1.0


def test_the_report_s_rates_are_those_of_the_first_method():
    content = make_report(TRIALS)
    assert content["false_accept_rate"] == pytest.approx(2 / 9)
    assert content["false_refuse_rate"] == pytest.approx(2 / 5)
    assert [method["method"] for method in content["methods"]] == ["splatnode", "colmap"]
    assert make_report([])["false_accept_rate"] is None


def test_the_chart_has_a_cell_for_every_trial(tmp_path):
    pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")
    from splatnode.extras.evaluate.charts import draw_stability, make_stability_figure

    trials = [{**trial, "seed": number % 3, "verdict": f"CODE_{number}"} for number, trial in enumerate(TRIALS)]
    figure = make_stability_figure({"trials": trials, **make_report(trials)})
    shown = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert {f"CODE_{number}" for number in range(len(trials))} <= {text.rstrip(" *") for text in shown}
    assert "CODE_1 *" in shown, "a limit that was missed is marked"
    (tmp_path / "stability.json").write_text(json.dumps({"trials": trials, **make_report(trials)}))
    assert draw_stability(tmp_path / "stability.json", tmp_path).stat().st_size > 10_000
    (tmp_path / "stability.json").write_text(json.dumps({"trials": [], **make_report([])}))
    with pytest.raises(ValueError, match="must have a trial to draw, it has none"):
        draw_stability(tmp_path / "stability.json", tmp_path)
