"""Stereo pairs of known baseline give metres, once their rows agree."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import encode_png
from splatnode.capture.lenses import undistort_frame
from splatnode.recon.metric.measurement import Measurement, MetricConfig, MetricView
from splatnode.recon.metric.metres import Evidence, apply_metric_scale, gather_evidence
from splatnode.recon.metric.stereo import StereoPair, estimate_scale_from_stereo, make_pairs, stream_right_images
from splatnode.recon.result.snapshot import CameraEstimate, KnownLenses, Landmarks, Snapshot
from tests.recon.result.test_preview import snapshot as ball_snapshot
from tests.support import synthetic as support
from tests.support.stereo import right_photographs

PLACE = synthetic.Config(views=2, width=320, height=240)
UNIT, BASELINE_M = 1.7, 0.15


@lru_cache(maxsize=1)
def rights() -> tuple[Frame, ...]:
    return tuple(right_photographs(PLACE, BASELINE_M))


@lru_cache(maxsize=1)
def pairs() -> tuple[StereoPair, ...]:
    return make_pairs(support.photographs(PLACE), rights())


@lru_cache(maxsize=1)
def landmarks() -> Landmarks:
    """True points of the place on a grid of pixels of each photograph, in a world whose unit is UNIT metres."""
    points, of = [], []
    for index, (T, K) in enumerate(synthetic.scene_cameras(PLACE)):
        depth = synthetic.depth(PLACE, index)
        rows, columns = (each.ravel() for each in np.mgrid[20:220:7, 20:300:7])
        rays = np.linalg.solve(K, np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])).T
        z = depth[rows, columns]
        points.append(((z[:, None] * rays)[np.isfinite(z)] @ T[:3, :3].T + T[:3, 3]) / UNIT)
        of.append(np.full(len(points[-1]), index))
    count = sum(map(len, points))
    views = known().values()
    focals, shapes = np.array([view.focal for view in views]), np.full(2, PLACE.height / PLACE.width)
    return Landmarks(
        points=np.concatenate(points),
        covariances=np.zeros((count, 3, 3)),
        descriptors=np.zeros((count, 128), np.uint8),
        point_of=np.arange(count),
        photograph_of=np.concatenate(of),
        names=tuple(known()),
        Ts_world_camera=np.stack([view.T_world_camera for view in views]),
        lenses=KnownLenses(focals, np.zeros((2, 2)), np.zeros((2, 2)), shapes),
        rotation_bounds=np.zeros(2),
        centre_bounds=np.zeros(2),
        noise_px=0.3,
    )


def known() -> dict[str, MetricView]:
    found = {}
    for index, (T, K) in enumerate(synthetic.scene_cameras(PLACE)):
        smaller = T.copy()
        smaller[:3, 3] /= UNIT
        found[synthetic.frame_name(index)] = MetricView(smaller, K[0, 0] / PLACE.width, *np.zeros((2, 2)), 0.0)
    return found


@pytest.mark.parametrize("stated", [1.0, 1.02, 1.05, 0.95])
def test_the_scale_is_what_the_baseline_says_within_half_a_percent(stated):
    told = estimate_scale_from_stereo(known(), landmarks(), pairs(), stated * BASELINE_M, 0.0)
    assert isinstance(told, Measurement) and told.source == "2 stereo pairs with " + told.source.split(" with ")[1]
    assert told.metres_per_unit == pytest.approx(stated * UNIT, rel=0.005)
    assert abs(np.log(told.metres_per_unit / (stated * UNIT))) < 1.96 * told.sigma < 0.02


def test_how_well_the_scene_is_known_counts_once_whichever_cameras_have_a_partner():
    """Cameras that stand in one place say as much together as each alone, and a rough scene is rough for one pair."""
    of_scene = {name: replace(view, bound=0.02) for name, view in known().items()}
    (first, one), (second, other) = of_scene.items()
    T_beside = one.T_world_camera.copy()
    T_beside[:3, 3] += 1e-3
    beside = replace(one, T_world_camera=T_beside)
    alone, both = (
        estimate_scale_from_stereo(of_scene, landmarks(), pairs()[:count], BASELINE_M, 0.0) for count in (1, 2)
    )
    assert isinstance(alone, Measurement) and isinstance(both, Measurement)
    apart = float(np.linalg.norm(one.centre - other.centre))
    least = 0.02 * 2**0.5 / 1.96 / apart
    assert least < alone.sigma < 1.2 * least and both.sigma <= alone.sigma
    crowded = {first: one, "beside": beside, second: other}
    told = estimate_scale_from_stereo(crowded, landmarks(), pairs()[:1], BASELINE_M, 0.0)
    assert isinstance(told, Measurement) and told.sigma == pytest.approx(alone.sigma, rel=0.1)


def snapshot() -> Snapshot:
    cameras = tuple(
        CameraEstimate(name, index, view.T_world_camera, np.diag([1.0, 1.0, 1.0]), 320, 240)
        for index, (name, view) in enumerate(known().items())
    )
    return replace(ball_snapshot(1), cameras=cameras, landmarks=landmarks())


def test_a_scene_gets_metres_from_its_pairs():
    metric = apply_metric_scale(snapshot(), MetricConfig(stereo_baseline_m=BASELINE_M), Evidence(pairs=pairs()))
    assert metric.scale.metric and "2 stereo pairs with 150 mm between the cameras" in (metric.scale.source or "")


@pytest.mark.parametrize("kept", [1, 0])
def test_a_pair_that_the_newest_estimate_has_no_camera_of_does_not_count(kept):
    all_of_it = landmarks()
    seen = all_of_it.photograph_of < kept
    fewer = replace(
        all_of_it,
        point_of=all_of_it.point_of[seen],
        photograph_of=all_of_it.photograph_of[seen],
        names=all_of_it.names[:kept],
        Ts_world_camera=all_of_it.Ts_world_camera[:kept],
        rotation_bounds=np.zeros(kept),
        centre_bounds=np.zeros(kept),
    )
    told = estimate_scale_from_stereo(known(), fewer, pairs(), BASELINE_M, 0.0)
    if kept:
        assert isinstance(told, Measurement) and told.source.startswith("1 stereo pairs")
        assert told.metres_per_unit == pytest.approx(UNIT, rel=0.005)
    else:
        assert isinstance(told, str) and "share 0 points" in told


@pytest.mark.parametrize("sigma_m", [0.0003, 100.0])
def test_a_baseline_that_is_configured_is_as_the_configuration_allows(sigma_m):
    metric = apply_metric_scale(
        snapshot(), MetricConfig(stereo_baseline_m=150.0, stereo_baseline_sigma_m=sigma_m), Evidence(pairs=pairs())
    )
    assert "150 m between the cameras" in (metric.scale.source or "")


def shifted(down: int = 0, across: int = 0, swap: bool = False) -> list[StereoPair]:
    found = [replace(each, right=np.roll(each.right, (down, across), (0, 1))) for each in pairs()]
    return [replace(each, left=each.right, right=each.left) for each in found] if swap else found


def test_pairs_that_are_not_rectified_give_nothing():
    def asked(given: list[StereoPair]) -> str:
        told = estimate_scale_from_stereo(known(), landmarks(), given, BASELINE_M, 0.0)
        assert isinstance(told, str)
        return told

    assert "not rectified: what both see is" in asked(shifted(down=2))
    assert "the principal points of both must be the same" in asked(shifted(across=-4))
    assert "left and right exchanged" in asked(shifted(swap=True))
    assert "share 0 points" in asked([replace(each, right=np.zeros_like(each.right)) for each in pairs()])
    assert "no points to compare" in str(estimate_scale_from_stereo(known(), None, pairs(), BASELINE_M, 0.0))


def test_partners_have_one_name(tmp_path: Path):
    frames = support.photographs(PLACE)
    (tmp_path / "view_001.png").write_bytes(encode_png(rights()[1].image))
    (tmp_path / "other.png").write_bytes(encode_png(rights()[0].image))
    (found,) = make_pairs(frames, stream_right_images(tmp_path, frames))
    assert found.photograph == "view_001.png"
    with pytest.raises(ValueError, match=r"no right photograph has the name of a left one, such as view_000"):
        make_pairs(frames, [replace(rights()[0], name="x.png")])
    with pytest.raises(ValueError, match="must have one size"):
        make_pairs(frames, [replace(rights()[0], image=rights()[0].image[:100])])


def test_right_images_that_came_with_the_frames_give_metres_without_a_configuration():
    frames = list(synthetic.stream(msgspec.structs.replace(PLACE, baseline_m=BASELINE_M)))
    told = apply_metric_scale(snapshot(), MetricConfig(), gather_evidence(frames, MetricConfig())).scale
    assert told.metric and "2 stereo pairs with 150 mm between the cameras" in (told.source or "")
    assert told.interval_95 is not None and 1.0 < told.interval_95[1] < 1.02


def test_a_right_image_is_taken_out_of_the_lens_as_its_left_one_is():
    lens = Intrinsics(320, 240, 300.0, 310.0, 160.0, 120.0, "calibration", (-0.2, 0.05, 0.0, 0.0))
    frame = next(synthetic.stream(msgspec.structs.replace(PLACE, lens=lens, baseline_m=BASELINE_M)))
    assert frame.right is not None
    straight = undistort_frame(frame)
    alone = undistort_frame(replace(frame, image=np.repeat(frame.right.image[:, :, None], 3, 2), right=None))
    assert straight.right is not None and straight.right.baseline == frame.right.baseline
    assert np.array_equal(straight.right.image, alone.image[:, :, 0])
