"""Masks: found, read, turned as their photographs are, refused with a sentence; what they hide is gone at once."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import folder
from splatnode.capture.config import CaptureConfig, camera_opener
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.masks import (
    UnusableMask,
    apply_mask,
    fill_masked,
    mask_frames,
    open_masks,
    parse_mask,
    read_mask,
)
from splatnode.capture.process.config import load_config
from tests.capture.cameras.test_folder import ORIENTATION, with_exif

NOISE = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
MASK = np.ones((48, 64), bool)
MASK[30:, :40] = False
WHITE = 255


def frame(name="a.jpg", image=NOISE):
    return Frame(0, name, 0, image, None)


def mask_of(found):
    assert isinstance(found, Frame)
    return found.mask


def write(path, mask, white=WHITE):
    path.write_bytes(cv2.imencode(path.suffix, mask.astype(np.uint8) * white)[1].tobytes())
    return path


def test_what_is_hidden_is_filled_from_around_it_and_the_rest_is_as_it_was():
    picture = np.full((48, 64, 3), 90, np.uint8)
    picture[~MASK] = (255, 0, 255)
    found = apply_mask(frame(image=picture), MASK)
    assert isinstance(found, Frame) and found.encoded is None
    assert np.array_equal(found.image, np.full_like(picture, 90)) and np.array_equal(found.mask, MASK)
    assert np.array_equal(fill_masked(NOISE, MASK)[MASK], NOISE[MASK])


def test_the_fill_follows_its_surroundings():
    ramp = np.repeat(np.linspace(0, 255, 200)[None, :, None], 100, 0).repeat(3, 2).astype(np.uint8)
    hidden = np.ones((100, 200), bool)
    hidden[30:70, 80:120] = False
    assert (
        np.abs(fill_masked(np.where(hidden[..., None], ramp, 255).astype(np.uint8), hidden) - ramp.astype(int)).max()
        < 30
    )


def test_masks_of_one_frame_add_up():
    other = np.ones((48, 64), bool)
    other[:10] = False
    assert np.array_equal(mask_of(apply_mask(replace(frame(), mask=MASK), other)), MASK & other)


def test_a_mask_of_another_size_is_refused_with_both_sizes():
    expected = "32 x 24 pixels (aspect 1.333), its photograph 64 x 48 (aspect 1.333)"
    with pytest.raises(UnusableMask, match=re.escape(expected)):
        apply_mask(frame(), np.ones((24, 32), bool))


def test_a_photograph_of_which_the_mask_leaves_nearly_nothing_is_left_out():
    almost = np.zeros((48, 64), bool)
    almost[0, :30] = True
    found = apply_mask(frame(), almost)
    assert isinstance(found, DroppedFrame)
    assert "leaves 1.0 % of it" in found.reason and "black is ignored; is it inverted?" in found.reason


@pytest.mark.parametrize(("name", "white"), [("a.png", 255), ("a.png", 1), ("a.jpg.png", 255), ("a.tif", 255)])
def test_a_folder_has_masks_by_stem_or_whole_name(tmp_path, name, white):
    write(tmp_path / name, MASK, white)
    assert np.array_equal(open_masks(tmp_path)(frame()), MASK)
    assert open_masks(tmp_path)(frame("b.jpg")) is None


def test_the_noise_of_a_jpeg_is_no_mask(tmp_path):
    assert (read_mask(write(tmp_path / "a.jpg", MASK), frame()) == MASK).mean() > 0.999


def test_a_file_is_the_mask_of_all_photographs(tmp_path):
    find = open_masks(write(tmp_path / "body.png", MASK))
    assert all(np.array_equal(find(frame(name)), MASK) for name in ("a.jpg", "b.jpg"))


def test_photographs_without_a_mask_are_used_whole_and_told(tmp_path):
    write(tmp_path / "a.png", MASK)
    told = []
    found = list(
        mask_frames([frame("a.jpg"), frame("b.jpg"), DroppedFrame("c", "damaged")], open_masks(tmp_path), told.append)
    )
    assert mask_of(found[0]) is not None and mask_of(found[1]) is None and found[2].name == "c"
    assert told == ["used whole, because there is no mask of it: b.jpg"]


def test_folders_that_cannot_be_masks_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not there; give a folder of masks: white"):
        open_masks(tmp_path / "absent")
    with pytest.raises(UnusableMask, match="holds no masks; each must be an image named as its photograph"):
        open_masks(tmp_path)
    write(tmp_path / "a.png", MASK)
    write(tmp_path / "a.tif", MASK)
    with pytest.raises(UnusableMask, match=r"two masks of one photograph, a.png and a.tif; remove one"):
        open_masks(tmp_path)


def test_a_mask_that_is_no_image_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(UnusableMask, match=r"the mask a.png cannot be read: "):
        open_masks(tmp_path)(frame())


def test_a_mask_far_larger_than_its_photograph_is_not_decoded(tmp_path):
    path = tmp_path / "a.png"
    assert cv2.imwrite(str(path), np.zeros((4000, 4000), np.uint8))
    with pytest.raises(UnusableMask, match=r"a\.png cannot be read: .*pixels"):
        read_mask(path, Frame(0, "a.png", 0, np.zeros((40, 50, 3), np.uint8), None))


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_mask_turns_with_its_photograph(tmp_path, orientation):
    jpeg = cv2.imencode(".jpg", NOISE)[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(with_exif(jpeg, {ORIENTATION: orientation}))
    (photograph,) = folder.stream(folder.Config(tmp_path))
    upright = np.rot90(MASK, {3: 2, 6: -1, 8: 1}[orientation])
    of_upright = read_mask(write(tmp_path / "upright.png", upright), photograph)
    assert np.array_equal(of_upright, upright)
    if orientation != 3:  # as it is stored: another size tells that it was not turned
        assert np.array_equal(read_mask(write(tmp_path / "stored.png", MASK), photograph), upright)
    with_tag = with_exif(cv2.imencode(".jpg", MASK.astype(np.uint8) * WHITE)[1].tobytes(), {ORIENTATION: orientation})
    (tmp_path / "tagged.jpg").write_bytes(with_tag)
    assert (read_mask(tmp_path / "tagged.jpg", photograph) == upright).mean() > 0.999


def test_arrays_are_masks():
    for given in (MASK, MASK.astype(np.uint8), MASK * 255.0, np.repeat(MASK[..., None], 3, 2).astype(np.uint8)):
        assert np.array_equal(parse_mask(given), MASK)
    with pytest.raises(TypeError, match="a mask must be an array"):
        parse_mask(np.zeros(5))


def test_the_body_mask_of_a_camera_hides_the_same_of_every_frame(tmp_path):
    write(tmp_path / "body.png", MASK)
    (tmp_path / "camera.yaml").write_text(
        f"camera: {{kind: synthetic, views: 2, width: 64, height: 48}}\nbody_mask: {tmp_path / 'body.png'}\n"
    )
    config = load_config(tmp_path / "camera.yaml", CaptureConfig)
    frames = [each for each in camera_opener(config.camera, config.body_mask)() if isinstance(each, Frame)]
    assert [each.name for each in frames] == ["view_000.png", "view_001.png"]
    assert all(np.array_equal(mask_of(each), MASK) for each in frames)
    with pytest.raises(UnusableMask):
        list(camera_opener(config.camera, write(tmp_path / "small.png", MASK[:20]))())


def test_a_frame_takes_no_mask_of_another_kind():
    with pytest.raises(ValueError, match=r"mask must be \(48, 64\) bool, got \(48, 64\) uint8"):
        replace(frame(), mask=MASK.astype(np.uint8))
