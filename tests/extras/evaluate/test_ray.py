"""A benchmark, a stability campaign and windows on a Ray of this machine give what one core of it gives."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from splatnode.extras.evaluate.protocol import create_empty_networks
from splatnode.extras.evaluate.runner import MethodRunner, Plan, Scoring, run_bench
from splatnode.extras.evaluate.stability import campaign
from splatnode.extras.evaluate.stability.perturbations import ScenesByMotion
from splatnode.extras.jobs import engine
from splatnode.recon.rasterize import rasterize_on_cpu
from tests.extras.evaluate import test_bench
from tests.extras.evaluate.stability.test_campaign import six_views
from tests.extras.evaluate.stability.windows.test_campaign import answered_by, pair_of_scenes
from tests.support.blobs import QUICK, write_scene
from tests.support.trials import without_costs

pytest.importorskip("ray", reason="needs ray")


def test_windows_on_ray_are_those_of_a_core(tmp_path):
    places, found = pair_of_scenes(tmp_path)[:1], []
    for where, address in (("here", None), ("there", "")):
        with engine(1, address) as on:
            found.append(answered_by(on, places, tmp_path / where))
    assert found[0] == found[1] and [row["published"] for row in found[0]] == [True] * 2


def test_what_comes_of_ray_is_what_comes_of_a_core(tmp_path):
    write_scene(tmp_path / "blobs")
    rows = (campaign.MatrixRow(1, "six", lambda sampler: six_views()),)
    benched, tried = [], []
    for where, address in (("here", None), ("there", "")):
        with engine(1, address) as on:
            trials = campaign.Plan(rows, (0,), ("splatnode",))
            tried.append(campaign.run_campaign(trials, ScenesByMotion(()), tmp_path / where / "a", "command", on))
            plan = Plan((tmp_path / "blobs",), (3,), ("shared", "broken"))
            entrants = MethodRunner(test_bench.reconstruct, test_bench.shared_by("shared"))
            out, scoring = tmp_path / where / "b", Scoring(rasterize_on_cpu, create_empty_networks, QUICK)
            benched.append(run_bench(plan, entrants, out, scoring=scoring, command="bench", engine=on))
    assert without_costs(tried[0]) == without_costs(tried[1]) and tried[0][0]["num_gaussians"] > 1000
    here, there = ([asdict(test_bench.without_costs(row)) for row in bench.rows] for bench in benched)
    assert here[0] == there[0] and here[0]["psnr"] > 50
    assert here[1]["verdict"] == there[1]["verdict"] == "FAILED" and "this method is broken" in there[1]["error"]
    pictures = [sorted((tmp_path / where / "b" / "renders").rglob("*.jpg")) for where in ("here", "there")]
    assert len(pictures[0]) == 4
    assert [path.read_bytes() for path in pictures[0]] == [path.read_bytes() for path in pictures[1]]
