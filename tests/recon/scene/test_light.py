"""Photographs that were exposed differently, or took another white for white, are brought to one light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.recon.priors import Pointmap
from splatnode.recon.scene import Exposure
from splatnode.recon.scene.exposure import (
    ExposureConfig,
    apply_exposure,
    apply_headroom,
    compensate_image,
    estimate_exposures,
    estimate_further_exposures,
    estimate_log_gains,
    relative_illumination,
    solve_robust,
)

PLACE = synthetic.Config(views=5, width=240, height=180)
LIT = {"0": Exposure((1.0, 1.0, 1.0), 0.0, None)}  # the light of the scene was changed
GAINS = np.array([[0.5, 0.45, 0.5], [1.0, 1.0, 1.1], [2.0, 2.0, 1.8], [1.0, 1.0, 1.0], [0.8, 0.9, 0.8]])


@lru_cache(maxsize=1)
def place() -> tuple[list[Pointmap], list[np.ndarray]]:
    """Photographs with the depth that they show, where the camera answers to light in proportion."""
    maps, images = [], []
    for index, (T, K) in enumerate(synthetic.scene_cameras(PLACE)):
        depth = synthetic.depth_map(PLACE, (T, K))
        known = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        normal = np.zeros((*depth.shape, 3), np.float32)
        maps.append(Pointmap(f"{index}", index, known, (known > 0).astype(np.float32), normal, T, K))
        images.append((0.45 * synthetic.render_image(PLACE, (T, K), index)).astype(np.uint8))
    return maps, images


def exposed(images: list[np.ndarray], gains: np.ndarray = GAINS) -> list[np.ndarray]:
    return [np.clip(np.rint(image * own), 0, 255).astype(np.uint8) for image, own in zip(images, gains, strict=True)]


def by_name(values: list[Any]) -> dict[str, Any]:
    return {f"{index}": value for index, value in enumerate(values)}


def test_gains_are_found_within_three_per_cent():
    maps, images = place()
    found = np.exp(estimate_log_gains(maps, exposed(images)))
    expected = GAINS / np.median(GAINS, axis=0)
    assert np.abs(found / expected - 1.0).max() < 0.03


def test_photographs_of_one_light_are_left_as_they_are():
    maps, images = place()
    assert np.abs(estimate_log_gains(maps, images)).max() < 0.03
    assert estimate_exposures(maps, by_name(images), ExposureConfig()) == {}


def test_what_is_noise_is_left_and_what_is_none_is_not_unless_it_is_switched_off():
    maps, images = place()
    slightly = by_name(exposed(images, np.array([1.0, 1.01, 1.0, 1.0, 0.99])[:, None]))
    assert estimate_exposures(maps, slightly, ExposureConfig()) == {}
    some = np.array([1.0, 1.05, 1.0, 1.0, 0.95])
    found = estimate_exposures(maps, by_name(exposed(images, some[:, None])), ExposureConfig())
    assert gains_of(found) == pytest.approx(np.repeat(some[:, None], 3, 1), abs=0.015)
    widely = by_name(exposed(images))
    assert set(estimate_exposures(maps, widely, ExposureConfig())) == set(widely)
    assert estimate_exposures(maps, widely, ExposureConfig(enabled=False)) == {}
    assert estimate_exposures(maps[:1], widely, ExposureConfig()) == {}


def test_an_exposure_that_drifts_along_the_way_is_found_with_its_uncertainty():
    maps, images = place()
    along = np.arange(len(maps)) - len(maps) // 2
    for step in (1.05, 1.2, 1.45):
        drifting = by_name(exposed(images, step ** along[:, None]))
        found = estimate_exposures(maps, drifting, ExposureConfig())
        off = np.log(gains_of(found)) - np.log(step) * along[:, None]
        sigmas = np.array([found[name].sigmas for name in sorted(found)])
        assert np.abs(off).max() < 0.03 and (sigmas > 1e-3).all() and (np.abs(off) < 4 * sigmas + 0.01).all()


def test_photographs_that_contradict_each_other_make_gains_less_sure():
    agreeing = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, -1.0]])
    priors, sigmas = np.ones(3), np.full(3, 0.01)
    _, sure = solve_robust(agreeing, np.array([0.1, 0.1, 0.2]), sigmas, priors)
    found, unsure = solve_robust(agreeing, np.array([0.1, 0.1, 0.3]), sigmas, priors)
    assert found[0] - found[2] == pytest.approx(0.25, abs=0.06)
    assert (unsure.diagonal() - sure.diagonal()).min() > 0
    apart = [np.array([1.0, -1.0, 0.0]) @ each @ np.array([1.0, -1.0, 0.0]) for each in (sure, unsure)]
    assert apart[1] > 4 * apart[0]


def test_a_falloff_that_is_left_does_not_pass_for_gains():
    maps, images = place()
    light = relative_illumination(0.3, images[0].shape[1], images[0].shape[0])[..., None]
    dimmed = by_name([np.rint(image * light).astype(np.uint8) for image in images])
    assert estimate_exposures(maps, dimmed, ExposureConfig(least_falloff=0.6)) == {}
    for found in estimate_exposures(maps, dimmed, ExposureConfig()).values():
        assert found.falloff == pytest.approx(0.3, abs=0.06) and found.gains == (1.0, 1.0, 1.0)


def test_one_light_gives_back_the_photographs():
    maps, images = place()
    changed = by_name(exposed(images))
    found = estimate_exposures(maps, changed, ExposureConfig())
    for name, image in by_name(images).items():
        off = np.abs(apply_exposure(changed[name], found[name]).astype(float) - image * np.median(GAINS, axis=0))
        assert np.median(off) <= 2.0  # a gain that is halved doubles what rounding took


def test_pixels_that_do_not_tell_their_brightness_are_known():
    maps, images = place()
    changed = by_name(exposed([np.minimum(2 * image.astype(int), 140).astype(np.uint8) for image in images]))
    found = estimate_exposures(maps, changed, ExposureConfig())
    brightest = found["2"].saturated
    assert brightest is not None and np.array_equal(brightest, changed["2"] >= 250) and brightest.any()
    assert found["0"].saturated is None  # darker than the median: what it shows white, others do, too


BRIGHT = np.array([0.45, 1.5, 1.6, 1.5, 1.4])[:, None]  # white in all but the first, which is dark


def test_what_a_dark_photograph_tells_is_kept_though_it_is_brighter_than_white_in_the_others():
    maps, images = place()
    natural = [np.minimum(2 * image.astype(int), 255).astype(np.uint8) for image in images]
    changed = by_name(exposed(natural, BRIGHT))
    about_the_median = estimate_exposures(maps, changed, ExposureConfig())
    kept, headroom = apply_headroom(changed, about_the_median)
    clipped = [float((apply_exposure(changed["0"], of["0"]) == 255).any(-1).mean()) for of in (about_the_median, kept)]
    assert clipped[0] > 0.05 and clipped[1] < 0.02
    assert 1.1 < headroom <= 2.0
    assert gains_of(kept) == pytest.approx(headroom * gains_of(about_the_median))
    published = headroom * apply_exposure(changed["0"], kept["0"]).astype(float)
    assert np.median(np.abs(published - 1.5 * natural[0])) < 4.0  # the median of the gains, unclipped


def test_photographs_that_fit_below_white_need_no_headroom():
    maps, images = place()
    changed = by_name(exposed(images))
    found = estimate_exposures(maps, changed, ExposureConfig())
    assert apply_headroom(changed, found) == (found, 1.0)
    assert apply_headroom(changed, {}) == ({}, 1.0)
    assert apply_headroom(by_name([np.full_like(images[0], 255)]), {"0": found["0"]})[1] == 1.0  # nothing is told


def test_photographs_that_share_nothing_keep_their_light():
    maps, images = place()
    away = np.eye(4)
    away[:3, 3] = 100.0
    apart = [maps[0], replace(maps[1], T_world_camera=away)]
    assert np.array_equal(estimate_log_gains(apart, exposed(images)[:2]), np.zeros((2, 3)))


def test_a_photograph_that_joins_others_gets_the_exposure_by_which_it_differs_from_them():
    maps, images = place()
    changed = by_name(exposed(images, np.where(np.arange(5)[:, None] == 4, [0.6, 0.5, 0.7], 1.0)))
    found = estimate_further_exposures(maps, changed, {"4": 0.0}, {}, ExposureConfig())
    assert set(found) == {"4"} and np.abs(np.array(found["4"].gains) / [0.6, 0.5, 0.7] - 1.0).max() < 0.03


def test_a_photograph_that_joins_as_the_others_are_is_left_as_it_is_where_they_are():
    maps, images = place()
    alike_all = by_name(exposed(images, np.ones((5, 3))))
    assert estimate_further_exposures(maps, alike_all, {"4": 0.0}, {}, ExposureConfig()) == {}
    assert estimate_further_exposures(maps, alike_all, {"4": 0.0}, LIT, ExposureConfig(enabled=False)) == {}
    (found,) = estimate_further_exposures(maps, alike_all, {"4": 0.0}, LIT, ExposureConfig()).values()
    assert np.abs(np.array(found.gains) - 1.0).max() < 0.03


def test_a_photograph_is_brought_to_the_light_of_its_scene_by_its_gains_alone():
    image = np.minimum(2 * exposed(place()[1])[2].astype(int), 255).astype(np.uint8)
    assert compensate_image(image, None) == (image, None)
    shown, exposure = compensate_image(image, (2.0, 2.0, 1.8))
    assert exposure is not None and np.array_equal(shown, apply_exposure(image, exposure))
    assert exposure.saturated is not None and np.array_equal(exposure.saturated, image >= 250)


def apart() -> list[Pointmap]:
    """Photographs that share nothing."""
    away = np.eye(4)
    maps = []
    for index, pointmap in enumerate(place()[0]):
        away[:3, 3] = 100.0 * index
        maps.append(replace(pointmap, T_world_camera=away.copy()))
    return maps


GREY = np.array([0.5, 1.0, 2.0, 1.0, 0.8])
TOLD = by_name(list(np.log(GREY) + 3.0))  # up to an offset, which no camera tells


def gains_of(found: Mapping[str, Exposure]) -> np.ndarray:
    """(V, 3) in the order of the names."""
    return np.array([found[name].gains for name in sorted(found)])


def test_photographs_that_share_nothing_get_the_light_that_their_cameras_tell():
    changed = by_name(exposed(place()[1], GREY[:, None]))
    assert estimate_exposures(apart(), changed, ExposureConfig()) == {}
    found = gains_of(estimate_exposures(apart(), changed, ExposureConfig(), TOLD))
    assert found == pytest.approx(np.repeat(GREY[:, None], 3, 1), rel=0.03)
    some = {name: TOLD[name] for name in ("0", "1", "2")}
    assert gains_of(estimate_exposures(apart(), changed, ExposureConfig(), some))[:3] == pytest.approx(
        found[:3], rel=0.03
    )
    assert (
        estimate_exposures(apart(), changed, ExposureConfig(), {"2": TOLD["2"]}) == {}
    )  # one alone tells no difference
    assert estimate_exposures(apart(), changed, ExposureConfig(enabled=False), TOLD) == {}


def test_a_small_difference_that_cameras_alone_tell_is_left():
    along = np.arange(5) - 2
    assert estimate_exposures(apart(), by_name(place()[1]), ExposureConfig(), by_name(list(0.05 * along))) == {}


def test_what_photographs_share_counts_for_more_than_what_their_cameras_tell():
    maps, images = place()
    changed = by_name(exposed(images))
    alone = gains_of(estimate_exposures(maps, changed, ExposureConfig()))
    assert gains_of(estimate_exposures(maps, changed, ExposureConfig(), TOLD)) == pytest.approx(alone, rel=0.01)
    for nonsense in (np.log(0.2), np.log(5.0), 20.0):
        wrong = TOLD | {"1": TOLD["1"] + nonsense}
        assert gains_of(estimate_exposures(maps, changed, ExposureConfig(), wrong)) == pytest.approx(alone, rel=0.03)
    upside_down = {name: -told for name, told in TOLD.items()}
    assert gains_of(estimate_exposures(maps, changed, ExposureConfig(), upside_down)) == pytest.approx(alone, rel=0.03)
    assert estimate_exposures(maps, by_name(images), ExposureConfig(), TOLD) == {}


def test_a_wrong_word_of_a_camera_that_alone_could_spoil_its_photograph_is_not_believed():
    found = gains_of(estimate_exposures(apart(), by_name(place()[1]), ExposureConfig(), TOLD | {"1": TOLD["1"] + 20.0}))
    assert found[1] == pytest.approx([1.0] * 3, rel=0.25)


def test_without_a_word_of_these_photographs_all_is_the_same_to_the_bit():
    maps, images = place()
    changed = by_name(exposed(images))
    plain, other = (
        estimate_exposures(maps, changed, ExposureConfig()),
        estimate_exposures(maps, changed, ExposureConfig(), {"elsewhere": 2.0}),
    )
    assert [each.gains for each in plain.values()] == [each.gains for each in other.values()]


def test_a_photograph_that_joins_others_and_shares_nothing_has_the_light_that_its_camera_tells():
    changed = by_name(exposed(place()[1], GREY[:, None]))
    lit = {name: Exposure((gain, gain, gain), 0.0, None) for name, gain in zip("0123", GREY[:4], strict=True)}
    in_light = {name: apply_exposure(image, lit[name]) if name in lit else image for name, image in changed.items()}
    (found,) = estimate_further_exposures(apart(), in_light, {"4": 0.0}, lit, ExposureConfig(), TOLD).values()
    assert np.array(found.gains) == pytest.approx([0.8] * 3, rel=0.03)
    told = {name: 0.0 for name in "0123"} | {"4": np.log(0.6)}
    (joined,) = estimate_further_exposures(apart(), changed, {"4": 0.0}, {}, ExposureConfig(), told).values()
    assert np.array(joined.gains) == pytest.approx([0.6] * 3, rel=0.03)
    assert (
        estimate_further_exposures(apart(), changed, {"4": 0.0}, {}, ExposureConfig(), told | {"4": np.log(0.9)}) == {}
    )
    assert estimate_further_exposures(apart(), changed, {"4": 0.0}, {}, ExposureConfig(), {"4": np.log(0.6)}) == {}
