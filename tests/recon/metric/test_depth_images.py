"""Depth images give metres and depth, and the images tell what is wrong with them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.depth_image import DepthImage, make_depth_image
from splatnode.capture.frame import Intrinsics
from splatnode.recon.metric.depth_fit import (
    DepthFit,
    DepthView,
    MeasuredDepth,
    describe_doubtful_units,
    fit_depth_images,
    has_too_few_points,
    smooth_depth,
    warp_depth,
)
from splatnode.recon.metric.depth_fusion import fuse_depth
from splatnode.recon.metric.measurement import Measurement, MetricConfig, combine_measurements
from splatnode.recon.metric.metres import (
    CameraDepth,
    Evidence,
    apply_metric_scale,
    estimate_scale_from_depth,
    gather_evidence,
)
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import DepthCode
from tests.recon.metric import test_stereo
from tests.support import synthetic as support
from tests.support.depth_camera import DepthCamera, add_depths, measure, measure_along_rays

PLACE, UNIT = test_stereo.PLACE, test_stereo.UNIT
GOOD = DepthCamera()


@lru_cache(maxsize=16)
def depths(camera: DepthCamera = GOOD) -> dict[str, CameraDepth]:
    frames = add_depths(support.photographs(PLACE), PLACE, camera)
    return {each.name: CameraDepth("", each.depth) for each in frames if each.depth is not None}


@lru_cache(maxsize=16)
def views(camera: DepthCamera = GOOD) -> tuple[DepthView, ...]:
    """True points of the place, in a unit of UNIT metres, with what the depth camera tells of them."""
    found = []
    for index, (name, own) in enumerate(depths(camera).items()):
        _, K = synthetic.scene_cameras(PLACE)[index]
        rows, columns = (each.ravel() for each in np.mgrid[5:235:5, 5:315:5])
        z = synthetic.depth(PLACE, index)[rows, columns] / UNIT
        rays = np.linalg.solve(K, np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])).T
        lens = Intrinsics(320, 240, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "estimated")
        points = (z[:, None] * rays)[np.isfinite(z)]
        found.append(DepthView(name, "", points, own.depth, lens))
    return tuple(found)


def fit(camera: DepthCamera = GOOD) -> DepthFit:
    (found,) = fit_depth_images(views(camera))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_metres_within_half_a_percent_and_their_bound_holds(seed):
    found = fit(DepthCamera(seed=seed))
    assert found.check.code is DepthCode.FITS and found.is_usable and found.check.num_points > 1000
    assert found.metres_per_unit == pytest.approx(UNIT, rel=0.005)
    assert abs(np.log(found.metres_per_unit / UNIT)) < 1.96 * found.sigma < 0.012


@pytest.mark.parametrize("shift", [(4.0, 0.0), (0.0, 4.0), (-4.0, 0.0), (0.0, -4.0), (3.0, -3.0)])
def test_a_shift_of_four_pixels_is_named_and_its_depth_left_out(shift):
    found = fit(DepthCamera(shift_px=shift))
    assert found.check.code is DepthCode.SHIFTED and not found.is_usable and found.check.shift_px is not None
    assert np.hypot(*(np.array(found.check.shift_px) - shift)) <= 2.0
    assert "not aligned" in found.check.message and "Align depth to colour" in found.check.message


def bend(by: float, camera: DepthCamera = GOOD) -> DepthFit:
    """The fit beside a scene whose focal length is wrong: far things are too far, and near ones too near."""
    bent = [replace(each, points=each.points * (each.points[:, 2:] * UNIT / 2.0) ** by) for each in views(camera)]
    (found,) = fit_depth_images(bent)
    return found


@pytest.mark.parametrize("by", [0.12, -0.12])
def test_a_scene_that_is_bent_is_no_fault_of_the_depth_camera(by):
    found = bend(by)
    assert found.check.code is DepthCode.UNTESTED and not found.is_usable and not has_too_few_points(found.check)
    told = "too far" if by > 0 else "too near"
    assert "only if the estimated cameras, not the depths" in found.check.message and told in found.check.message
    assert "--intrinsics" in found.check.message


@pytest.mark.parametrize("shift", [(6.0, 0.0), (0.0, -6.0)])
def test_beside_a_bent_scene_a_shift_is_still_named(shift):
    assert bend(0.05, DepthCamera(shift_px=shift)).check.code is DepthCode.SHIFTED


def test_what_no_cameras_bend_so_much_is_no_fault_of_theirs():
    assert bend(-0.3).check.code in (DepthCode.SHIFTED, DepthCode.CONTRADICTS)


def test_a_shift_at_the_end_of_the_search_is_called_the_least():
    found = fit(DepthCamera(shift_px=(14.0, 0.0))).check
    assert found.code is DepthCode.SHIFTED and found.shift_is_least and found.record()["shift_is_least"] is True
    assert "by at least 10 pixels, where the search ends" in found.message
    assert "Disparity in place of depth, or a wrong lens, looks the same" in found.message
    within = fit(DepthCamera(shift_px=(4.0, 0.0))).check
    assert not within.shift_is_least and "at least" not in within.message and "Disparity" not in within.message


def test_disparity_in_place_of_depth_is_not_told_as_a_shift_of_so_many_pixels():
    swapped = [
        replace(each, depth=DepthImage(np.where(z > 0, 4.0 / np.maximum(z, 0.1), 0).astype(np.float32), 1.0))
        for each in views()
        for z in [each.depth.metres]
    ]
    (found,) = fit_depth_images(swapped)
    assert not found.is_usable and "isparity" in found.check.message, found.check
    assert found.check.shift_px is None or found.check.shift_is_least


def test_depths_beyond_any_camera_are_told_with_their_unit():
    far = [replace(each, depth=DepthImage(1000 * each.depth.metres, 1.0)) for each in views()]
    (found,) = fit_depth_images(far)
    assert found.check.code is DepthCode.UNTESTED
    assert "floats hold metres; the median is" in found.check.message and "probably milli" in found.check.message


def test_doubts_about_units_are_told_once_for_all_images():
    frames = [replace(each, depth=DepthImage(np.full((240, 320), 2, np.uint16))) for each in support.photographs(PLACE)]
    good = [replace(each, depth=depths()[each.name].depth) for each in frames[:1]]
    assert describe_doubtful_units(good) == ""
    said = describe_doubtful_units([*good, *frames[1:]])
    assert frames[1].name in said and "median is 2: probably metres" in said
    assert f"({len(frames) - 1} of {len(frames)} depth images)" in said


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_is_noisier_than_it_says_is_not_called_misaligned(seed):
    few = [replace(view, points=view.points[::4]) for view in views(DepthCamera(noise_px=0.6, seed=seed))]
    (found,) = fit_depth_images(few)
    assert found.check.code is DepthCode.FITS


def test_some_hundred_points_suffice_to_name_a_shift():
    (found,) = fit_depth_images(
        [replace(view, points=view.points[::8]) for view in views(DepthCamera(shift_px=(4.0, 0.0)))]
    )
    assert found.check.num_points < 800 and found.check.code is DepthCode.SHIFTED


def test_depths_of_something_else_contradict_the_images():
    first, second = views()
    crossed = [replace(first, depth=second.depth), replace(second, depth=first.depth)]
    rng = np.random.default_rng(0)
    noise = make_depth_image((1 + 3 * rng.random((240, 320))).astype(np.float32), noise="time_of_flight")
    (found,) = fit_depth_images([replace(each, depth=noise) for each in crossed])
    assert found.check.code in (DepthCode.CONTRADICTS, DepthCode.SHIFTED) and not found.is_usable


def _six(**wrong: DepthCamera) -> list[DepthView]:
    """Each photograph three times over, with depth images of their own; `wrong` ones by `v` and their number."""
    found = []
    for number in range(6):
        view = views(wrong.get(f"v{number}", DepthCamera(seed=number)))[number % 2]
        found.append(replace(view, name=f"view_{number}.png", points=view.points[::3]))
    return found


@pytest.mark.parametrize("scale", [0.9, 1.06])
@pytest.mark.parametrize("wrong", [(3,), (1, 4)])
def test_depth_images_of_another_unit_than_most_others_are_left_out_alone(scale, wrong):
    (found,) = fit_depth_images(_six(**{f"v{i}": DepthCamera(scale=scale, seed=i) for i in wrong}))
    assert found.check.code is DepthCode.FITS and found.metres_per_unit == pytest.approx(UNIT, rel=0.003)
    assert found.names == tuple(f"view_{i}.png" for i in range(6) if i not in wrong)
    told = "10 % smaller" if scale < 1 else "6 % larger"
    assert all(f"view_{i}.png (its depths are {told} than others)" in found.check.message for i in wrong)


def test_depth_images_without_a_common_unit_are_all_left_out_and_not_called_misaligned():
    (found,) = fit_depth_images(_six(**{f"v{i}": DepthCamera(scale=1.1, seed=i) for i in (1, 2, 4)}))
    assert found.check.code is DepthCode.UNTESTED and not found.is_usable and not has_too_few_points(found.check)
    assert "have no common unit" in found.check.message and "view_2.png (its depths are 10 %" in found.check.message


def test_depth_images_of_something_else_are_left_out_alone():
    first, second, *rest = _six()
    other = [
        replace(each, depth=make_depth_image(np.ascontiguousarray(each.depth.values[::-1]))) for each in (first, second)
    ]
    (found,) = fit_depth_images([*other, *rest])
    assert found.check.code is DepthCode.FITS and found.names == tuple(f"view_{i}.png" for i in range(2, 6))
    assert "left out: view_0.png (contradicts its photograph at" in found.check.message


def test_depth_images_of_which_a_part_contradicts_the_rest_are_left_untested():
    parts = []
    for each in _six():
        values = each.depth.values.copy()
        values[:, : values.shape[1] // 2] = np.rint(1.2 * values[:, : values.shape[1] // 2])
        parts.append(replace(each, depth=replace(each.depth, values=values)))
    (found,) = fit_depth_images(parts[:4] + _six()[4:])
    assert found.check.code is DepthCode.UNTESTED and not found.is_usable
    assert "contradict them where the others fit" in found.check.message


def test_distances_along_the_rays_are_no_depths():
    (found,) = fit_depth_images(
        [replace(each, depth=measure_along_rays(each.depth, each.lens.resized(320, 240).K)) for each in views()]
    )
    assert found.check.code is DepthCode.CONTRADICTS and not found.is_usable
    assert "are distances along the rays" in found.check.message


@pytest.mark.parametrize("least", [1, 30_000])
def test_depths_that_by_their_noise_tell_nothing_are_untested(least):
    """All agrees with what is known to a third of itself, and the mean of thousands would be published as exact."""
    rng = np.random.default_rng(0)
    drawn = [
        replace(each, depth=make_depth_image(rng.integers(least, 60_000, (240, 320)).astype(np.uint16)))
        for each in views()
    ]
    (found,) = fit_depth_images(drawn)
    assert found.check.code is DepthCode.UNTESTED and not found.is_usable and not has_too_few_points(found.check)
    assert "by their noise a depth is known to" in found.check.message


def test_points_and_depths_that_are_only_noisy_fit():
    (noisy,) = fit_depth_images(_six(**{f"v{i}": DepthCamera(noise_px=1.2, seed=i) for i in range(6)}))
    assert noisy.check.code is DepthCode.FITS, "two thirds of the points agree, everywhere alike"
    rng = np.random.default_rng(0)
    mismatched = [
        replace(each, points=each.points * np.exp(rng.normal(0.0, 0.5, (count, 1)) * (rng.random((count, 1)) < 0.4)))
        for each in _six()
        if (count := len(each.points))
    ]
    (found,) = fit_depth_images(mismatched)
    assert found.check.code is DepthCode.FITS and found.metres_per_unit == pytest.approx(UNIT, rel=0.005)


def test_few_points_judge_nothing():
    (found,) = fit_depth_images([replace(each, points=each.points[:10]) for each in views()])
    assert found.check.code is DepthCode.UNTESTED and "30 are needed" in found.check.message and not found.is_usable


def test_each_camera_is_judged_alone():
    first, second = views()[0], views(DepthCamera(shift_px=(5.0, 0.0)))[1]
    good, bad = fit_depth_images([first, replace(second, camera_id="wrist")])
    assert (good.camera_id, good.is_usable, bad.camera_id, bad.is_usable) == ("", True, "wrist", False)
    assert "of wrist" in bad.check.message


def test_a_depth_camera_beside_the_colour_camera_with_its_own_lens():
    place, offset = PLACE, np.array([0.03, 0.0, 0.0])
    found = []
    for index, view in enumerate(views()):
        T, K = synthetic.scene_cameras(place)[index]
        T_camera_depth = np.eye(4)
        T_camera_depth[:3, 3] = offset
        wide = K.copy()
        wide[0, 0] = wide[1, 1] = 0.8 * K[0, 0]
        z = synthetic.depth_map(place, (T @ T_camera_depth, wide))
        lens = Intrinsics(320, 240, wide[0, 0], wide[1, 1], wide[0, 2], wide[1, 2], "calibration")
        measured = measure(z, DepthCamera(), index)
        beside = make_depth_image(measured.values, intrinsics=lens, T_camera_depth=T_camera_depth)
        found.append(replace(view, depth=beside))
        shown = warp_depth(replace(view, depth=beside), view.lens.K, (240, 320))
        true = synthetic.depth(place, index)
        known = shown.z > 0
        assert known.mean() > 0.6
        assert np.median(np.abs(shown.z[known] / true[known] - 1)) < 0.01
    (fitted,) = fit_depth_images(found)
    assert fitted.is_usable and fitted.metres_per_unit == pytest.approx(UNIT, rel=0.005)


# In metres, by what the scene knows.


def measured(camera: DepthCamera = GOOD, others: tuple[Measurement, ...] = ()):
    return estimate_scale_from_depth(test_stereo.known(), test_stereo.landmarks(), depths(camera), others)


def test_a_scale_error_of_three_percent_is_named_by_another_source():
    marker = Measurement(UNIT, 0.005, "a marker of 100 mm")
    (said,), (check,) = measured(DepthCamera(scale=1.03), (marker,))
    assert isinstance(said, str) and check.code is DepthCode.SCALE
    assert check.scale_error == pytest.approx(0.03, abs=0.006)
    assert "too large by a marker of 100 mm" in check.message
    (said,), (check,) = measured(DepthCamera(scale=0.97), (marker,))
    assert check.code is DepthCode.SCALE and "too small" in check.message
    (said,), (check,) = measured(DepthCamera(), (marker,))
    assert isinstance(said, Measurement) and check.code is DepthCode.FITS


@pytest.mark.parametrize("factor", [0.8, 10.0])
def test_of_two_sources_that_no_calibration_reconciles_none_gives_metres(factor):
    other = Measurement(factor * UNIT, 0.01, "0.5 m between a.png and b.png")
    (said,), (check,) = measured(DepthCamera(), (other,))
    assert isinstance(said, Measurement) and check.code is DepthCode.SCALE
    assert "so no metres are given" in check.message
    combined = combine_measurements([other, said])
    assert isinstance(combined, str) and "contradicts" in combined


def test_without_points_nothing_is_measured():
    (said,), (check,) = estimate_scale_from_depth(test_stereo.known(), None, depths(), ())
    assert isinstance(said, str) and check.code is DepthCode.UNTESTED
    assert estimate_scale_from_depth(test_stereo.known(), None, {}, ()) == ([], ())


def test_the_scene_is_in_metres_and_the_report_tells_of_its_depth_camera():
    frames = add_depths(support.photographs(PLACE), PLACE)
    evidence = gather_evidence(frames, MetricConfig())
    assert set(evidence.depths) == {each.name for each in frames}
    metric = apply_metric_scale(test_stereo.snapshot(), MetricConfig(), evidence)
    assert metric.scale.metric and metric.scale.interval_95 is not None
    low, high = metric.scale.interval_95
    assert 0.985 < low < 1.0 < high < 1.015
    apart = np.linalg.norm(metric.cameras[0].T_world_camera[:3, 3] - metric.cameras[1].T_world_camera[:3, 3])
    (first, _), (second, _) = synthetic.scene_cameras(PLACE)
    assert apart == pytest.approx(np.linalg.norm(first[:3, 3] - second[:3, 3]), rel=0.01)
    report = build_report(metric, seed=0, preset="fast", peak_rss_mb=None)
    assert report["depth"] == [check.record() for check in metric.depth_checks]
    assert metric.depth_checks[0].record()["code"] == "FITS"
    without = apply_metric_scale(test_stereo.snapshot(), MetricConfig(), Evidence())
    assert "depth" not in build_report(without, seed=0, preset="fast", peak_rss_mb=None)


# Depth without its noise, and beside stereo.


def test_a_wall_is_smoothed_and_its_edge_is_not():
    z = np.full((120, 160), 2.0)
    z[:, 80:] = 3.0
    noisy = z + 0.02 * np.random.default_rng(0).normal(size=z.shape)
    found, sigma = smooth_depth(make_depth_image(noisy.astype(np.float32)))
    known = found > 0
    assert known.mean() > 0.97
    assert np.sqrt(np.mean((found - z)[known] ** 2)) < 0.012 and sigma[known].max() <= 0.09
    assert np.abs(found - z)[known].max() < 0.15, "nothing floats between both walls"


def pointmap(depth: np.ndarray, confidence: np.ndarray) -> Pointmap:
    K = np.array([[100.0, 0, 8], [0, 100.0, 6], [0, 0, 1]])
    normal = np.zeros((*depth.shape, 3), np.float32)
    return Pointmap("a", 0, depth.astype(np.float32), confidence.astype(np.float32), normal, np.eye(4), K)


def test_depth_is_filled_where_stereo_has_none_and_averaged_where_both_agree():
    stereo, confidence = np.full((12, 16), 2.0), np.full((12, 16), 0.95)
    stereo[:, :4] = confidence[:, :4] = 0.0
    stereo[:, 12:] = 3.0
    told = np.full((12, 16), 2.01)
    told[0] = 0.0
    fused = fuse_depth(pointmap(stereo, confidence), MeasuredDepth(told, np.full((12, 16), 0.01)))
    assert fused.depth[1:, :4] == pytest.approx(2.01) and (fused.confidence[1:, :4] > 0.5).all()
    assert (fused.depth[1:, 4:12] > 2.0).all() and (fused.depth[1:, 4:12] < 2.01).all()
    assert fused.depth[:, 12:] == pytest.approx(3.0), "what stereo is sure of stays"
    assert fused.depth[0, 0] == 0.0 and fused.depth[0, 5] == pytest.approx(2.0)
    assert np.linalg.norm(fused.normal[5, 1]) == pytest.approx(1.0)


def test_what_is_too_unsure_fills_nothing():
    nothing = np.zeros((12, 16))
    fused = fuse_depth(pointmap(nothing, nothing), MeasuredDepth(np.full((12, 16), 2.0), np.full((12, 16), 0.2)))
    assert not fused.depth.any() and not fused.confidence.any()


def test_half_believed_pixels_are_twice_as_unsure():
    wall = np.full((60, 80), 2000, np.uint16)
    whole = make_depth_image(wall, confidence=np.full(wall.shape, 255, np.uint8))
    half = DepthImage(wall, confidence=np.full(wall.shape, 128, np.uint8))
    assert smooth_depth(half)[1][30, 40] == pytest.approx(255 / 128 * smooth_depth(whole)[1][30, 40], rel=1e-6)
