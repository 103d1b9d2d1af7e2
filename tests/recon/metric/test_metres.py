"""A scene gets metres from a known distance or from a network, and every file says so."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.process.config import ConfigError
from splatnode.recon.config import ReconstructionConfig as ReconConfig
from splatnode.recon.config import apply_changes
from splatnode.recon.metric.measurement import Baseline, Measurement, MetricConfig
from splatnode.recon.metric.metres import Evidence, apply_metric_scale
from splatnode.recon.metric.stereo import MetricDepth, estimate_scale_from_network
from splatnode.recon.networks.vit import crop
from splatnode.recon.result.export import export_scene
from splatnode.recon.result.export.formats.ply import decode as decode_ply
from splatnode.recon.result.export.stored import decode_scale
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.report import build_report, write_result_folder
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.stored_snapshot import read_result
from splatnode.recon.result.verdict import Bounds, make_ball
from tests.recon.result.test_preview import snapshot as ball_snapshot


@pytest.fixture
def seen() -> Snapshot:
    """Two cameras 0.5 apart before a ball, each known to 5 mm of a unit."""
    known = ball_snapshot(1)
    first = known.cameras[0]
    apart = first.T_world_camera.copy()
    apart[:3, 3] += [0.5, 0.0, 0.0]
    cameras = tuple(
        replace(first, name=name, T_world_camera=T, bounds=Bounds(1.0, 0.005, 0.5, 1.0, make_ball(0.005)))
        for name, T in (("a.jpg", first.T_world_camera), ("b.jpg", apart))
    )
    wide = replace(known.gaussians, scales=np.full((1, 3), 0.9, np.float32))
    return replace(known, cameras=cameras, gaussians=wide, images={camera.name: blank(camera) for camera in cameras})


def blank(camera: CameraEstimate) -> np.ndarray:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


def test_a_known_distance_gives_the_unit(seen):
    metric = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0)))
    centres = [camera.T_world_camera[:3, 3] for camera in metric.cameras]
    assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(2.0)
    assert metric.cameras[0].bounds == Bounds(1.0, 0.02, 0.5, 1.0, make_ball(0.02))
    np.testing.assert_allclose(metric.gaussians.means, 4.0 * seen.gaussians.means, rtol=1e-6)
    np.testing.assert_allclose(metric.gaussians.scales, 4.0 * seen.gaussians.scales, rtol=1e-6)
    assert metric.scale.metric and metric.scale.source == "2 m between a.jpg and b.jpg, known to 2.5 %"
    looks = [
        render_arrays(each.gaussians, camera.T_world_camera, camera.K, camera.width, camera.height).rgb
        for each, camera in ((seen, seen.cameras[1]), (metric, metric.cameras[1]))
    ]
    np.testing.assert_allclose(looks[0], looks[1], atol=2e-3)  # the same scene


def test_what_cannot_be_had_is_said_and_the_scene_stays(seen, tmp_path, monkeypatch):
    assert apply_metric_scale(seen, MetricConfig()) is seen
    lost = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "z.jpg", 2.0)))
    assert not lost.scale.metric and "z.jpg is not among" in (lost.scale.source or "")
    np.testing.assert_array_equal(lost.gaussians.means, seen.gaussians.means)
    unsure = replace(
        seen,
        cameras=tuple(replace(camera, bounds=Bounds(1.0, 0.5, 50.0, 1.0, make_ball(0.5))) for camera in seen.cameras),
    )
    told = apply_metric_scale(unsure, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0)))
    assert not told.scale.metric and "do not tell these two cameras apart" in (told.scale.source or "")
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    assert "no weights" in (apply_metric_scale(seen, MetricConfig(depth_network=True)).scale.source or "")


def test_a_network_gives_the_unit_where_its_views_agree(seen):
    def metres_of(factors: list[float]) -> MetricDepth:
        asked = iter(zip(factors, seen.cameras, strict=True))

        def depth(image: np.ndarray):
            factor, camera = next(asked)
            truth = render_arrays(
                seen.gaussians, camera.T_world_camera, camera.K, camera.width, camera.height, channels=("depth",)
            )
            to = crop(camera.width, camera.height, max(camera.width, camera.height), 1)
            return factor * truth.depth, to

        return MetricDepth("a network", depth)

    told = estimate_scale_from_network(seen, metres_of([3.0, 3.1]), 0.15)
    assert isinstance(told, Measurement) and told.metres_per_unit == pytest.approx(3.05, rel=0.01)
    assert told.source.startswith("a network, 2 views that agree to") and 0.15 < told.sigma < 0.17
    told = estimate_scale_from_network(seen, metres_of([1.0, 3.0]), 0.15)
    assert isinstance(told, str) and "disagree" in told
    told = estimate_scale_from_network(seen, metres_of([0.0, 0.0]), 0.15)
    assert isinstance(told, str) and "no view shows enough" in told


def test_distances_that_agree_are_averaged_and_those_that_do_not_give_no_metres(seen):
    alone = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0)))
    again = apply_metric_scale(
        seen,
        MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0), further_baselines=(Baseline("b.jpg", "a.jpg", 2.04),)),
    )
    lengths = [np.linalg.norm(each.cameras[1].T_world_camera[:3, 3]) for each in (alone, again)]
    assert lengths[0] < lengths[1] < 1.02 * lengths[0]
    assert again.scale.interval_95 and alone.scale.interval_95
    assert 1.0 < again.scale.interval_95[1] < alone.scale.interval_95[1]
    wrong = (Baseline("b.jpg", "a.jpg", 2.4),)
    torn = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0), further_baselines=wrong))
    assert not torn.scale.metric and torn.scale.interval_95 is None
    assert "2 m between a.jpg and b.jpg, contradicts 2.4 m between b.jpg and a.jpg" in (torn.scale.source or "")
    np.testing.assert_array_equal(torn.gaussians.means, seen.gaussians.means)


def test_a_distance_that_says_nothing_does_not_take_the_metres_of_another(seen):
    lost = (Baseline("a.jpg", "z.jpg", 2.0),)
    told = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0), further_baselines=lost))
    assert told.scale.metric and "z.jpg is not among" in (told.scale.source or "")


def test_many_sources_are_told_as_far_as_files_have_room(seen, tmp_path):
    lost = tuple(Baseline("a.jpg", f"a photograph that is not there, number {i}.jpg", 2.0) for i in range(30))
    metric = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0), further_baselines=lost))
    told = metric.scale.source or ""
    assert told.startswith("2 m between a.jpg and b.jpg, known to 2.5 %; ") and re.search(r"; and \d+ more$", told)
    write_result_folder(metric, tmp_path, seed=0, preset_name="fast")
    assert read_result(tmp_path)[0].scale == metric.scale
    silent = apply_metric_scale(seen, MetricConfig(baseline=lost[0], further_baselines=lost[1:]))
    assert not silent.scale.metric and len(silent.scale.source or "") <= 1000
    agreeing = tuple(Baseline("a.jpg", "b.jpg", 2.0) for _ in range(60))
    known = (
        apply_metric_scale(seen, MetricConfig(baseline=agreeing[0], further_baselines=agreeing[1:])).scale.source or ""
    )
    assert len(known) <= 1000 and "more, known to" in known


def test_a_longer_sentence_of_an_earlier_version_is_cut(seen, tmp_path):
    write_result_folder(seen, tmp_path, seed=0, preset_name="fast")
    cameras = json.loads((tmp_path / "cameras.json").read_text()) | {"scale_source": "x" * 2000}
    assert decode_scale(json.dumps(cameras).encode()).source == "x" * 999 + "…"


def test_every_file_says_which_scale_it_has(seen, tmp_path):
    metric = apply_metric_scale(seen, MetricConfig(baseline=Baseline("a.jpg", "b.jpg", 2.0)))
    for snapshot, word in ((metric, "metric"), (seen, "relative")):
        out = tmp_path / word
        report = write_result_folder(snapshot, out, seed=0, preset_name="fast")
        assert report["scale"] == word and report["scene_bytes"] == (out / "scene.ply").stat().st_size
        for name in ("report.json", "manifest.json", "cameras.json", "transforms.json"):
            content = json.loads((out / name).read_text())
            content = content.get("splatnode", content)
            assert (content["scale"], content["scale_source"]) == (word, snapshot.scale.source), name
            assert content["scale_interval_95"] == (snapshot.scale.interval_95 and [*snapshot.scale.interval_95]), name
        assert decode_scale((out / "cameras.json").read_bytes()) == snapshot.scale
        texts = [out / "trajectory.tum", *(out / "colmap").glob("*.txt")]
        assert len(texts) == 4 and all(f"# scale: {word} (" in path.read_text() for path in texts)
        assert f"scale {word}".encode() in (out / "scene.ply").read_bytes()
        for form, file in (("nerfstudio", "t.json"), ("tum", "t.tum"), ("ply", "s.ply"), ("colmap", "model")):
            path = export_scene(out, form, tmp_path / f"{word}_{file}")
            written = (path / "images.txt" if form == "colmap" else path).read_bytes()
            assert word.encode() in written, form
        read = decode_ply((out / "scene.ply").read_bytes())
        np.testing.assert_allclose(read.means, snapshot.gaussians.means)


def test_a_refused_result_has_no_metres(seen):
    refused = replace(seen, cameras=())
    report = build_report(
        apply_metric_scale(refused, MetricConfig(depth_network=True)), seed=0, preset="fast", peak_rss_mb=None
    )
    assert (report["scale"], report["scale_source"]) == ("relative", None)


def test_the_configuration_says_what_a_baseline_is():
    config = apply_changes(ReconConfig(), {"metric": {"baseline": ["a.jpg", "b.jpg", 0.5]}})
    assert config.metric.baseline == ("a.jpg", "b.jpg", 0.5) and config.metric.baseline.metres == 0.5
    for wrong in (
        ["a.jpg", "a.jpg", 0.5],
        *(["a.jpg", "b.jpg", metres] for metres in (-1, 0, math.nan, math.inf, 1e7)),
    ):
        with pytest.raises(ConfigError, match="two different photographs and a positive distance"):
            apply_changes(ReconConfig(), {"metric": {"baseline": wrong}})


@pytest.mark.parametrize("by", ["a distance", "poses"])
def test_depths_that_a_map_is_made_of_have_the_unit_of_the_cameras(seen, by):
    places = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.4, 0.1], [0.5, 0.3, 0.0], [0.2, 0.2, 0.3]])
    Ts = np.tile(seen.cameras[0].T_world_camera, (5, 1, 1))
    Ts[:, :3, 3] += places
    cameras = tuple(replace(seen.cameras[0], name=f"{i}.jpg", frame_id=i, T_world_camera=T) for i, T in enumerate(Ts))
    relative = replace(seen, cameras=cameras, depths={"0.jpg": np.full((2, 3), 1.5, np.float16)})
    doubled = Ts.copy()
    doubled[:, :3, 3] *= 2.0
    poses = {camera.name: T for camera, T in zip(cameras, doubled, strict=True)}
    asked = MetricConfig(baseline=Baseline("0.jpg", "1.jpg", 1.0)) if by == "a distance" else MetricConfig()
    metric = apply_metric_scale(relative, asked, Evidence(poses=poses if by == "poses" else None))
    assert metric.scale.metric and metric.scale.source
    assert metric.cameras[1].T_world_camera == pytest.approx(doubled[1], abs=1e-3)
    assert metric.depths["0.jpg"] == pytest.approx(np.full((2, 3), 3.0), abs=0.01)
