"""Windows are counted, drawn, and run once; rows worked out by hand."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from splatnode.capture.cameras import synthetic
from splatnode.command_line import build_parser
from splatnode.extras.evaluate.dataset import load_scene, write_capture
from splatnode.extras.evaluate.stability import window_campaign
from splatnode.extras.evaluate.stability.perturbations import TrialScene
from splatnode.extras.evaluate.stability.trial import CameraError, FiniteBounds
from splatnode.extras.evaluate.stability.window_campaign import (
    Plan,
    format_report,
    measure_coverage,
    print_report,
    read_rows,
    run_windows,
    summarise,
    tally_rows,
)
from splatnode.extras.evaluate.stability.windows import Window, WindowAnswer, WindowOutcome, WindowRow
from splatnode.extras.jobs import engine, usable_cores
from splatnode.recon.result.verdict import Code, Verdict
from tests.support.calls import in_this_process
from tests.support.stability_places import three_places
from tests.support.trials import without_costs

BOUNDS = FiniteBounds(rotation_deg=1.0, centre_percent=2.0, focal_percent=4.0)


def camera(number: int, **changes) -> CameraError:
    return replace(CameraError(f"{number}", 0.5, 1.0, 2.0, 3.0, BOUNDS), **changes)


def row(*cameras: CameraError, **changes) -> WindowRow:
    of_window = {"scene": "east", "count": 3, "stride": 1, "start": 0, "names": ("0", "1", "2"), "angle_deg": 6.0}
    said = {"method": "splatnode", "verdict": "OK", "published": True, "message": "", "evidence": None}
    measured = {"seconds": 1.0, "fresh_seconds": None, "rotation_deg": 0.5, "centre_pct": 2.0}
    return WindowRow(**{**of_window, **said, **measured, "cameras": cameras, **changes})


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
OUTCOMES = [
    WindowOutcome.RIGHT,
    WindowOutcome.RIGHT_PART,
    WindowOutcome.BETWEEN,
    WindowOutcome.WRONG,
    WindowOutcome.REFUSED,
    WindowOutcome.REFUSED,
    WindowOutcome.FAILED,
]


def test_what_became_of_a_window():
    assert [row.outcome for row in ROWS] == [*OUTCOMES, WindowOutcome.BETWEEN, WindowOutcome.WRONG]
    rough = row(*THREE[:2], camera(2, rotation_deg=6.0, bounds=replace(BOUNDS, rotation_deg=5.0)))
    assert rough.outcome is WindowOutcome.WRONG and replace(rough, verdict="OK_ROUGH").outcome is WindowOutcome.BETWEEN


def test_tallies():
    found = tally_rows(ROWS[:7])
    assert (found.sets, found.right, found.right_part, found.between, found.wrong) == (7, 1, 1, 1, 1)
    assert (found.refused, found.failed) == (2, 1)
    assert (found.own_right, found.own_right_published) == (2, 1)
    assert (found.own_right_part, found.own_right_part_published) == (1, 1)
    summary = summarise(ROWS)
    assert summary["splatnode"]["by_angle"]["below 8"]["sets"] == 6
    assert summary["splatnode"]["by_angle"]["15 to 25"]["wrong"] == 1
    assert summary["colmap"]["by_count"]["3"]["between"] == 1
    assert any("colmap" in line and "below 8 degrees" in line for line in format_report(ROWS))


def test_coverage_is_of_published_cameras():
    found = measure_coverage(ROWS[:7])
    assert found.cameras == 11
    assert found.within == {"rotation": 9 / 11, "centre": 1.0, "focal": 1.0}
    assert found.ratio["centre"]["50"] == pytest.approx(0.5)
    assert measure_coverage(ROWS[7:]).within == {"rotation": None, "centre": None, "focal": None}


NOTHING = Verdict(Code.NO_OVERLAP, "Nothing.", "")


def note(place: TrialScene, window: Window) -> list[str]:
    """The windows that were asked for so far, by their start and stride, in a file beside the scene."""
    path = place.scene.paths[window.names[0]].parents[1] / "asked.txt"
    with path.open("a") as file:
        file.write(f"{window.start} {window.stride}\n")
    return path.read_text().splitlines()


def first_broken(place, window, config, fresh, told, known):
    if len(note(place, window)) == 1:
        raise ValueError("worse luck")
    return WindowAnswer(NOTHING, seconds=1.0, fresh_seconds=1.0 if fresh else None), {}


def test_what_is_on_the_disk_is_not_run_again(tmp_path, monkeypatch):
    places, on = three_places(tmp_path).walked[:1], in_this_process()
    monkeypatch.setattr(window_campaign, "reconstruct_window", first_broken)
    plan = Plan(("splatnode",), counts=(3,))

    def asked() -> int:
        return len((tmp_path / "asked.txt").read_text().splitlines())

    rows = run_windows(plan, places, tmp_path, "command", on)
    assert asked() == len(rows) == 8 and rows[0].outcome is WindowOutcome.FAILED and rows[0].message == "worse luck"
    assert run_windows(plan, places, tmp_path, "command", on)[0].outcome is WindowOutcome.REFUSED
    assert asked() == 9, "only what had no answer is run again"
    rows = run_windows(replace(plan, fresh=True), places, tmp_path, "command", on)
    assert all(row.fresh_seconds == 1.0 for row in rows)
    assert asked() == 17, "seconds from photographs on have to be measured"
    content = json.loads((tmp_path / "windows.json").read_text())
    assert content["summary"]["splatnode"]["all"]["refused"] == 8 and content["command"] == "command"
    assert content["rows"][0]["found"] == "refused" and content["machine"]
    assert read_rows(tmp_path / "windows.json") == rows
    with pytest.raises(ValueError, match="holds runs that had .* now each would have 77 cores"):
        run_windows(plan, places, tmp_path, "command", in_this_process(cores_each=77))
    (tmp_path / "windows.json").write_text('{"trials": []}')
    with pytest.raises(ValueError, match=r"must be the windows\.json of this version"):
        read_rows(tmp_path / "windows.json")


def test_windows_with_a_given_lens_and_without_are_not_mixed(tmp_path, monkeypatch):
    places, on = three_places(tmp_path).walked[:1], in_this_process()
    monkeypatch.setattr(window_campaign, "reconstruct_window", first_broken)
    plan, as_it_works = Plan(("splatnode",), per_kind=1, counts=(3,)), []

    def noted(take, limits, folder):
        as_it_works.append((tmp_path / "windows.json").read_bytes())
        yield from on.answers(take, limits, folder)

    rows = run_windows(plan, places, tmp_path, "command", replace(on, answers=noted))
    assert json.loads(as_it_works[0])["told"] == "nothing", "the file says of what the journal is"
    before = (tmp_path / "windows.json").read_bytes()
    with pytest.raises(ValueError, match=r"windows\.json holds windows with --known-lens nothing"):
        run_windows(replace(plan, lens_setting="given"), places, tmp_path, "command", on)
    assert (tmp_path / "windows.json").read_bytes() == before
    (tmp_path / "windows.json").write_bytes(as_it_works[0])  # as a killed process leaves it: all is in the journal
    (tmp_path / "windows.jsonl").write_text(f"{json.dumps(json.loads(before)['rows'][1])}\n")
    with pytest.raises(ValueError, match="with --known-lens nothing"):
        run_windows(replace(plan, lens_setting="given"), places, tmp_path, "command", on)
    assert run_windows(plan, places, tmp_path, "command", on)[1] == rows[1]


def befallen(place, window, config, fresh, told, known):
    """What befalls a window is told by its stride: 1 raises, 2 ends its process, 3 hangs."""
    if window.stride == 1:
        raise FloatingPointError("worse luck")
    if window.stride == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if window.stride == 3:
        time.sleep(600)
    return WindowAnswer(NOTHING), {}


def test_a_window_that_fails_costs_only_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(window_campaign, "reconstruct_window", befallen)
    plan = Plan(("splatnode",), per_kind=1, counts=(3,), timeout_s=1.5)
    with engine(1, None) as on:
        rows = run_windows(plan, three_places(tmp_path).walked[:1], tmp_path, "command", on)
    assert [row.outcome for row in rows] == [WindowOutcome.FAILED] * 3 + [WindowOutcome.REFUSED]
    raised, died, hung, _ = (row.message for row in rows)
    assert "FloatingPointError: worse luck" in raised and "was killed (SIGKILL)" in died
    assert hung == "took longer than the 1.5 s that --timeout-s allows"
    print_report(rows)
    assert "no answer: east, 3 at stride 1 from" in capsys.readouterr().out


DRIVER = """
import sys
from pathlib import Path
from splatnode.extras.jobs import engine
from tests.extras.evaluate.stability.windows.test_campaign import third_slow_at_first
with engine(1, None) as on:
    third_slow_at_first(Path(sys.argv[1]), on)
