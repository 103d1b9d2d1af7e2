"""Trials of the stability matrix: each ends, and a campaign goes on where it was stopped."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.command_line import build_parser
from splatnode.extras.evaluate.stability.campaign import Plan, run_campaign
from splatnode.extras.evaluate.stability.perturbations import ScenesByMotion, TrialImage
from splatnode.extras.evaluate.stability.trial import Demand, MatrixRow, TrialCase, find_method, make_accept_case
from splatnode.extras.jobs import engine, usable_cores
from splatnode.recon.result.verdict import Code
from tests.support.calls import in_this_process
from tests.support.stability_places import three_places
from tests.support.synthetic import photographs
from tests.support.trials import without_costs


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> ScenesByMotion:
    return three_places(tmp_path_factory.mktemp("places"))


def hang() -> list[Frame]:
    time.sleep(600)
    return []


def one_frame() -> list[Frame]:
    return [Frame(0, "only", 0, np.zeros((48, 64, 3), np.uint8), None)]


def takes_memory() -> list[Frame]:
    held = bytearray(1_200_000_000)
    time.sleep(600)
    return [] if held else one_frame()


def case(source) -> TrialCase:
    return TrialCase("a note", source, Demand.REFUSE, frozenset({Code.TOO_FEW_VIEWS}))


def row(number: int, source) -> MatrixRow:
    return MatrixRow(number, "row", lambda sampler: case(source))


def test_a_trial_ends_whatever_happens_in_it(tmp_path, places):
    sources = one_frame, partial(os._exit, 9), partial(int, "x"), takes_memory
    rows = tuple(row(number, source) for number, source in enumerate(sources))
    with engine(1, None) as on:
        plan = Plan(rows, (0,), ("splatnode",), max_memory_mb=1000.0)
        refused, dies, raises, greedy = run_campaign(plan, places, tmp_path / "a", "command", on)
        (hangs,) = run_campaign(Plan((row(4, hang),), (0,), ("splatnode",), 1.0), places, tmp_path / "b", "command", on)
    assert (refused["verdict"], refused["outcome"], refused["right"]) == ("TOO_FEW_VIEWS", "refused", True)
    assert refused["peak_rss_mb"] is not None and refused["cores"] == 1
    assert [trial["outcome"] for trial in (dies, raises, greedy, hangs)] == ["failed"] * 4
    assert dies["message"] == "ended with exit code 9 and said nothing"
    assert "ValueError" in raises["message"]
    assert "--max-memory allows 1000" in greedy["message"]
    assert hangs["message"] == "took longer than the 1 s that --timeout-s allows"


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path, places):
    rows, on = (row(1, one_frame), row(2, one_frame)), in_this_process()
    assert len(run_campaign(Plan(rows, (0,), ("splatnode",)), places, tmp_path, "command", on)) == 2
    first = json.loads((tmp_path / "stability.json").read_text())["trials"]
    trials = run_campaign(Plan(rows, (0, 1), ("splatnode",)), places, tmp_path, "command", on)
    assert trials[:2] == first and len(trials) == 4  # not run again: seconds are the same
    content = json.loads((tmp_path / "stability.json").read_text())
    assert [(t["row"], t["seed"]) for t in content["trials"]] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert content["false_accept_rate"] == 0.0 and content["false_refuse_rate"] is None
    assert {path.name for path in tmp_path.iterdir()} == {"stability.json"}
    elsewhere = ScenesByMotion(places.walked[:1])
    with pytest.raises(ValueError, match="is of the scenes east, south, west, now there are east"):
        run_campaign(Plan(rows, (0,), ("splatnode",)), elsewhere, tmp_path, "command", on)


def test_seconds_of_one_core_and_of_several_are_not_mixed(tmp_path, places):
    plan = Plan((row(1, one_frame),), (0,), ("splatnode",))
    (trial,) = run_campaign(plan, places, tmp_path, "command", in_this_process())
    content = json.loads((tmp_path / "stability.json").read_text())
    trial |= {"seconds": 1.0, "cores": 1}
    (tmp_path / "stability.json").write_text(json.dumps({**content, "trials": [trial]}))
    said = r"stability.json holds runs that had 1 core each, now each would have 4 cores, .* give the same --cores"
    with pytest.raises(ValueError, match=said):
        run_campaign(plan, places, tmp_path, "command", in_this_process(cores_each=4))
    trial |= {"seconds": None}  # others had disturbed it: there is nothing to mix
    (tmp_path / "stability.json").write_text(json.dumps({**content, "trials": [trial]}))
    assert len(run_campaign(plan, places, tmp_path, "command", in_this_process(cores_each=4))) == 1


def six_views() -> TrialCase:
    photos = [TrialImage(frame.name, frame.image, None) for frame in photographs()]
    return make_accept_case(photos, "the built-in place")


def test_one_core_and_two_give_the_same(tmp_path, places):
    if len(usable_cores()) < 2:
        pytest.skip("needs two cores")
    rows = MatrixRow(1, "six", lambda sampler: six_views()), row(2, one_frame)
    found = []
    for cores in (1, 2):
        with engine(cores, None) as on:
            run_campaign(Plan(rows, (0,), ("splatnode",)), places, tmp_path / str(cores), "command", on)
        found.append(json.loads((tmp_path / str(cores) / "stability.json").read_text()))
    assert [trial["num_gaussians"] for trial in found[0]["trials"]] > [1000, 0]
    assert without_costs(found[0]["trials"]) == without_costs(found[1]["trials"])


DRIVER = """
import sys
from pathlib import Path
from splatnode.extras.jobs import engine
from tests.extras.evaluate.stability.test_campaign import noted
with engine(1, None) as on:
    noted(Path(sys.argv[1]), on)
