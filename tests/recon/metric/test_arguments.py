"""The options of the command line become the configuration of the metres, and reach the scene."""

from __future__ import annotations

import argparse
from typing import get_args

import pytest

from splatnode.command_line import build_parser
from splatnode.extras.verbs import replay_options
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.metric.arguments import (
    FRAMES,
    add_poses,
    collect_drift_changes,
    collect_metric_changes,
    trusts_poses,
)
from splatnode.recon.result.verdict import FrameChoice, parse_frame_name


def configured(*options: str):
    args = build_parser().parse_args(["replay", "photographs", "--out", "out", *options])
    return apply_changes(ReconstructionConfig(), {"metric": collect_metric_changes(args)}).metric


def test_options_become_the_configuration():
    plain = configured()
    assert plain.marker_size_m is None and plain.stereo_baseline_m is None and plain.baselines == ()
    metric = configured(
        "--marker",
        "99.4mm@0.2mm",
        "--stereo",
        "r",
        "--stereo-baseline",
        "7.5cm",
        "--poses",
        "p",
        "--poses-sigma",
        "1,5",
    )
    assert (metric.marker_size_m, metric.marker_size_sigma_m) == pytest.approx((0.0994, 0.0002))
    assert (metric.stereo_baseline_m, metric.stereo_baseline_sigma_m) == pytest.approx((0.075, 0.0003))
    assert (metric.poses_sigma_m, metric.poses_sigma_deg) == (1.0, 5.0)


def test_a_batch_passes_its_marker_on():
    args = build_parser().parse_args(["batch", "all", "--out", "out", "--marker", "100mm@0.1mm"])
    assert replay_options(args) == ["--marker", "100mm@0.1mm"]


@pytest.mark.parametrize(
    ("option", "value"), [("--poses-sigma", "1"), ("--poses-sigma", "0,2"), ("--marker", "100"), ("--marker", "1m@2")]
)
def test_what_is_no_value_is_refused(option, value, capsys):
    with pytest.raises(SystemExit):
        configured(option, value)
    assert f"argument {option}: " in capsys.readouterr().err


def test_who_says_how_unsure_poses_are_trusts_them_unless_they_are_only_to_be_checked():
    parser = argparse.ArgumentParser()
    add_poses(parser)
    for given, trusted in (
        (["--poses", "p"], False),
        (["--poses", "p", "--poses-sigma", "0.001,0.1"], True),
        (["--poses", "p", "--poses-sigma", "0.001,0.1", "--check-poses"], False),
    ):
        assert trusts_poses(parser.parse_args(given)) is trusted


def test_drift_is_a_share_of_the_way_and_degrees():
    parser = argparse.ArgumentParser()
    add_poses(parser)
    for text, told in (("2%", (0.02, 0.5)), ("1,0.2", (0.01, 0.2))):
        changes = collect_drift_changes(parser.parse_args(["--poses", "p", "--poses-drift", text]))
        assert (changes["poses_drift"], changes["poses_drift_deg"]) == pytest.approx(told)
    for wrong in ("0%", "60%", "2%,x", "nan", "2%,nan"):
        with pytest.raises(SystemExit):
            parser.parse_args(["--poses-drift", wrong])
    with pytest.raises(ValueError, match="which poses drift"):
        collect_drift_changes(parser.parse_args(["--poses-drift", "2%"]))


def test_frame_and_gravity_become_the_configuration():
    assert (configured().frame, configured().gravity) == (None, None)
    assert get_args(FrameChoice) == FRAMES
    for told, meant in (("base_link", "base"), ("odom", "odometry"), ("upright", "upright")):
        assert parse_frame_name(configured("--frame", told).frame or "").value == meant
    assert configured("--gravity", "-0.5,1,0").gravity == (-0.5, 1.0, 0.0)
    args = build_parser().parse_args(["batch", "all", "--out", "out", "--frame", "odom", "--gravity", "-1,0,0"])
    assert replay_options(args) == ["--frame", "odom", "--gravity", "-1,0,0"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--frame", "world"], "--frame: invalid choice: 'world'"),
        (["--gravity", "0,0,0"], "must be three numbers with commas, a direction"),
        (["--gravity", "down"], "must be three numbers with commas, a direction"),
    ],
)
def test_what_is_no_frame_and_no_gravity_is_told(capsys, options, said):
    with pytest.raises(SystemExit):
        configured(*options)
    assert said in capsys.readouterr().err
