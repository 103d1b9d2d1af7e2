"""Windows are counted, drawn, and run once; rows worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from splatnode.command_line import build_parser
from splatnode.recon.evaluate.stability.claim import CameraError, Claim
from splatnode.recon.evaluate.stability.windows import campaign
from splatnode.recon.evaluate.stability.windows.campaign import Plan, read_rows, run_windows
from splatnode.recon.evaluate.stability.windows.command import report_lines
from splatnode.recon.evaluate.stability.windows.row import Answer, Found, Row
from splatnode.recon.evaluate.stability.windows.summary import coverage, summarise, tally
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.stability_places import three_places

BOUNDS = Claim(rotation_deg=1.0, centre_percent=2.0, focal_percent=4.0)


def camera(number: int, **changes) -> CameraError:
    return replace(CameraError(f"{number}", 0.5, 1.0, 2.0, 3.0, BOUNDS), **changes)


def row(*cameras: CameraError, **changes) -> Row:
    of_window = {"scene": "east", "count": 3, "stride": 1, "start": 0, "names": ("0", "1", "2"), "angle_deg": 6.0}
    said = {"method": "splatnode", "verdict": "OK", "published": True, "message": "", "evidence": None}
    measured = {"seconds": 1.0, "fresh_seconds": None, "rotation_deg": 0.5, "centre_pct": 2.0}
    return Row(**{**of_window, **said, **measured, "cameras": cameras, **changes})


THREE = (camera(0), camera(1), camera(2))
ROWS = [
    row(*THREE),
    row(*THREE[:2], start=1),
    row(*THREE[:2], camera(2, rotation_deg=2.1), start=2),
    row(*THREE[:2], camera(2, rotation_deg=2.6), start=3, angle_deg=20.0),
    row(*THREE, start=4, published=False, verdict="BASELINE_TOO_SMALL"),
    row(start=5, published=False, verdict="NO_OVERLAP"),
    row(start=6, published=False, verdict="FAILED"),
    row(*(camera(i, bounds=None, rotation_deg=4.0) for i in range(3)), method="colmap"),
    row(*(camera(i, bounds=None, rotation_deg=6.0) for i in range(3)), method="colmap", start=1),
]
OUTCOMES = [Found.RIGHT, Found.RIGHT_PART, Found.BETWEEN, Found.WRONG, Found.REFUSED, Found.REFUSED, Found.FAILED]


def test_what_became_of_a_window():
    assert [row.found for row in ROWS] == [*OUTCOMES, Found.BETWEEN, Found.WRONG]
    rough = row(*THREE[:2], camera(2, rotation_deg=6.0, bounds=replace(BOUNDS, rotation_deg=5.0)))
    assert rough.found is Found.WRONG and replace(rough, verdict="OK_ROUGH").found is Found.BETWEEN


def test_tallies():
    found = tally(ROWS[:7])
    assert (found.sets, found.right, found.right_part, found.between, found.wrong) == (7, 1, 1, 1, 1)
    assert (found.refused, found.failed) == (2, 1)
    assert (found.own_right, found.own_right_published) == (2, 1)
    assert (found.own_right_part, found.own_right_part_published) == (1, 1)
    summary = summarise(ROWS)
    assert summary["splatnode"]["by_angle"]["below 8"]["sets"] == 6
    assert summary["splatnode"]["by_angle"]["15 to 25"]["wrong"] == 1
    assert summary["colmap"]["by_count"]["3"]["between"] == 1
    assert any("colmap" in line and "below 8 degrees" in line for line in report_lines(ROWS))


def test_coverage_is_of_published_cameras():
    found = coverage(ROWS[:7])
    assert found.cameras == 11
    assert found.within == {"rotation": 9 / 11, "centre": 1.0, "focal": 1.0}
    assert found.ratio["centre"]["50"] == pytest.approx(0.5)
    assert coverage(ROWS[7:]).within == {"rotation": None, "centre": None, "focal": None}


def test_what_is_on_the_disk_is_not_run_again(tmp_path, monkeypatch):
    places = three_places(tmp_path).walked[:1]
    asked = []

    def answers(place, windows, config, fresh, given_lens):
        for window in windows:
            asked.append(window)
            refusal = Verdict(Code.NO_OVERLAP, "Nothing.", "")
            broken = len(asked) == 1
            yield window, Answer(None if broken else refusal, fresh_seconds=1.0 if fresh else None, message="broken")

    monkeypatch.setattr(campaign.ours, "answers", answers)
    plan = Plan(("splatnode",), counts=(3,))
    rows = run_windows(plan, places, tmp_path, "command")
    assert len(asked) == len(rows) == 8 and rows[0].found is Found.FAILED
    assert run_windows(plan, places, tmp_path, "command")[0].found is Found.REFUSED
    assert len(asked) == 9, "only what had no answer is run again"
    assert all(row.fresh_seconds == 1.0 for row in run_windows(replace(plan, fresh=True), places, tmp_path, "command"))
    assert len(asked) == 17, "seconds from photographs on have to be measured"
    content = json.loads((tmp_path / "windows.json").read_text())
    assert content["summary"]["splatnode"]["all"]["refused"] == 8 and content["command"] == "command"
    assert content["rows"][0]["found"] == "refused" and content["machine"]
    assert len(read_rows(tmp_path / "windows.json")) == 8
    (tmp_path / "windows.json").write_text('{"trials": []}')
    with pytest.raises(ValueError, match=r"must be the windows\.json of this version"):
        read_rows(tmp_path / "windows.json")


def test_charts(tmp_path):
    pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")
    from splatnode.recon.evaluate.stability.windows import charts

    assert charts.draw(ROWS, tmp_path) == ["windows.png", "calibration.png"]
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("windows.png", "calibration.png"))
    assert charts.draw(ROWS[7:], tmp_path) == ["windows.png"], "who claims nothing has no calibration"
    titles = [axes.get_title(loc="left") for axes in charts.figure_of_shares(ROWS).axes]
    assert titles == ["splatnode: 2 of 7 right, 1 wrong", "COLMAP: 0 of 2 right, 1 wrong"]
    labels = [text.get_text() for axes in charts.figure_of_claims(ROWS).axes for text in axes.get_legend().get_texts()]
    assert labels == ["3 views: 82% of 11 cameras within", "3 views: 100% of 11 cameras within"]


def test_command_line():
    args = build_parser().parse_args(["stability", "a", "--windows", "--per-kind", "3", "--fresh", "--out", "o"])
    assert (args.windows, args.per_kind, args.fresh, args.methods) == (True, 3, True, None)
