"""Printed markers give metres: found in photographs, measured by several cameras, refused where they contradict."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lenses import project, undistort_frame
from splatnode.recon.metric.measurement import (
    Baseline,
    MarkerDetection,
    Measurement,
    MetricConfig,
    MetricView,
    detect_markers,
    estimate_scale_from_markers,
)
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.result.snapshot import CameraEstimate
from tests.recon.result.test_preview import snapshot as ball_snapshot
from tests.support import marked

PLACE = synthetic.Config(views=3, width=640, height=480, samples=4)
MARKERS = (marked.Marker(0), marked.Marker(7, centre=(1.6, 1.1, 0.8), towards=(1.0, 0.7, 0.9), turn_deg=150.0))
UNIT = 1.7  # metres a unit of the scene


@lru_cache(maxsize=1)
def photographs() -> tuple[Frame, ...]:
    return tuple(marked.photographs(PLACE, synthetic.scene_cameras(PLACE), MARKERS, alone=True))


@lru_cache(maxsize=1)
def found() -> tuple[MarkerDetection, ...]:
    return tuple(detect_markers(photographs(), "4X4_50"))


def cameras() -> list[CameraEstimate]:
    """The true ones, in a world whose unit is UNIT metres."""
    estimates = []
    for frame, (T, K) in zip(photographs(), synthetic.scene_cameras(PLACE), strict=True):
        smaller = T.copy()
        smaller[:3, 3] /= UNIT
        estimates.append(CameraEstimate(frame.name, frame.frame_id, smaller, K, PLACE.width, PLACE.height))
    return estimates


def views() -> dict[str, MetricView]:
    return {
        each.name: MetricView(each.T_world_camera, each.K[0, 0] / PLACE.width, 0.0, np.zeros(2), 0.0)
        for each in cameras()
    }


def of(numbers: set[int], names: set[str] | None = None) -> list[MarkerDetection]:
    return [each for each in found() if each.marker in numbers and (names is None or each.photograph in names)]


def test_corners_are_found_to_a_twentieth_of_a_pixel():
    assert len(found()) == 6 and {each.marker for each in found()} == {0, 7}
    for each in found():
        T, K = synthetic.scene_cameras(PLACE)[[frame.name for frame in photographs()].index(each.photograph)]
        (marker,) = (marker for marker in MARKERS if marker.number == each.marker)
        in_camera = (marked.true_corners(marker) - T[:3, 3]) @ T[:3, :3]
        true = (in_camera / in_camera[:, 2:] @ K.T)[:, :2]
        np.testing.assert_allclose(each.corners.pixels, true, atol=0.05)
        assert each.corners.covariance.diagonal().min() >= 0.03**2 and each.corners.correlation > 0.95


@pytest.mark.parametrize("pair", [{"view_000.png", "view_001.png"}, {"view_001.png", "view_002.png"}])
def test_a_marker_of_10_cm_in_two_photographs_gives_metres_within_a_percent(pair):
    (told,) = estimate_scale_from_markers(views(), of({0}, pair), 0.1, 0.0)
    assert isinstance(told, Measurement) and told.source == "marker 0 of 100 mm in 2 photographs"
    assert told.metres_per_unit == pytest.approx(UNIT, rel=0.01) and 0.0005 < told.sigma < 0.01


def test_markers_count_together_and_their_side_is_known_no_better_for_it():
    (one,), (both,) = (
        estimate_scale_from_markers(views(), of({0}), 0.1, 0.0),
        estimate_scale_from_markers(views(), of({0, 7}), 0.1, 0.0),
    )
    assert isinstance(one, Measurement) and isinstance(both, Measurement)
    assert both.sigma < one.sigma and both.metres_per_unit == pytest.approx(UNIT, rel=0.005)
    (ruler,) = estimate_scale_from_markers(views(), of({0, 7}), 0.1, 0.002)
    assert isinstance(ruler, Measurement) and ruler.sigma == pytest.approx(0.02, rel=0.01)


def test_what_a_marker_cannot_tell_is_said():
    assert estimate_scale_from_markers(views(), [], 0.1, 0.0) == ["no marker of 100 mm was found in the photographs"]
    (once,) = estimate_scale_from_markers(views(), of({0}, {"view_001.png"}), 0.1, 0.0)
    assert once == "marker 0 of 100 mm is in one photograph of the scene alone, view_001.png; two are needed"
    (lost,) = estimate_scale_from_markers({}, of({0}), 0.1, 0.0)
    assert isinstance(lost, str) and "in no photograph that has a camera" in lost
    here = views()["view_001.png"]
    same = [replace(each, photograph=name) for each in of({0}, {"view_001.png"}) for name in views()]
    (flat,) = estimate_scale_from_markers(dict.fromkeys(views(), here), same, 0.1, 0.0)
    assert isinstance(flat, str) and "step to the side" in flat


def test_a_marker_that_was_moved_gives_nothing():
    first, *others = of({0})
    pixels = first.corners.pixels + [0.0, 25.0]
    moved = replace(first, corners=replace(first.corners, pixels=pixels))
    (told,) = estimate_scale_from_markers(views(), [moved, *others], 0.1, 0.0)
    assert isinstance(told, str) and "does not lie still" in told


def shrunk(sighting: MarkerDetection, factor: float) -> MarkerDetection:
    """As if the marker were so many times its size, about its middle in the picture."""
    pixels = sighting.corners.pixels
    smaller = pixels.mean(0) + factor * (pixels - pixels.mean(0))
    return replace(sighting, corners=replace(sighting.corners, pixels=smaller))


def test_markers_of_two_sizes_contradict_each_other():
    told = estimate_scale_from_markers(views(), [*of({0}), *(shrunk(each, 0.7) for each in of({7}))], 0.1, 0.0)
    assert len(told) == 2 and all(isinstance(each, Measurement) for each in told)


def test_markers_that_differ_by_more_than_they_may_give_no_metres_whatever_the_ruler_and_others_say():
    known = replace(ball_snapshot(1), cameras=tuple(cameras()))
    evidence = Evidence((*of({0}), *(shrunk(each, 0.98) for each in of({7}))))
    told = apply_metric_scale(known, MetricConfig(marker_size_m=0.1), evidence)  # the ruler: half a millimetre, 0.5 %
    assert not told.scale.metric and told.scale.interval_95 is None
    assert "marker 0 of 100 mm in 3 photographs, contradicts marker 7 of 100 mm" in (told.scale.source or "")
    true = [T[:3, 3] for T, _ in synthetic.scene_cameras(PLACE)]
    apart = float(np.linalg.norm(true[2] - true[0]))
    for sigma in (0.001, 0.5):
        between = MetricConfig(
            marker_size_m=0.1, baseline=Baseline("view_000.png", "view_002.png", 1.01 * apart), baseline_sigma=sigma
        )
        torn = apply_metric_scale(known, between, evidence)
        assert not torn.scale.metric and "contradicts" in (torn.scale.source or "")


def test_a_scene_gets_metres_from_a_marker_and_a_baseline_20_percent_off_is_refused():
    known = replace(ball_snapshot(1), cameras=tuple(cameras()))
    evidence = Evidence(found())
    metric = apply_metric_scale(known, MetricConfig(marker_size_m=0.1), evidence)
    assert metric.scale.metric and "marker 0 of 100 mm in 3 photographs" in (metric.scale.source or "")
    true = [T[:3, 3] for T, _ in synthetic.scene_cameras(PLACE)]
    apart = float(np.linalg.norm(true[2] - true[0]))
    placed = [camera.T_world_camera[:3, 3] for camera in metric.cameras]
    assert np.linalg.norm(placed[2] - placed[0]) == pytest.approx(apart, rel=0.01)
    for wrong in (0.8, 1.2):
        asked = MetricConfig(marker_size_m=0.1, baseline=Baseline("view_000.png", "view_002.png", wrong * apart))
        torn = apply_metric_scale(known, asked, evidence)
        assert not torn.scale.metric and "contradicts marker 0" in (torn.scale.source or "")
    nothing = apply_metric_scale(known, MetricConfig(marker_size_m=0.1))
    assert not nothing.scale.metric and "no marker of 100 mm was found" in (nothing.scale.source or "")


def test_a_number_that_a_photograph_shows_twice_is_none_of_it():
    frame = photographs()[1]
    twice = np.concatenate([frame.image, frame.image], 1)
    assert detect_markers([replace(frame, image=twice)], "4X4_50") == []


def test_corners_are_those_of_the_photograph_without_distortion():
    frame = photographs()[1]
    K = synthetic.scene_cameras(PLACE)[1][1]
    lens = Intrinsics(640, 480, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "calibration", (-0.25, 0.05))
    columns, rows = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    straight = cv2.undistortPoints(
        np.stack([columns, rows], -1).reshape(-1, 1, 2), lens.K, np.array([*lens.distortion, 0, 0]), P=lens.K
    ).reshape(480, 640, 2)
    bent = cv2.remap(frame.image, *np.moveaxis(straight.astype(np.float32) - 0.5, -1, 0), cv2.INTER_CUBIC)
    (seen,) = [
        each for each in detect_markers([replace(frame, image=bent, intrinsics=lens)], "4X4_50") if not each.marker
    ]
    (true,) = of({0}, {frame.name})
    pinhole = undistort_frame(replace(frame, image=bent, intrinsics=lens)).intrinsics
    assert pinhole is not None
    rays = np.column_stack([true.corners.pixels, np.ones(4)]) @ np.linalg.inv(K).T
    np.testing.assert_allclose(seen.corners.pixels, project(rays, pinhole), atol=0.15)


def test_nothing_is_looked_for_unless_it_is_asked_for():
    assert gather_evidence(photographs(), MetricConfig()).sightings == ()
    some = gather_evidence([DroppedFrame("x.png", "unreadable"), photographs()[0]], MetricConfig(marker_size_m=0.1))
    assert {each.marker for each in some.sightings} == {0, 7}
