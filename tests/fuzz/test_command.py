"""`./run fuzz` finds a defect of each kind, tells how it is seen again, and finds the campaigns by their names."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.conftest import ROOT
from tests.fuzz import __main__ as command
from tests.fuzz import catalogue, reproducer
from tests.fuzz.planted import PLANTED, PROBLEMS
from tests.fuzz.reproducer import Defect
from tests.support.adversary.boundaries import BOUNDARIES, case_of, cases_of

IN_A_FRESH_PROCESS = """
import json
from tests.fuzz import boundaries
from tests.fuzz.planted import PLANTED
result = boundaries.main(600.0, 0, 8 * len(PLANTED), [each.name for each in PLANTED])
kept = {defect.boundary: defect.problem for defect in result["kept"]}
print(json.dumps({"kept": kept, **{name: result[name] for name in ("rows", "defects", "interrupted")}}, default=str))
"""  # whose memory has no peak from earlier tests


def test_a_defect_of_each_kind_is_found_and_the_others_are_read_on():
    run = subprocess.run([sys.executable, "-c", IN_A_FRESH_PROCESS], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout.splitlines()[-1])
    assert set(result["rows"]) == {each.name for each in PLANTED}
    found = {boundary.removeprefix("planted: "): problem for boundary, problem in result["kept"].items()}
    assert {name: text for name, text in PROBLEMS.items() if not found.get(name, "").startswith(text)} == {}
    assert result["defects"] >= len(PLANTED) and not result["interrupted"]
    assert all(row["cases"] >= 3 for row in result["rows"].values())


def test_a_run_tells_its_counts_and_ends_well_without_a_defect(tmp_path):
    out = tmp_path / "counts.json"
    options = ["--only", "boundaries", "--boundary", "names", "exif", "--cases", "300", "--out", str(out)]
    run = subprocess.run([sys.executable, "-m", "tests.fuzz", *options], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    told = json.loads(out.read_text())
    assert told["campaigns"]["boundaries"]["cases"] == 300 and told["seed"] == 0
    rows = told["campaigns"]["boundaries"]["rows"]
    assert all(row["cases"] == row["refused"] + row["accepted"] for row in rows.values())
    head, *lines = run.stdout.splitlines()
    assert head.split() == ["boundary", "cases", "refused", "accepted", "defects", "seconds", "slowest", "memory"]
    assert [line.split()[0] for line in lines] == ["exif", "names", "boundaries:"] or len(lines) == 3


def test_a_reproducer_holds_the_case_and_how_it_is_seen_again(tmp_path):
    case = {"a.json": b"\xff{", "b": None}
    path = reproducer.save(Defect("places.json", 3, 17, "KeyError: 'a'", case), tmp_path, "abc")
    assert reproducer.load(path) == Defect("places.json", 3, 17, "KeyError: 'a'", case)
    assert json.loads(path.read_text())["command"] == f"./run fuzz --replay {path}"


def test_a_replay_says_whether_the_defect_is_still_there(tmp_path):
    paths = [
        reproducer.save(Defect("names", 0, number, "", case), tmp_path, "abc")
        for number, case in enumerate((b"film.mp4#t=1,2", None))
    ]
    runs = [
        subprocess.run([sys.executable, "-m", "tests.fuzz", "--replay", path], cwd=ROOT, capture_output=True, text=True)
        for path in paths
    ]
    assert [run.returncode for run in runs] == [0, 0], runs[0].stderr
    assert "read or refused as it should be" in runs[0].stdout


def test_a_case_is_drawn_again_by_seed_and_number():
    for boundary in BOUNDARIES[::7]:
        first = dict(cases_of(boundary, 5, 0, 12))
        assert case_of(boundary, 5, 7) == first[7] and dict(cases_of(boundary, 5, 6, 8))[7] == first[7]


def test_campaigns_are_found_by_name(monkeypatch):
    assert {"boundaries", "writes"} <= set(catalogue.campaigns())
    monkeypatch.setattr(catalogue, "NAMES", ("boundaries", "nowhere"))
    assert set(catalogue.campaigns()) == {"boundaries"} and catalogue.missing() == ["nowhere"]


def test_another_campaign_is_counted_in_the_exit_code(monkeypatch, capsys, tmp_path):
    class Found:
        @staticmethod
        def main(seconds: float, seed: int) -> dict[str, object]:
            return {"defects": [f"at {seed}"], "attacks": 3}

    monkeypatch.setattr(catalogue, "campaigns", lambda: {"siege": Found})
    assert command.main(["--only", "siege", "--seed", "4", "--out", str(tmp_path / "out.json")]) == 1
    assert "siege: attacks 3" in capsys.readouterr().out
