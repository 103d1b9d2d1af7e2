"""A result: its records, its renders, and what is written and read."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

import splatnode
from splatnode.api.result import result_of
from splatnode.capture.frame import Clock, Stamp
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.verdict import compute_axes
from tests.support.exported import make_snapshot, stamped


def same_rgb(a: np.ndarray, b: np.ndarray) -> float:
    """Mean difference in grey levels."""
    return float(np.abs(a.astype(int) - b).mean())


def test_both_directions_of_a_camera_cancel(result):
    for camera in result.cameras:
        assert np.allclose(camera.T_camera_world @ camera.T_world_camera, np.eye(4), atol=1e-6)
        assert np.array_equal(camera.centre, camera.T_world_camera[:3, 3])


def test_the_covariance_is_that_of_the_claim(result):
    for camera in result.cameras:
        claimed = np.linalg.norm(camera.bounds.axes, axis=1)
        assert np.allclose(np.sqrt(7.815 * np.linalg.eigvalsh(camera.covariance)[::-1]), claimed)
        assert np.allclose(
            compute_axes(camera.covariance, camera.bounds.centre), camera.bounds.axes, rtol=0.05, atol=1e-5
        )
    assert splatnode.Camera("a", np.eye(4), np.eye(3), 2, 2).covariance is None


def test_records_are_frozen_and_arrays_are_copies(result):
    with pytest.raises(FrozenInstanceError):
        result.cameras[0].name = "b"
    result.cameras[0].T_world_camera[:] = 0
    result.gaussians["means"][:] = 0
    assert result.cameras[0].T_world_camera[3, 3] == 1 and result.gaussians["means"].any()


def test_a_render_from_a_camera_is_its_photograph(result, arrays):
    camera = result.cameras[1]
    view = result.render(camera.T_world_camera, camera.K, (camera.width, camera.height))
    assert view.rgb.shape == (240, 320, 3) and view.rgb.dtype == np.uint8 and view.depth.shape == view.seen.shape
    assert same_rgb(view.rgb, arrays[1]) < 10
    again = result.render(camera.T_world_camera, camera.K, (camera.width, camera.height), threads=1)
    assert np.array_equal(again.rgb, view.rgb) and np.array_equal(again.depth, view.depth)
    means = result.gaussians["means"]
    inside = (means - camera.centre) @ camera.T_world_camera[:3, 2]
    assert np.median(view.depth[view.depth > 0]) == pytest.approx(np.median(inside), rel=0.5)


def test_a_view_has_the_exposure_that_the_photographs_around_it_imply_or_that_of_the_scene(result, tmp_path):
    saved = result.save(tmp_path / "a")
    report = json.loads((saved / "report.json").read_text())
    assert report["gains"] == {} and report["gain_sigmas"] == {}
    gains = {camera.name: [0.6 + 0.1 * index, 0.7, 0.8] for index, camera in enumerate(result.cameras)}
    report |= {"gains": gains, "gain_sigmas": {name: [0.004] * 3 for name in gains}}
    report["vignetting"] = dict.fromkeys(gains, 0.3)
    alike = splatnode.load(saved)
    (saved / "report.json").write_text(json.dumps(report))
    exposed = splatnode.load(saved)
    for camera in result.cameras:
        asked = camera.T_world_camera, camera.K, (camera.width, camera.height)
        plain, fixed, shown = alike.render(*asked), exposed.render(*asked, exposure="scene"), exposed.render(*asked)
        assert np.array_equal(plain.rgb, fixed.rgb) and not fixed.gain_sigmas.any() and (fixed.gains == 1).all()
        assert shown.gains == pytest.approx(gains[camera.name], rel=0.02) and (shown.gain_sigmas > 0).all()
        middle = plain.rgb[110:130, 150:170].mean((0, 1))
        assert shown.rgb[110:130, 150:170].mean((0, 1)) == pytest.approx(shown.gains * middle, abs=1.0)
        corners = [np.abs(view.rgb[:8, :8].astype(float)).mean() for view in (plain, shown)]
        assert corners[1] == pytest.approx(0.7 * shown.gains.mean() * corners[0], rel=0.1)
    with pytest.raises(ValueError, match="exposure must be 'interpolated' or 'scene', got 'auto'"):
        exposed.render(*asked, exposure="auto")


def test_the_exposure_of_a_view_is_interpolated_in_time_where_it_is_given():
    snapshot = stamped(make_snapshot(), first_ns=10**9)
    names = [camera.name for camera in snapshot.cameras]
    gains = dict(zip(names, ((0.8,) * 3, (1.25,) * 3), strict=True))
    shown = result_of(replace(snapshot, gains=gains), None)  # pyright: ignore
    first = shown.cameras[0]
    asked = first.T_world_camera, first.K, (64, 48)
    assert shown.render(*asked, captured_at=Stamp(10**9, Clock.UTC)).gains == pytest.approx(0.8, rel=0.08)
    later = shown.render(*asked, captured_at=Stamp(2 * 10**9, Clock.UTC))
    assert (later.gains > 1.0).all() and later.gain_sigmas.min() > shown.render(*asked).gain_sigmas.max()
    with pytest.raises(ValueError, match="captured_at must be on the cameras' clock UTC, got FILE"):
        shown.render(*asked, captured_at=Stamp(10**9, Clock.FILE))


def test_gains_that_cannot_be_are_told(result, tmp_path):
    saved = result.save(tmp_path / "a")
    report = json.loads((saved / "report.json").read_text())
    (saved / "report.json").write_text(json.dumps(report | {"gains": {"a.png": [0.0, 1.0, 1.0]}}))
    with pytest.raises(ValueError, match="report.json is not a report of splatnode, or is damaged"):
        splatnode.load(saved)


def test_seen_is_what_two_photographs_confirm(result):
    camera, known = result.cameras[1], result.gaussians["seen"]
    view = result.render(camera.T_world_camera, camera.K, (camera.width, camera.height))
    confirmed = replace(result._snapshot.gaussians, opacities=np.where(known, 1, 0).astype(np.float32) * 0.99)
    alone = render_arrays(confirmed, camera.T_world_camera, camera.K, camera.width, camera.height)
    assert 0.3 < view.seen.mean() < 1.0
    assert not view.seen[alone.alpha < 0.5].any()
    away = camera.T_world_camera.copy()
    away[:3, 2] *= -1  # looks the other way
    away[:3, 0] *= -1
    behind = result.render(away, camera.K, (64, 48))
    assert behind.seen.mean() < 0.1


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ((np.eye(3), np.eye(3), (64, 48)), ValueError, "T_world_camera must be 4x4 and K 3x3"),
        ((2 * np.eye(4), np.eye(3), (64, 48)), ValueError, "must be a rigid motion"),
        ((np.eye(4), np.diag([0.0, 1, 1]), (64, 48)), ValueError, "focal lengths"),
        ((np.eye(4), np.eye(3), (0, 48)), ValueError, "width and height must be 1 to 65535 pixels, got 0 x 48"),
        ((np.eye(4), np.eye(3), 64), TypeError, r"size must be \(width, height\) in whole pixels, got 64"),
        ((np.eye(4), np.eye(3), (6.5, 4)), TypeError, r"whole pixels, got \(6.5, 4\)"),
        (("here", np.eye(3), (64, 48)), TypeError, "T_world_camera must be a matrix of numbers, got str"),
    ],
)
def test_what_is_no_camera_is_told(result, arguments, error, said):
    with pytest.raises(error, match=said):
        result.render(*arguments)


def test_what_was_saved_can_be_loaded_and_saved_again(result, tmp_path):
    saved = result.save(tmp_path / "a" / "b")
    again = splatnode.load(saved)
    assert again.verdict == result.verdict and again.final and not again.metric
    for ours, theirs in zip(result.cameras, again.cameras, strict=True):
        assert np.array_equal(ours.T_world_camera, theirs.T_world_camera) and np.array_equal(ours.K, theirs.K)
        assert ours.bounds == theirs.bounds and ours.captured_at == theirs.captured_at
    for name, array in result.gaussians.items():
        assert np.allclose(array, again.gaussians[name], atol=1e-4), name
    assert again.seconds == result.seconds and again.dropped == result.dropped
    copy = again.save(tmp_path / "c")
    listed = json.loads((saved / "manifest.json").read_text())["files"]
    assert len(listed) > 5
    assert all((copy / name).read_bytes() == (saved / name).read_bytes() for name in [*listed, "manifest.json"])
    assert sorted(path.name for path in (saved / "images").iterdir()) == [camera.name for camera in result.cameras]


@pytest.mark.parametrize("name", ["\u00c9t\u00e9\u00a02024", "\u0639\u06a9\u0633\u200c\u0647\u0627", "\udcff"])
def test_a_result_whose_photographs_lie_under_any_name_can_be_read(result, tmp_path, name):
    again = splatnode.load(result.save(tmp_path / name))
    assert again.verdict == result.verdict and len(again.cameras) == len(result.cameras)


def test_a_draft_of_a_node_is_not_final_when_it_is_read(result, tmp_path):
    saved = result.save(tmp_path / "a")
    report = json.loads((saved / "report.json").read_text())
    report["verdict"]["provisional"] = True
    (saved / "report.json").write_text(json.dumps(report))
    assert not splatnode.load(saved).final


def test_a_refusal_replaces_what_a_scene_left(result, arrays, tmp_path):
    saved = result.save(tmp_path / "a")
    splatnode.reconstruct(arrays[:1]).save(saved)
    assert {path.name for path in saved.iterdir()} == {"report.json", "manifest.json"}
    assert not splatnode.load(saved).verdict.publishable


def test_what_is_no_result_is_told(result, tmp_path):
    with pytest.raises(FileNotFoundError, match="is no folder; give one that Result.save"):
        splatnode.load(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="scene.ply is not there"):
        splatnode.load(tmp_path)
    saved = result.save(tmp_path / "a")
    loaded = splatnode.load(saved)
    (saved / "cameras.json").write_bytes((saved / "cameras.json").read_bytes() + b" ")
    with pytest.raises(ValueError, match="cameras.json was changed since it was written"):
        loaded.save(tmp_path / "b")
    (saved / "cameras.json").unlink()
    with pytest.raises(ValueError, match="cameras.json is not there any more"):
        loaded.save(tmp_path / "b")
    (saved / "manifest.json").unlink()
    with pytest.raises(ValueError, match="has no manifest.json that can be read"):
        loaded.save(tmp_path / "b")
    (tmp_path / "places.json").write_text('{"places": []}')
    with pytest.raises(ValueError, match="holds several results; give one of its folders: a"):
        splatnode.load(tmp_path)


def test_the_gaussians_are_those_of_its_files():
    made = make_snapshot()
    broken = made.gaussians.means.copy()
    broken[0] = np.nan
    found = result_of(replace(made, gaussians=replace(made.gaussians, means=broken)), None)  # pyright: ignore
    assert len(found.gaussians["means"]) == len(made.gaussians) - 1
