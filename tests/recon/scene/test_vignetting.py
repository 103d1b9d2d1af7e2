"""A lens that dims its corners: its falloff is found from photographs of one place, and taken out."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.priors import Pointmap
from splatnode.recon.scene.exposure import (
    ExposureConfig,
    SharedPixels,
    apply_exposure,
    compensate_image,
    compute_squared_radius,
    estimate_exposures,
    estimate_falloffs,
    estimate_further_exposures,
    find_shared_pixels,
    relative_illumination,
    remove_falloff,
)
from tests.recon.scene.test_light import LIT, by_name, exposed, place

FALLOFF = 0.9  # two fifths of the light reach the corners


def dimmed(images: list[np.ndarray], falloff: float = FALLOFF) -> list[np.ndarray]:
    light = relative_illumination(falloff, images[0].shape[1], images[0].shape[0])[..., None]
    return [np.rint(image * light).astype(np.uint8) for image in images]


def found_in(maps: list[Pointmap], images: list[np.ndarray], lens_of: list[int] | None = None, least: float = 0.5):
    return estimate_falloffs(find_shared_pixels(maps, images), lens_of or [0] * len(maps), least)[0]


def test_light_falls_off_to_what_reaches_the_corners():
    light = relative_illumination(FALLOFF, 200, 150)
    assert light.shape == (150, 200) and light.max() == pytest.approx(1.0, abs=1e-3)
    assert light[0, 0] == light[-1, -1] == pytest.approx(np.exp(-FALLOFF), rel=0.02)
    assert compute_squared_radius(199.5, 149.5, 200, 150) == pytest.approx(1.0)
    assert (relative_illumination(0.0, 20, 10) == 1.0).all()


def test_a_falloff_is_found_whatever_the_gains():
    maps, images = place()
    assert found_in(maps, dimmed(images)) == pytest.approx(FALLOFF, abs=0.08)
    assert found_in(maps, exposed(dimmed(images))) == pytest.approx(FALLOFF, abs=0.08)


def test_a_lens_without_falloff_or_with_little_of_it_keeps_it():
    maps, images = place()
    assert not found_in(maps, images).any()
    assert not found_in(maps, dimmed(images, 0.3)).any()
    assert not found_in(maps[:2], dimmed(images[:2])).any()  # two photographs cannot contradict each other


def test_each_lens_has_its_own_falloff():
    maps, images = place()
    apart = [*dimmed(images[:3]), *images[3:]]
    assert found_in(maps, apart, [0, 0, 0, 1, 1]) == pytest.approx([FALLOFF] * 3 + [0.0] * 2, abs=0.12)


def test_ratios_of_colours_are_as_without_falloff():
    shared = SharedPixels((0, 1), np.log([[2.0, 2.0, 2.0]]), np.array([[1.0, 0.5]]))
    (plain,) = remove_falloff([shared], np.array([0.8, 0.2]))
    assert plain.logs == pytest.approx(np.log(2.0) + 0.8 * 1.0 - 0.2 * 0.5)


def test_photographs_are_brought_to_what_a_lens_without_falloff_shows():
    maps, images = place()
    changed = by_name(dimmed(images))
    found = estimate_exposures(maps, changed, ExposureConfig())
    assert set(found) == set(changed) and all(each.gains == (1.0, 1.0, 1.0) for each in found.values())
    for name, image in by_name(images).items():
        off = np.abs(apply_exposure(changed[name], found[name]).astype(float) - image)
        assert np.mean(off) < 4.0 < np.abs(changed[name].astype(float) - image).mean()
    assert estimate_exposures(maps, changed, ExposureConfig(least_falloff=1.2)) == {}
    assert estimate_exposures(maps, changed, ExposureConfig(enabled=False)) == {}


def test_falloff_and_gains_are_found_together():
    maps, images = place()
    found = estimate_exposures(maps, by_name(exposed(dimmed(images))), ExposureConfig())
    alone = estimate_exposures(maps, by_name(exposed(images)), ExposureConfig())
    for name, exposure in found.items():
        assert exposure.falloff == pytest.approx(FALLOFF, abs=0.08)
        assert exposure.gains == pytest.approx(alone[name].gains, rel=0.05)


def test_a_photograph_that_joins_gets_the_light_of_the_scene_by_its_lens():
    maps, images = place()
    changed = by_name([*images[:4], *dimmed(images[4:])])
    (found,) = estimate_further_exposures(maps, changed, {"4": FALLOFF}, LIT, ExposureConfig()).values()
    assert found.falloff == FALLOFF and found.gains == pytest.approx((1.0, 1.0, 1.0), rel=0.04)
    image, exposure = compensate_image(changed["4"], found.gains, found.falloff)
    assert exposure is not None and exposure.falloff == FALLOFF
    assert np.abs(image.astype(float) - images[4]).mean() < 4.0


def test_dim_corners_are_not_called_saturated_and_bright_ones_are_not_believed():
    white = np.full((30, 40, 3), 255, np.uint8)
    image, exposure = compensate_image(white, (2.0, 2.0, 2.0), 0.5)
    assert exposure is not None and exposure.saturated is not None and exposure.saturated[15, 20].all()
    assert image[0, 0, 0] > image[15, 20, 0]
    _, dark = compensate_image(white, (1.0, 1.0, 1.0), 0.5)
    assert dark is not None and dark.saturated is None
