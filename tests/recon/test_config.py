"""Limits of a reconstruction: what is asked for together, and what a scene begins with."""

from __future__ import annotations

import msgspec
import pytest

from splatnode.capture.process.config import ConfigError
from splatnode.recon.config import ReconstructionConfig, apply_changes, preset
from splatnode.recon.result.export.formats.ply import compute_ply_bytes


def test_of_two_limits_the_tighter_one_holds():
    assert ReconstructionConfig().most_gaussians is None
    assert ReconstructionConfig(max_gaussians=900).most_gaussians == 900
    assert ReconstructionConfig(max_gaussians=900, max_mb=1.0).most_gaussians == 900
    by_size = ReconstructionConfig(max_gaussians=90_000, max_mb=1.0).most_gaussians
    assert by_size is not None and by_size < 90_000
    assert 0.999e6 < compute_ply_bytes(by_size, 1) <= 1e6


def test_more_begin_than_may_stay_only_where_something_takes_them_away():
    limited = ReconstructionConfig(max_gaussians=1000)
    assert limited.first_gaussians == 2000
    assert ReconstructionConfig().first_gaussians is None
    free = msgspec.structs.replace(limited.optimize, control=None)
    assert msgspec.structs.replace(limited, optimize=free).first_gaussians == 1000


def test_a_file_changes_a_control_or_leaves_it_out():
    changed = apply_changes(preset("fast"), {"optimize": {"control": {"least_change": 0.5}}})
    control = changed.optimize.control
    assert control is not None and (control.kind, control.config.least_change) == ("prune", 0.5)
    assert changed.optimize.iterations == preset("fast").optimize.iterations
    assert apply_changes(preset("fast"), {"optimize": {"control": None}}).optimize.control is None


def test_seconds_of_the_ladder_are_no_option_any_more():
    with pytest.raises(ConfigError, match=r"fallbacks\.seconds: unknown key; allowed here: budget, timeout_s"):
        apply_changes(ReconstructionConfig(), {"fallbacks": {"seconds": 60.0}})


@pytest.mark.parametrize(
    "changes",
    [
        {"max_gaussians": 0},
        {"max_mb": -2.0},
        {"budget_s": float("nan")},
        {"size": 63},
        {"seed": -1},
        {"seed": 2**63},
        {"prior": "mast3r"},
        {"prior": None},
        {"optimize": {"iterations": -1}},
        {"optimize": {"ssim_lambda": 1.5}},
    ],
)
def test_what_no_scene_can_have_is_refused_by_name(changes):
    ((name, value),) = changes.items()
    with pytest.raises(ConfigError, match=name if not isinstance(value, dict) else f"{name}.{next(iter(value))}"):
        apply_changes(ReconstructionConfig(), changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"metric": {"frame": "Base"}},
            "metric.frame: expected one of first_camera, base, odometry, upright, base_link, odom, got 'Base'",
        ),
        ({"device": "gpu"}, "device: expected one of cpu, cuda, auto, got 'gpu'"),
    ],
)
def test_a_value_that_is_none_of_those_there_are_is_refused_with_these(changes, said):
    with pytest.raises(ConfigError, match=f"^{said}$"):
        apply_changes(ReconstructionConfig(), changes)