"""


def note(path: Path, number: int) -> list[Frame]:
    """One frame; the third trial takes long when it is begun for the first time."""
    with path.open("a") as file:
        file.write(f"{number} {os.getpid()}\n")
    if number == 2 and [line[0] for line in path.read_text().splitlines()].count("2") == 1:
        time.sleep(600)
    return one_frame()


def begun(path: Path) -> list[str]:
    """The trials, each as often as it was begun: one that is refused asks for its frames twice."""
    return [line[0] for line in dict.fromkeys(path.read_text().splitlines())] if path.exists() else []


def noted(out: Path, on) -> list[dict]:
    rows = tuple(row(number, partial(note, out / "begun.txt", number)) for number in range(4))
    return run_campaign(Plan(rows, (0,), ("splatnode",)), ScenesByMotion(()), out, "command", on)


def test_a_driver_that_is_killed_repeats_what_was_running_alone(tmp_path):
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, str(tmp_path)])
    while begun(tmp_path / "begun.txt") != ["0", "1", "2"]:
        assert driver.poll() is None
        time.sleep(0.05)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    assert len(noted(tmp_path, in_this_process(cores_each=1))) == 4
    assert begun(tmp_path / "begun.txt") == ["0", "1", "2", "2", "3"]
    assert {path.name for path in tmp_path.iterdir()} == {"begun.txt", "stability.json"}


def test_command_line():
    parse = build_parser().parse_args
    args = parse(
        ["robustness", "a", "b", "--rows", "1,7", "--seeds", "2", "--methods", "splatnode,colmap", "--out", "o"]
    )
    assert (args.scenes, args.rows, args.seeds) == ([Path("a"), Path("b")], (1, 7), 2)
    assert args.methods == ("splatnode", "colmap") and args.cores is None and args.ray is None
    assert isinstance(args, argparse.Namespace)
    with pytest.raises(ValueError, match="no method 'magic'; there are: splatnode, colmap, colmap-few-views, glomap"):
        find_method("magic")
