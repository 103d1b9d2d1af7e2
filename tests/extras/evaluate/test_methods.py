"""Rival methods are configurations of the same engine."""

from __future__ import annotations

from importlib import import_module

import msgspec
import pytest

from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.methods import (
    CONFIGS,
    METHODS,
    PUBLISHED,
    RIVALS,
    expand_method_names,
    find_method,
    select_start_config,
)
from splatnode.recon.config import PRESETS
from splatnode.recon.optimize import regularizers
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.result.report import build_report
from tests.support.synthetic import photographs


def test_every_preset_is_a_method():
    assert PRESETS.keys() <= CONFIGS.keys() <= METHODS.keys()
    for name, config in PRESETS.items():  # nothing but what is shown on the way differs
        same = msgspec.structs.replace(CONFIGS[name].optimize, checkpoints=config.optimize.checkpoints)
        assert msgspec.structs.replace(CONFIGS[name], optimize=same) == config
    with pytest.raises(ValueError, match="no method 'nerf'; there are: .*paper"):
        find_method("nerf")


def test_the_papers_schedule_and_weights():
    losses = CONFIGS["paper"].optimize.regularizers.losses
    weights = {name: loss.config.weight for name, loss in losses.items()}
    assert weights == {"point_render": 0.25, "depth": 0.05, "normal": 0.01, "semantic": 0.5}
    assert CONFIGS["paper"].optimize.iterations == 1000
    assert [losses[name].config.weight_at(0.1) > 0 for name in ("point_render", "depth")] == [True, False]
    without = msgspec.structs.replace(CONFIGS["paper"].optimize, regularizers=regularizers.RegularizerConfig())
    assert without == CONFIGS["instantsplat-xl"].optimize


def test_each_loss_of_the_paper_counts_in_the_part_of_the_run_that_it_gives():
    losses = CONFIGS["paper"].optimize.regularizers.losses
    parts = {name: (loss.kind, loss.config.weight, loss.config.start, loss.config.end) for name, loss in losses.items()}
    assert parts == {
        "point_render": ("point_render", 0.25, 0.1, 0.8),
        "depth": ("depth", 0.05, 0.2, 0.7),
        "normal": ("normal", 0.01, 0.2, 0.7),
        "semantic": ("semantic", 0.5, 0.1, 0.8),
    }
    assert losses["point_render"].config.compare_unseen  # white where there is no point, as the paper writes


def test_instantsplat_has_the_step_sizes_of_its_release():
    """Colours, scales and turns ten times as fast as in 3DGS; only the poses' steps fall."""
    assert msgspec.structs.asdict(CONFIGS["instantsplat-xl"].optimize.lr) == {
        "means": 1.6e-4, "means_unit": "depth", "quats": 1e-2, "log_scales": 5e-2, "logit_opacities": 5e-2,
        "sh": 2.5e-2, "translation": 1e-4, "rotation": 1e-4, "final_means": 1.0, "final": 1.0, "final_pose": 0.01,
    }  # fmt: skip
    for name, iterations in (("instantsplat-s", 200), ("instantsplat-xl", 1000)):
        optimize = CONFIGS[name].optimize
        assert (optimize.iterations, optimize.ssim_lambda, optimize.dropout.share) == (iterations, 0.2, 0.0)
        assert optimize.control is None and not optimize.regularizers.losses


def test_sets_are_spelt_out_once():
    assert expand_method_names(["fast", "presets", "paper"]) == (
        "fast",
        *(name for name in PRESETS if name != "fast"),
        "paper",
    )
    assert expand_method_names(["rivals"]) == RIVALS
    with pytest.raises(ValueError, match="and the sets presets, rivals, published, surrounded, ablation"):
        expand_method_names(["paper", "instantsplat"])


def test_methods_share_a_start_unless_they_look_at_other_sizes_or_find_their_own():
    assert (
        select_start_config("paper")
        == select_start_config("instantsplat-s")
        == select_start_config("balanced")
        != select_start_config("preview")
    )
    assert all(select_start_config(name) is None for name in (*RIVALS, *PUBLISHED))


@pytest.mark.parametrize("name", PUBLISHED)
def test_as_published_is_the_same_method_with_another_budget(name, monkeypatch):
    module = import_module(f"splatnode.extras.evaluate.rivals.{name.partition('+')[0].replace('-', '_')}")
    monkeypatch.setattr(module, "reconstruct", lambda frames, seed, config=None: iter([(frames, seed, config)]))
    assert list(find_method(name)([], 3)) == [([], 3, module.PUBLISHED)]
    assert list(find_method(name.partition("+")[0])([], 3)) == [([], 3, None)]


def test_a_start_with_surroundings_differs_in_nothing_else():
    for name in expand_method_names(["surrounded"]):
        plain, around = name.split("+")
        without = msgspec.structs.replace(CONFIGS[name].pixelwise, surroundings="none")
        losses = msgspec.structs.replace(CONFIGS[name].optimize.regularizers, min_confidence=0.3)
        optimize = msgspec.structs.replace(CONFIGS[name].optimize, regularizers=losses)
        assert msgspec.structs.replace(CONFIGS[name], pixelwise=without, optimize=optimize) == CONFIGS[plain]
        assert CONFIGS[name].pixelwise.surroundings == around
        assert select_start_config(name) == select_start_config(plain) and not methods.is_variant(name)


def test_the_ablation_changes_one_part_at_a_time():
    """Alone on the base, and missing from the whole."""
    parts = ("point_render", "depth", "normal", "semantic")
    whole = CONFIGS[methods.WHOLE]
    for part in parts:
        name = part.replace("_", "-")
        alone, without = (
            CONFIGS[each].optimize.regularizers.losses for each in (f"instantsplat-xl+{name}", f"paper-{name}")
        )
        assert alone == {part: whole.optimize.regularizers.losses[part]}
        assert [other for other in parts if other not in without] == [part]
    assert not CONFIGS["paper-pose-refinement"].optimize.refine_poses
    assert CONFIGS["paper-pseudo-views"].optimize.regularizers.pseudo_views == 0
    thick = CONFIGS["paper-down-sampling"]
    assert thick.optimize == whole.optimize and thick.pixelwise != whole.pixelwise
    assert set(methods.list_names()) <= CONFIGS.keys() and methods.is_variant("paper-depth")
    assert not methods.is_variant("paper")


def test_they_start_from_a_gaussian_a_pixel_and_keep_them():
    few = msgspec.structs.replace(CONFIGS["paper"].optimize, iterations=5, checkpoints=())
    config = msgspec.structs.replace(CONFIGS["paper"], size=160, optimize=few)
    last = list(reconstruct(list(photographs()[:3]), config))[-1]
    assert last.verdict.publishable and last.iterations == 5
    assert len(last.gaussians) > 160 * 120
    told = build_report(last, seed=0, preset="paper", peak_rss_mb=None)["served_by"]
    assert isinstance(told, dict) and list(told) == ["point_render", "depth", "normal", "semantic"]
