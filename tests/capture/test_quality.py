from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.frame import Frame
from splatnode.capture.keyframe_selection import (
    Limits,
    Quality,
    assess,
    blur_width,
    novelty,
    why_redundant,
    why_unusable,
)
from tests.support import synthetic

LIMITS = Limits()


@pytest.fixture(scope="module")
def sharp() -> Frame:
    return synthetic.photographs()[0]


def box_edge(width: int, contrast: float = 120.0) -> np.ndarray:
    """Vertical bars whose edges are ramps of `width` pixels."""
    row = np.where(np.arange(640) // 40 % 2, 60 + contrast, 60.0)
    ramp = np.convolve(np.pad(row, width, mode="edge"), np.ones(width) / width, "same")[width:-width]
    return np.repeat(np.rint(np.broadcast_to(ramp, (480, 640)))[..., None], 3, 2).astype(np.uint8)


@pytest.mark.parametrize("contrast", [60.0, 180.0])
@pytest.mark.parametrize("width", [1, 4, 8])
def test_blur_is_the_width_of_edges_whatever_their_contrast(width, contrast):
    assert blur_width(box_edge(width, contrast)) == pytest.approx(width, abs=0.25)


@pytest.mark.parametrize("angle", [0, 45, 90, 135])
def test_motion_blur_is_found_in_every_direction(sharp, angle):
    before = blur_width(sharp.image)
    widths = [blur_width(synthetic.blurred(sharp, length, angle).image) for length in (3, 6, 12)]
    assert before is not None and before < 2
    assert widths == sorted(widths) and widths[0] > 1.3 * before and widths[-1] > 4 * before


def test_blur_does_not_depend_on_noise_or_exposure(sharp):
    noise = np.random.default_rng(0).normal(scale=4, size=sharp.image.shape)
    noisy = np.clip(sharp.image + noise, 0, 255).astype(np.uint8)
    expected = blur_width(sharp.image)
    assert blur_width(noisy) == pytest.approx(expected, rel=0.25)
    assert blur_width(synthetic.exposed(sharp, 0.4).image) == pytest.approx(expected, rel=0.25)


def test_exposure_shares():
    image = np.full((100, 100, 3), 128, np.uint8)
    image[:30], image[30:50] = 2, 255
    image[50:60] = (255, 0, 0)  # saturated colour still shows something
    quality = assess(image)
    assert (quality.dark, quality.bright) == (pytest.approx(0.3), pytest.approx(0.2))


@pytest.mark.parametrize(
    ("quality", "reason"),
    [
        (Quality(2.0, 0.7, 0.0, 40.0), None),  # an object on black
        (Quality(2.0, 0.98, 0.0, 40.0), "underexposed: 98%"),
        (Quality(2.0, 0.1, 0.89, 40.0), "overexposed: 89%"),
        (Quality(2.0, 0.0, 0.0, 0.4), "blank"),
        (Quality(None, 0.0, 0.0, 9.0), "no edges"),
        (Quality(9.5, 0.0, 0.0, 40.0), "edges are 9.5 px wide"),
    ],
)
def test_reasons(quality, reason):
    found = why_unusable(quality, LIMITS)
    assert found is None if reason is None else found is not None and reason in found


def test_a_frame_is_blurred_beside_sharper_ones():
    soft = Quality(4.0, 0.0, 0.0, 40.0)
    assert why_unusable(soft, LIMITS) is None
    assert why_unusable(soft, LIMITS, sharpest_px=2.0) is None
    assert "sharpest 1.2" in (why_unusable(soft, LIMITS, sharpest_px=1.2) or "")


def test_spoilt_frames_are_unusable(sharp):
    assert why_unusable(assess(sharp.image), LIMITS) is None
    assert "underexposed" in (why_unusable(assess(synthetic.exposed(sharp, 1e-4).image), LIMITS) or "")
    assert "overexposed" in (why_unusable(assess(synthetic.exposed(sharp, 1e4).image), LIMITS) or "")
    grain = np.random.default_rng(0).normal(128, 5, sharp.image.shape)
    assert "blank" in (why_unusable(assess(np.rint(grain).astype(np.uint8)), LIMITS) or "")
    smooth = synthetic.textureless()[0]
    assert why_unusable(assess(smooth.image), LIMITS) is not None


def test_novelty_tells_a_new_view_from_the_same_one():
    first, second = synthetic.photographs()[:2]
    noise = np.random.default_rng(0).normal(scale=3, size=first.image.shape)
    again = np.clip(first.image + noise, 0, 255).astype(np.uint8)
    moved = replace(first, image=np.roll(first.image, 1, axis=1))
    assert novelty(first.image, first.image) == 0
    assert why_redundant(novelty(first.image, again), LIMITS) is not None
    assert why_redundant(novelty(first.image, synthetic.exposed(first, 0.95).image), LIMITS) is not None
    assert why_redundant(novelty(first.image, moved.image), LIMITS) is None
    assert novelty(first.image, second.image) > 0.3
    assert novelty(first.image, first.image[:, 1:]) == float("inf")


def test_real_motion_blur_and_real_sharp_photographs(shared):
    scenes = shared / "scenes"

    def widths(scene: str, names: tuple[str, ...] = ()) -> list[float]:
        frames = folder.stream(folder.Config(scenes / scene / "images", names=names))
        return [blur_width(frame.image) or 99.0 for frame in frames if isinstance(frame, Frame)]

    sharp_names = ("000", "007", "014", "021")
    blurred_names = tuple(f"{index:03d}" for index in range(27) if f"{index:03d}" not in sharp_names)[::2]
    sharp, blurred = (widths("hard_blurball_motionblur", names) for names in (sharp_names, blurred_names))
    assert max(sharp) < 1.5 < 1.7 < min(blurred)
    for scene in ("hard_dino_lowtexture", "hard_temple_repeat"):
        images = folder.stream(folder.Config(scenes / scene / "images"))
        qualities = [assess(frame.image) for frame in images if isinstance(frame, Frame)]
        sharpest = min(quality.blur_px or 99.0 for quality in qualities)
        assert [why_unusable(quality, LIMITS, sharpest) for quality in qualities] == [None] * len(qualities)


def test_assessing_leaves_the_image_alone(sharp):
    image = sharp.image.copy()
    assess(image)
    novelty(image, image)
    assert np.array_equal(image, sharp.image)
    assert assess(cv2.resize(image, (40, 30), interpolation=cv2.INTER_AREA)).blur_px is not None


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 2)])
def test_the_thinnest_images_have_no_edges(shape):
    assert assess(np.zeros((*shape, 3), np.uint8)).blur_px is None
