"""The table of docs/metres.md says what tests/bench/results/metres.json holds."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.diorama import Config as Odometry
from tests.conftest import ROOT

PAGE = re.sub(r"\s+", " ", (ROOT / "docs" / "metres.md").read_text(encoding="utf-8"))
ROWS = json.loads((ROOT / "tests" / "bench" / "results" / "metres.json").read_text())["rows"]


MOTIONS = json.loads((ROOT / "tests" / "bench" / "results" / "motions.json").read_text())["rows"]


def chosen(what: str, **values: Any) -> list[dict[str, Any]]:
    return [row for row in ROWS if row["what"] == what and all(row.get(key) == value for key, value in values.items())]


def line(what: str, rows: list[dict[str, Any]]) -> str:
    """A row of the table: trials, errors of the unit, and how often the interval holds."""
    told = [row for row in rows if "error_percent" in row]
    errors = np.abs([row["error_percent"] for row in told])
    numbers = f"{np.median(errors):.2f} % | {np.percentile(errors, 95):.2f} % | {errors.max():.2f} %"
    held = f"{100 * np.mean([row['held'] for row in told]):.1f} %"
    return f"| {what} | {len(told)} of {len(rows)} | {numbers} | {held} |"


def lines() -> list[str]:
    stereo = chosen("stereo")
    whole, odd = ("each step off by 2 % of its length", "the end off by 2 % of the way")
    return [
        line("a marker of 10 cm, in two photographs", chosen("marker")),
        line("stereo, one pair", [row for row in stereo if row["pairs"] == 1]),
        line("stereo, all pairs", [row for row in stereo if row["pairs"] > 1]),
        line(f"odometry, {whole}", chosen("poses", kind="steps", wrong=None)),
        line(f"odometry, {odd}", chosen("poses", kind="way", wrong=None)),
        line(f"{whole}, and one pose wrong by 1 m", wrong("steps")),
        line(f"{odd}, and one pose wrong by 1 m", wrong("way")),
        line("motions, each off by 2 % of its length", of_motions("motions")),
        line("motions, and one of them wrong by 1 m", of_motions("slipped")),
    ]


def of_motions(what: str) -> list[dict[str, Any]]:
    return [row for row in MOTIONS if row["what"] == what]


def wrong(kind: str) -> list[dict[str, Any]]:
    return [row for row in chosen("poses", kind=kind) if row.get("wrong")]


def sentences() -> list[str]:
    markers = chosen("marker")
    asked, refused = (sum(row[key] for row in markers) for key in ("wrong_baselines", "refused"))
    named = {
        kind: (sum(row["wrong"] in row["left_out"] for row in wrong(kind)), len(wrong(kind)))
        for kind in ("steps", "way")
    }
    others = {
        kind: sum(len(set(row["left_out"]) - {row.get("wrong")}) for row in chosen("poses", kind=kind))
        for kind in ("steps", "way")
    }
    slipped, gravity = of_motions("slipped"), of_motions("gravity")
    both = [*of_motions("motions"), *slipped]
    right = sum(row["wrong"] in row["left_out"] for row in slipped)
    other = sum(len(set(row["left_out"]) - {row.get("wrong")}) for row in both)
    off = [row["off_deg"] for row in gravity]
    held = f"{100 * np.mean([row['held'] for row in gravity]):.1f} % of {len(gravity)} trials"
    places = len({row["seed"] for row in ROWS})
    return [
        f"{places} places of the built-in capture",
        f"A baseline that is 20 % off against a marker was refused in {refused} of {asked} trials",
        f"was named in {named['steps'][0]} of {named['steps'][1]} and {named['way'][0]} of {named['way'][1]} trials",
        f"The motion that was wrong by a metre was named in {right} of {len(slipped)} trials",
        f"left out {other} times in all {len(both)} trials",
        f"{np.median(off):.1f} degrees in the median and by {max(off):.1f} at most, within what was told in {held}",
        f"other poses were left out {others['steps']} and {others['way']} times",
    ]


@pytest.mark.parametrize("phrase", [*lines(), *sentences()])
def test_the_page_says_what_was_measured(phrase):
    assert phrase in PAGE


def test_the_bars_are_met():
    markers, poses = chosen("marker"), chosen("poses", kind="steps", wrong=None)
    assert max(abs(row["error_percent"]) for row in markers) < 1.0
    assert all(row["refused"] == row["wrong_baselines"] for row in markers)
    assert max(abs(row["error_percent"]) for row in chosen("stereo") if row["pairs"] > 1) < 0.5
    assert max(abs(row["error_percent"]) for row in poses) < 2.0
    assert all(row["without"] == pytest.approx(row["with"], abs=1e-5) for row in chosen("unharmed"))


def test_the_program_for_wheels_gives_metres(capsys):
    text = (ROOT / "docs" / "metres.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    config = synthetic.Config(views=4, width=320, height=240, odometry=Odometry())
    frames = list(synthetic.stream(config))
    matrices = [frame.motion.matrix for frame in frames]
    known = {
        "photographs": [frame.image for frame in frames],
        "motions": [np.linalg.inv(before) @ after for before, after in pairwise(matrices)],
        "down": [frame.gravity.down for frame in frames],
    }
    exec(program, known)
    assert re.search(r"stated one: \(0\.9\d+, 1\.0\d+\)", capsys.readouterr().out)
