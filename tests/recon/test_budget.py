"""Which limit bound a scene, and what is told about what more would buy."""

from __future__ import annotations

import msgspec
import pytest
import torch

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.modelling import STAYS, find_budget_hits, loss_fall
from splatnode.recon.optimize import training
from splatnode.recon.result.export.formats.ply import compute_ply_bytes
from splatnode.recon.scene import Gaussians, Scene

SECONDS = {"poses": 1.0, "points": 2.0, "optimise": 4.0, "total": 7.0}


def gaussians(count: int) -> Gaussians:
    zeros = torch.zeros(count, 3)
    return Gaussians(
        zeros, torch.ones(count, 4), zeros, torch.zeros(count), zeros[:, None], torch.zeros(count, dtype=torch.int32)
    )


def begun(num_unlimited: int = 10_000) -> Scene:
    return Scene((), gaussians(0), num_unlimited=num_unlimited)


def refined(count: int, iterations: int = 500, losses: tuple[float, ...] = ()) -> Scene:
    return Scene((), gaussians(count), iterations, losses=losses)


def test_no_limit_and_limits_that_were_not_reached_bind_nothing():
    assert find_budget_hits(ReconstructionConfig(), begun(), refined(4500), SECONDS) == ()
    assert (
        find_budget_hits(
            ReconstructionConfig(max_gaussians=5000, max_mb=9.0, budget_s=60.0), begun(), refined(4999), SECONDS
        )
        == ()
    )
    assert find_budget_hits(ReconstructionConfig(max_gaussians=1), None, None, SECONDS) == ()


def test_a_scene_that_calls_for_just_as_many_is_not_bound():
    assert find_budget_hits(ReconstructionConfig(max_gaussians=800), begun(800), refined(800), SECONDS) == ()


def test_the_limit_on_gaussians_is_named_with_what_the_scene_calls_for():
    (hit,) = find_budget_hits(ReconstructionConfig(max_gaussians=1000), begun(), refined(1000), SECONDS)
    assert (hit.limit, hit.given, hit.would_take) == ("max_gaussians", 1000, round(STAYS * 10_000))
    assert "10000 pieces" in hit.basis
    record = hit.record()
    assert record["code"] == "BUDGET_HIT" and str(record["message"]).startswith("BUDGET_HIT: max_gaussians of 1000 ")


@pytest.mark.parametrize(
    ("most", "gain", "words"), [(2500, 0.0, "hardly worse"), (1250, 0.6, "noticeably worse"), (10, 2.0, "much worse")]
)
def test_what_more_gaussians_would_gain_is_told_as_it_was_measured(most, gain, words):
    (hit,) = find_budget_hits(
        ReconstructionConfig(max_gaussians=most), begun(), refined(most), SECONDS
    )  # it would take 5000
    assert hit.gain_db == gain
    limited = f"BUDGET_HIT: max_gaussians of {most} Gaussians made the scene {words} than without this limit"
    assert hit.record()["message"] == f"{limited}; about 5000 Gaussians would suffice"


def test_of_two_limits_the_one_that_bound_is_named():
    config = ReconstructionConfig(max_gaussians=5000, max_mb=compute_ply_bytes(1000, 1) / 1e6 + 1e-5)
    most = config.most_gaussians
    assert most is not None and most <= 1000
    (hit,) = find_budget_hits(config, begun(), refined(most), SECONDS)
    assert hit.limit == "max_mb" and hit.would_take == round(compute_ply_bytes(round(STAYS * 10_000), 1) / 1e6, 2)


def test_without_a_control_all_that_begin_stay():
    config = ReconstructionConfig(max_gaussians=1000, optimize=training.RefinementConfig(control=None))
    assert find_budget_hits(config, begun(), refined(1000), SECONDS)[0].would_take == 10_000


def test_time_that_ran_out_is_told_with_the_seconds_for_the_rest_and_the_slope():
    # 200 of 500 iterations in 4 s: 300 more take 6 s. The loss falls by a hundredth an iteration, by half a second.
    losses = tuple(0.99**i for i in range(200))
    (hit,) = find_budget_hits(ReconstructionConfig(budget_s=7.0), begun(), refined(10, 200, losses), SECONDS)
    assert (hit.limit, hit.given, hit.would_take) == ("budget_s", 7.0, pytest.approx(13.0))
    assert "200 of 500" in hit.basis and "a second" in hit.basis and hit.gain_db == 0.2


def test_a_refinement_that_a_verdict_ended_did_not_want_for_time():
    earlier = refined(10, 150)  # of 500, the best scene before it overfitted
    assert find_budget_hits(ReconstructionConfig(budget_s=3600.0), begun(), earlier, SECONDS, ended_early=True) == ()


def test_a_scene_that_began_with_fewer_than_it_calls_for_is_bound_though_fewer_stayed():
    (hit,) = find_budget_hits(ReconstructionConfig(max_gaussians=1000), begun(20_000), refined(999), SECONDS)
    assert hit.limit == "max_gaussians" and hit.would_take == 10_000


def test_time_that_was_gone_before_the_refinement_is_told():
    (hit,) = find_budget_hits(ReconstructionConfig(budget_s=1.0), begun(), refined(10, 0), SECONDS)
    assert "nothing was refined" in hit.basis and hit.would_take == 7.0 and hit.gain_db == 6.1
    said = "budget_s of 1 s made the scene much worse than without this limit; more than 7 s would suffice"
    assert hit.record()["message"] == f"BUDGET_HIT: {said}"


def test_the_fall_of_the_loss():
    assert loss_fall((1.0,) * 50 + (0.9,) * 50) == 0.0  # it fell long before the end
    assert loss_fall((1.0,) * 90 + (0.8,) * 10) == pytest.approx(0.02)  # by a fifth from ten iterations to ten
    assert loss_fall((1.0,) * 90 + (1.2,) * 10) == 0.0
    assert loss_fall(()) == 0.0


def test_both_limits_can_bind():
    config = msgspec.structs.replace(ReconstructionConfig(), max_gaussians=100, budget_s=7.0)
    found = find_budget_hits(config, begun(), refined(100, 200, (1.0,) * 200), SECONDS)
    assert [hit.limit for hit in found] == ["max_gaussians", "budget_s"]