"""


def slow(place, window, config, fresh, told, known):
    if len(note(place, window)) == 3:
        time.sleep(600)
    return WindowAnswer(NOTHING), {}


def third_slow_at_first(out: Path, on) -> list[WindowRow]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(window_campaign, "reconstruct_window", slow)
        plan = Plan(("splatnode",), per_kind=1, counts=(3,))
        return run_windows(plan, three_places(out).walked[:1], out, "command", on)


def test_a_driver_that_is_killed_repeats_what_was_running_alone(tmp_path):
    driver, asked = subprocess.Popen([sys.executable, "-c", DRIVER, str(tmp_path)]), tmp_path / "asked.txt"
    while not asked.exists() or len(asked.read_text().splitlines()) < 3:
        assert driver.poll() is None
        time.sleep(0.05)
    driver.kill()
    driver.wait()
    assert (tmp_path / "windows.jsonl").exists()
    assert len(third_slow_at_first(tmp_path, in_this_process(cores_each=1))) == 4
    strides = [line.split()[1] for line in asked.read_text().splitlines()]
    assert strides == ["1", "2", "3", "3", "4"]
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {"asked.txt", "windows.json"}


def pair_of_scenes(folder: Path) -> list[TrialScene]:
    """Two scenes of the built-in place, small ones."""
    config = synthetic.Config(views=4, width=320, height=240)
    names = tuple(synthetic.frame_name(index) for index in range(config.views))
    for name in ("one", "other"):
        write_capture(folder / name, config)
    return [TrialScene(load_scene(folder / name), names) for name in ("one", "other")]


def answered_by(on, places: Sequence[TrialScene], out: Path) -> list[dict]:
    """The rows as they lie on the disk, without costs."""
    run_windows(Plan(("splatnode",), counts=(3,)), places, out, "command", on)
    return without_costs(json.loads((out / "windows.json").read_text())["rows"])


def test_one_core_and_two_give_the_same(tmp_path):
    if len(usable_cores()) < 2:
        pytest.skip("needs two cores")
    places, found = pair_of_scenes(tmp_path), []
    for cores in (1, 2):
        with engine(cores, None) as on:
            found.append(answered_by(on, places, tmp_path / str(cores)))
    assert found[0] == found[1] and [row["published"] for row in found[0]] == [True] * 4


def test_charts(tmp_path):
    pytest.importorskip("matplotlib", reason="charts need matplotlib (pip install 'splatnode[bench]')")
    from splatnode.extras.evaluate.stability import window_campaign

    assert window_campaign.draw(ROWS, tmp_path) == ["windows.png", "calibration.png"]
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("windows.png", "calibration.png"))
    assert window_campaign.draw(ROWS[7:], tmp_path) == ["windows.png"], "who claims nothing has no calibration"
    titles = [axes.get_title(loc="left") for axes in window_campaign.make_shares_figure(ROWS).axes]
    assert titles == ["splatnode\n2 of 7 right, 1 wrong", "COLMAP\n0 of 2 right, 1 wrong"]
    labels = [
        text.get_text()
        for axes in window_campaign.make_bounds_figure(ROWS).axes
        for text in axes.get_legend().get_texts()
    ]
    assert labels == ["3 views: 82% of 11 cameras within", "3 views: 100% of 11 cameras within"]


def test_command_line():
    command = ["robustness", "a", "--windows", "--windows-per-kind", "3", "--no-cache", "--cores", "2", "--out", "o"]
    args = build_parser().parse_args(command)
    assert (args.windows, args.windows_per_kind, args.no_cache, args.methods, args.cores) == (True, 3, True, None, 2)
