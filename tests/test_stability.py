"""The stability matrix: what counts as right and how it is counted, worked out by hand."""

from __future__ import annotations

import argparse
import json
import os
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.frame import Frame
from recon.evaluate.stability import campaign
from recon.evaluate.stability.campaign import Plan, run_campaign
from recon.evaluate.stability.case import Case, Demand, Row
from recon.evaluate.stability.matrix import ROWS, chosen
from recon.evaluate.stability.methods import by_name
from recon.evaluate.stability.outcome import Outcome, compare, outcome
from recon.evaluate.stability.places import Place, Places, Stage, far_apart, load_places, motion, neighbours, parallel
from recon.evaluate.stability.summary import rate, report, summarise
from recon.evaluate.stability.trial import Trial, run_trial
from recon.evaluate.truth import EvaluationScene, TrueCamera
from recon.snapshot import CameraEstimate
from recon.verdict import Code
from splatnode import build_parser

K = np.array([[200.0, 0.0, 120.0], [0.0, 200.0, 90.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 240, 180


def on_arc(degrees: float, distance: float = 3.0) -> np.ndarray:
    """A camera (4, 4) on an arc around the origin, which it looks at."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    T_world_camera[:3, 3] = -distance * T_world_camera[:3, 2]
    return T_world_camera


def world(*degrees: float) -> dict[str, TrueCamera]:
    return {f"{value:g}": TrueCamera(on_arc(value), K, WIDTH, HEIGHT) for value in degrees}


def estimated(*degrees: float, turn: float = 0.0) -> list[CameraEstimate]:
    """Estimates of the cameras of `world`, in another frame and scale; the last one is wrong by `turn` degrees."""
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = cv2.Rodrigues(np.array([0.3, -1.0, 0.2]))[0], [4.0, 5.0, 6.0]
    Ts = [moved @ on_arc(value, 6.0) for value in degrees]
    Ts[-1][:3, :3] = Ts[-1][:3, :3] @ cv2.Rodrigues(np.radians([0.0, 0.0, turn]))[0]
    return [
        CameraEstimate(f"{value:g}", 0, T, K, WIDTH, HEIGHT, None, None) for value, T in zip(degrees, Ts, strict=True)
    ]


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> Places:
    """Three places of twelve photographs each, 6 degrees apart; pixels without a meaning."""
    folder = tmp_path_factory.mktemp("places")
    rng = np.random.default_rng(0)
    made = []
    for name in ("east", "south", "west"):
        names = tuple(f"{i:02d}.png" for i in range(12))
        for image_name in names:
            small = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
            image = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
            (folder / name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / name / image_name), image)
        cameras = {n: TrueCamera(on_arc(6.0 * i), K, WIDTH, HEIGHT) for i, n in enumerate(names)}
        scene = EvaluationScene(name, {n: folder / name / n for n in names}, cameras)
        made.append(Place(scene, names))
    return Places(tuple(made))


# --- right or wrong


def test_right_cameras_are_right_in_any_frame_and_scale():
    score = compare(estimated(0, 10, 20), [world(0, 10, 20)])
    assert score.right
    assert score.rotation_error_deg == pytest.approx(0, abs=1e-5)
    assert score.centre_error_pct == pytest.approx(0, abs=1e-5)


def test_a_camera_turned_too_far_is_wrong():
    assert compare(estimated(0, 10, 20, turn=1.9), [world(0, 10, 20)]).right
    wrong = compare(estimated(0, 10, 20, turn=2.1), [world(0, 10, 20)])
    assert not wrong.right and wrong.rotation_error_deg == pytest.approx(2.1)


def test_a_centre_too_far_off_is_wrong():
    cameras = estimated(0, 10, 20, 30)
    cameras[1].T_world_camera[:3, 3] += 0.05  # of a spread of 1.2
    assert not compare(cameras, [world(0, 10, 20, 30)]).right


def test_cameras_of_two_worlds_are_no_scene():
    assert compare(estimated(0, 10, 20), [world(0, 10, 20), world(30, 40)]).right
    assert not compare(estimated(0, 10, 20, 30), [world(0, 10, 20), world(30, 40)]).right
    assert not compare(estimated(0, 10, 20, 99), [world(0, 10, 20)]).right, "a frame of no world is in no scene"


def test_what_did_not_move_is_no_scene():
    still = {name: TrueCamera(on_arc(0), K, WIDTH, HEIGHT) for name in ("0", "10", "20")}
    assert not compare(estimated(0, 10, 20), [still]).right
    assert not compare(estimated(0, 10, 20), []).right
    assert not compare([], [still]).right


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
    assert outcome(demand, published, right, fits) is expected


# --- counting


def test_wilson_s_interval():
    none = rate(0, 200)
    assert (none.rate, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1.959964**2 / (200 + 1.959964**2))
    half = rate(5, 10)
    assert (half.low, half.high) == (pytest.approx(0.2366, abs=1e-4), pytest.approx(0.7634, abs=1e-4))
    assert rate(7, 7).high == 1.0
    assert rate(0, 0).rate is None


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
    content = report(TRIALS)
    assert content["false_accept_rate"] == pytest.approx(2 / 9)
    assert content["false_refuse_rate"] == pytest.approx(2 / 5)
    assert [method["method"] for method in content["methods"]] == ["splatnode", "colmap"]
    assert report([])["false_accept_rate"] is None


# --- places and rows


def test_how_a_camera_moved():
    assert motion(np.stack([on_arc(i) for i in range(4)])) == "walked"
    assert motion(np.stack([on_arc(0, 3.0 + i) for i in range(4)])) == "forward"
    assert motion(np.stack([on_arc(i, 0.0) for i in range(4)])) == "turned"


def test_neighbours_are_as_far_apart_as_they_may_be():
    every_3 = np.stack([on_arc(3.0 * i) for i in range(12)])
    assert neighbours(every_3, 3, 12.5) == ([0, 1, 2, 3], 4)
    assert neighbours(every_3, 3, 7.0)[1] == 2
    every_18 = np.stack([on_arc(18.0 * i) for i in range(5)])
    assert neighbours(every_18, 4, 12.0) == ([0, 1], 1), "within what overlaps, where none are as close"
    assert neighbours(np.stack([on_arc(30.0 * i) for i in range(5)]), 3, 12.0) == ([], 1)


def test_seeds_take_turns_through_the_places(places):
    stages = [Stage(places, "a row", seed) for seed in range(3)]
    assert {stage.photos(3)[0].place for stage in stages} == {"east", "south", "west"}
    for stage in stages:
        here = stage.photos(3)
        (elsewhere,) = stage.photos(1, here)
        assert elsewhere.place != here[0].place
        assert len({photo.place for photo in stage.one_of_each(5)}) == 3
    with pytest.raises(ValueError, match="row 'a row' needs a place with 13 photographs"):
        stages[0].photos(13)


def test_parallel_views_do_not_turn():
    def sideways(turn: float) -> np.ndarray:
        Ts_world_camera = np.stack([on_arc(turn * i) for i in range(6)])
        Ts_world_camera[:, :3, 3] = [[0.1 * i, 0.0, 0.0] for i in range(6)]
        return Ts_world_camera

    assert parallel(sideways(1.0), 3) == ([0, 1], 2), "at a stride of 4 they do not fit in"
    assert neighbours(sideways(1.0), 3, 12.0) == ([], 1)
    assert parallel(sideways(9.0), 3) == ([], 1) and neighbours(sideways(9.0), 3, 12.0)[0]


def test_views_far_apart(places):
    rng = np.random.default_rng(0)
    found = far_apart(places.walked[0], 3, 11.9, rng)
    assert found is not None and np.diff(found).min() >= 2
    assert far_apart(places.walked[0], 3, 60.0, rng) is None


def test_a_folder_that_is_no_scene_is_a_clear_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold the scene's images"):
        load_places([tmp_path], tmp_path)


def test_every_number_has_a_row_and_every_row_a_name_of_its_own():
    assert {row.number for row in ROWS} == set(range(1, 31))
    names = [(row.number, row.name) for row in ROWS]
    assert len(set(names)) == len(names)
    assert {row.number for row in chosen((7, 14))} == {7, 14}
    assert chosen(()) == ROWS
    with pytest.raises(ValueError, match="no row 31; there are 1 to 30"):
        chosen((31,))


# Rows that photograph the built-in place at full size, or write large files, would take as long as all others.
SLOW = {"tiny baseline", "forward motion", "clean, parallel views", "a huge file"}


@pytest.mark.parametrize("row", [row for row in ROWS if row.name not in SLOW], ids=lambda r: r.name)
def test_rows_make_the_same_case_again(row, places):
    first, again = (row.make(Stage(places, row.name, 1)) for _ in range(2))
    given, same = list(first.source()), list(again.source())
    assert len(given) > 0 and len({frame.name for frame in given}) == len(given)
    frames = [frame for frame in given if isinstance(frame, Frame)]
    for frame, twin in zip(given, same, strict=True):
        assert frame.name == twin.name and type(frame) is type(twin)
        if isinstance(frame, Frame) and isinstance(twin, Frame):
            assert np.array_equal(frame.image, twin.image)
    assert first.codes and first.note
    names = {frame.name for frame in frames}
    assert all(set(known) <= names for known in first.worlds)
    if first.demand is Demand.ACCEPT:
        assert sum(map(len, first.worlds)) >= 3


# --- trials


def hang() -> list[Frame]:
    time.sleep(600)
    return []


def one_frame() -> list[Frame]:
    return [Frame(0, "only", 0, np.zeros((48, 64, 3), np.uint8), None)]


def case(source) -> Case:
    return Case("a note", source, Demand.REFUSE, frozenset({Code.TOO_FEW_VIEWS}))


def test_a_trial_ends_whatever_happens_in_it():
    run = partial(run_trial, row=4, name="single", seed=0, method="splatnode")
    refused = run(case(one_frame), timeout_s=60.0)
    assert (refused.verdict, refused.outcome, refused.right) == ("TOO_FEW_VIEWS", "refused", True)
    assert refused.seconds is not None and refused.peak_rss_mb is not None
    hangs = run(case(hang), timeout_s=0.5)
    assert (hangs.verdict, hangs.outcome, hangs.message) == ("FAILED", "failed", "stopped after 0.5 s")
    crashes = run(case(partial(os._exit, 9)), timeout_s=60.0)
    assert crashes.outcome == "failed" and "ended with code 9" in crashes.message
    raises = run(case(partial(int, "x")), timeout_s=60.0)
    assert raises.outcome == "failed" and "ValueError" in raises.message


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path, places, monkeypatch):
    tried = []

    def fake(case, row, name, seed, method, timeout_s):
        tried.append((row, seed))
        return Trial(
            row=row,
            name=name,
            seed=seed,
            method=method,
            note=case.note,
            demand="refuse",
            expected=("TOO_FEW_VIEWS",),
            verdict="TOO_FEW_VIEWS",
            published=False,
            right=True,
            outcome="refused",
        )

    monkeypatch.setattr(campaign, "run_trial", fake)
    rows = tuple(Row(number, "quick", lambda stage: case(one_frame)) for number in (1, 2))
    run_campaign(Plan(rows, (0,), ("splatnode",)), places, tmp_path, "command")
    assert tried == [(1, 0), (2, 0)]
    trials = run_campaign(Plan(rows, (0, 1), ("splatnode",), jobs=2), places, tmp_path, "command")
    assert sorted(tried[2:]) == [(1, 1), (2, 1)] and len(trials) == 4
    content = json.loads((tmp_path / "stability.json").read_text())
    assert [(t["row"], t["seed"]) for t in content["trials"]] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert content["false_accept_rate"] == 0.0 and content["false_refuse_rate"] is None
    elsewhere = Places(places.walked[:1])
    with pytest.raises(ValueError, match="is of the scenes east, south, west, now there are east"):
        run_campaign(Plan(rows, (0,), ("splatnode",)), elsewhere, tmp_path, "command")


def test_the_chart_has_a_cell_for_every_trial(tmp_path):
    pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")
    from recon.evaluate.stability.chart import draw, figure_of

    trials = [{**trial, "seed": number % 3, "verdict": f"CODE_{number}"} for number, trial in enumerate(TRIALS)]
    figure = figure_of({"trials": trials, **report(trials)})
    shown = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert {f"CODE_{number}" for number in range(len(trials))} <= {text.rstrip(" *") for text in shown}
    assert "CODE_1 *" in shown, "a limit that was missed is marked"
    (tmp_path / "stability.json").write_text(json.dumps({"trials": trials, **report(trials)}))
    assert draw(tmp_path / "stability.json", tmp_path).stat().st_size > 10_000
    (tmp_path / "stability.json").write_text(json.dumps({"trials": [], **report([])}))
    with pytest.raises(ValueError, match="must have a trial to draw, it has none"):
        draw(tmp_path / "stability.json", tmp_path)


def test_command_line():
    parse = build_parser().parse_args
    args = parse(
        ["stability", "a", "b", "--rows", "1,7", "--seeds", "2", "--methods", "splatnode,colmap", "--out", "o"]
    )
    assert (args.scenes, args.rows, args.seeds) == ([Path("a"), Path("b")], (1, 7), 2)
    assert args.methods == ("splatnode", "colmap") and args.jobs == 1
    assert isinstance(args, argparse.Namespace)
    with pytest.raises(ValueError, match="no method 'magic'; there are: splatnode, colmap, glomap"):
        by_name("magic")
