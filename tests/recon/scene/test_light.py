"""Photographs that were exposed differently, or took another white for white, are brought to one light."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.light import Config, alike, differing, joining, log_gains, relit

PLACE = synthetic.Config(views=5, width=240, height=180)
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
        images.append((0.45 * synthetic.photograph(PLACE, (T, K), index)).astype(np.uint8))
    return maps, images


def exposed(images: list[np.ndarray], gains: np.ndarray = GAINS) -> list[np.ndarray]:
    return [np.clip(np.rint(image * own), 0, 255).astype(np.uint8) for image, own in zip(images, gains, strict=True)]


def by_name(images: list[np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{index}": image for index, image in enumerate(images)}


def test_gains_are_found_within_three_per_cent():
    maps, images = place()
    found = np.exp(log_gains(maps, exposed(images)))
    expected = GAINS / np.median(GAINS, axis=0)
    assert np.abs(found / expected - 1.0).max() < 0.03


def test_photographs_of_one_light_are_left_as_they_are():
    maps, images = place()
    assert np.abs(log_gains(maps, images)).max() < 0.03
    assert differing(maps, by_name(images), Config()) == {}


def test_a_small_difference_is_left_and_a_large_one_is_not_unless_it_is_switched_off():
    maps, images = place()
    slightly = exposed(images, np.array([1.0, 1.05, 1.0, 1.0, 0.95])[:, None])
    assert differing(maps, by_name(slightly), Config()) == {}
    widely = by_name(exposed(images))
    assert set(differing(maps, widely, Config())) == set(widely)
    assert differing(maps, widely, Config(enabled=False)) == {}
    assert differing(maps[:1], widely, Config()) == {}


def test_an_exposure_that_drifts_along_the_way_is_left_unless_it_drifts_far():
    maps, images = place()
    along = np.arange(len(maps)) - len(maps) // 2
    drifting = by_name(exposed(images, 1.2 ** along[:, None]))
    assert differing(maps, drifting, Config()) == {}
    far = by_name(exposed(images, 1.45 ** along[:, None]))
    assert set(differing(maps, far, Config())) == set(far)
    shuffled = by_name(exposed(images, 1.2 ** along[[2, 4, 0, 3, 1], None]))
    assert set(differing(maps, shuffled, Config())) == set(shuffled)


def test_one_light_gives_back_the_photographs():
    maps, images = place()
    changed = by_name(exposed(images))
    found = differing(maps, changed, Config())
    for name, image in by_name(images).items():
        off = np.abs(alike(changed[name], found[name]).astype(float) - image * np.median(GAINS, axis=0))
        assert np.median(off) <= 2.0  # a gain that is halved doubles what rounding took


def test_pixels_that_do_not_tell_their_brightness_are_known():
    maps, images = place()
    changed = by_name(exposed([np.minimum(2 * image.astype(int), 140).astype(np.uint8) for image in images]))
    found = differing(maps, changed, Config())
    brightest = found["2"].saturated
    assert brightest is not None and np.array_equal(brightest, changed["2"] >= 250) and brightest.any()
    assert found["0"].saturated is None  # darker than the median: what it shows white, others do, too


def test_photographs_that_share_nothing_keep_their_light():
    maps, images = place()
    away = np.eye(4)
    away[:3, 3] = 100.0
    apart = [maps[0], replace(maps[1], T_world_camera=away)]
    assert np.array_equal(log_gains(apart, exposed(images)[:2]), np.zeros((2, 3)))


def test_a_photograph_that_joins_others_gets_the_exposure_by_which_it_differs_from_them():
    maps, images = place()
    changed = by_name(exposed(images, np.where(np.arange(5)[:, None] == 4, [0.6, 0.5, 0.7], 1.0)))
    found = joining(maps, changed, {"4"}, False, Config())
    assert set(found) == {"4"} and np.abs(np.array(found["4"].gains) / [0.6, 0.5, 0.7] - 1.0).max() < 0.03


def test_a_photograph_that_joins_as_the_others_are_is_left_as_it_is_where_they_are():
    maps, images = place()
    alike_all = by_name(exposed(images, np.ones((5, 3))))
    assert joining(maps, alike_all, {"4"}, False, Config()) == {}
    assert joining(maps, alike_all, {"4"}, True, Config(enabled=False)) == {}
    (found,) = joining(maps, alike_all, {"4"}, True, Config()).values()
    assert np.abs(np.array(found.gains) - 1.0).max() < 0.03


def test_a_photograph_is_brought_to_the_light_of_its_scene_by_its_gains_alone():
    image = np.minimum(2 * exposed(place()[1])[2].astype(int), 255).astype(np.uint8)
    assert relit(image, None) == (image, None)
    shown, exposure = relit(image, (2.0, 2.0, 1.8))
    assert exposure is not None and np.array_equal(shown, alike(image, exposure))
    assert exposure.saturated is not None and np.array_equal(exposure.saturated, image >= 250)
