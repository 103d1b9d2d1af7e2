import math
from dataclasses import asdict, replace

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import LARGEST_IMAGE, DroppedFrame, Frame, Intrinsics, make_frame, rename_frame


def test_K_and_its_size_of_a_resized_image():
    intrinsics = Intrinsics(640, 480, fx=500.0, fy=510.0, cx=320.0, cy=236.0, source="given", distortion=(0.1,))
    assert np.array_equal(intrinsics.K, [[500, 0, 320], [0, 510, 236], [0, 0, 1]])
    half = intrinsics.resized(320, 240)
    assert (half.fx, half.fy, half.cx, half.cy) == (250.0, 255.0, 160.0, 118.0)
    assert (half.width, half.height, half.source, half.distortion) == (320, 240, "given", (0.1,))


@pytest.mark.parametrize("change", [{"width": 0}, {"fy": -1.0}, {"cx": math.nan}, {"distortion": (math.inf,)}], ids=str)
def test_what_no_lens_can_have_is_refused(change):
    with pytest.raises(ValueError, match="intrinsics must be finite"):
        replace(Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, source="given"), **change)


@pytest.mark.parametrize("skew", [0.0, 0.05])
def test_resizing_keeps_where_a_ray_meets_the_image(skew):
    # With the top-left pixel's centre at (0.5, 0.5), image coordinates scale without an offset.
    ray = np.array([0.3, -0.2, 1.0])
    intrinsics = Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, source="given", skew=skew)
    before, after = intrinsics.K @ ray, intrinsics.resized(960, 360).K @ ray
    assert np.allclose(after[:2], before[:2] * [1.5, 0.75])


@pytest.mark.parametrize(
    "image", [np.zeros((4, 5)), np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5, 3), np.float32)], ids=str
)
def test_a_frame_refuses_what_is_no_rgb_image(image):
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8"):
        Frame(0, "a.jpg", 0, image, None)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 65_536}, {"height": 2**62}, {"fx": 1e-300}, {"fy": 1e10}, {"cy": -1e10}, {"distortion": (0.0,) * 15},
        {"distortion": (1e300,)}, {"source": "\x1b[2J"}, {"source": ""}, {"model": "\x1b[2J"},
        {"model": "fisheye", "distortion": (0.0,) * 5},
    ],
    ids=str,
)  # fmt: skip
def test_what_no_camera_of_ours_has_is_refused(change):
    with pytest.raises(
        ValueError, match="intrinsics must be|distortion must be|the source of intrinsics|the model of a lens"
    ):
        replace(Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, source="given"), **change)


def image(height, width):
    """One that takes no memory."""
    return np.broadcast_to(np.uint8(0), (height, width, 3))


OUT_OF_BOUNDS = {
    "id": {"frame_id": -1}, "id of 64 bits": {"frame_id": 2**63}, "stamp": {"stamp_ns": -1},
    "stamp beyond": {"stamp_ns": 5 * 10**18}, "no name": {"name": ""}, "no pixels": {"image": image(0, 5)},
    "side": {"image": image(1, 65_536)}, "pixels": {"image": image(40_000, LARGEST_IMAGE // 40_000 + 1)},
}  # fmt: skip


@pytest.mark.parametrize("change", OUT_OF_BOUNDS.values(), ids=OUT_OF_BOUNDS)
def test_what_keeps_no_bounds_is_no_frame_and_is_left_out_with_the_reason(change):
    good = {"frame_id": 0, "name": "a.jpg", "stamp_ns": 0, "image": image(4, 5), "intrinsics": None}
    assert isinstance(make_frame(**good), Frame)
    with pytest.raises(ValueError):
        Frame(**(good | change))
    dropped = make_frame(**(good | change))
    assert isinstance(dropped, DroppedFrame) and dropped.reason.startswith("it cannot be used: ")
    if not {"image"} & change.keys():
        kept = {key: value for key, value in (good | change).items() if key not in ("image", "intrinsics")}
        assert rename_frame(Frame(**good), **kept) == dropped


def test_K_of_a_skew():
    intrinsics = Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, "estimated", skew=0.1)
    assert np.array_equal(intrinsics.K, [[500, 50, 320], [0, 510, 236], [0, 0, 1]])
    assert intrinsics.resized(1280, 240).skew == 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"skew": 1.5}, "the skew of intrinsics must be within 1 of 0, got 1.5"),
        ({"skew": -1.01}, "the skew of intrinsics must be within 1 of 0, got -1.01"),
        ({"skew": math.nan}, "intrinsics must be finite"),
        ({"skew": 0.1, "model": "fisheye"}, "must be 0 for the model fisheye, which has none, got 0.1"),
    ],
    ids=str,
)
def test_a_skew_that_cannot_be_is_named(change, said):
    with pytest.raises(ValueError, match=said):
        replace(Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, source="estimated"), **change)


def test_a_lens_with_skew_is_the_same_after_it_was_stored_and_one_stored_before_has_none():
    lens = Intrinsics(640, 480, 500.0, 510.0, 320.0, 236.0, "estimated", (0.1, 0.0, 0.0, 0.0), skew=0.05)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(lens), type=Intrinsics) == lens
    assert msgspec.json.decode(msgspec.json.encode(lens), type=Intrinsics) == lens
    before = {name: value for name, value in asdict(lens).items() if name != "skew"}
    assert msgspec.convert(before, Intrinsics) == replace(lens, skew=0.0)


def test_frame_size():
    frame = Frame(0, "a.jpg", 0, np.zeros((4, 5, 3), np.uint8), None)
    assert (frame.width, frame.height) == (5, 4)


def test_intrinsics_of_numpy_numbers_are_plain_ones():
    """As of a matrix K: no message takes NumPy's."""
    K = np.array([[500.0, 0, 320], [0, 501.0, 240], [0, 0, 1]])
    sides, terms = (np.int64(640), np.int64(480)), tuple(np.zeros(4))
    made = Intrinsics(*sides, K[0, 0], K[1, 1], K[0, 2], K[1, 2], "given", terms, skew=K[0, 1])
    numbers = made.width, made.height, made.fx, made.fy, made.cx, made.cy, made.skew, *made.distortion
    assert [type(number) for number in numbers] == [int, int, *[float] * 9]
