"""A depth image: what is one, and that messages, recordings, checkpoints and straightened frames keep it."""

from __future__ import annotations

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import zmq

from splatnode.capture.depth_image import (
    NOISES,
    DepthImage,
    DepthNoise,
    depth_arrays,
    describe_depth,
    describe_doubtful_unit,
    make_depth_image,
    read_depth,
)
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.image_file import encode_png
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.messaging.messages import (
    FrameHeader,
    Key,
    Limits,
    Numbering,
    decode,
    decode_frame,
    encode_frame,
    frame_in,
)
from splatnode.capture.recording import Recorder, read
from splatnode.recon.daemon.ledger import file_name, read_frame, write_frame

LENS = Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0, "calibration")
BESIDE = np.array([[1.0, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
STEPS = np.random.default_rng(0).integers(0, 5000, (3, 4)).astype(np.uint16)
METRES = np.array([[0.5, np.nan, 0.0, 2.25]] * 3, np.float32)
CONFIDENCE = np.random.default_rng(1).integers(0, 256, (3, 4)).astype(np.uint8)
DEPTHS = {
    "none": None,
    "millimetres": make_depth_image(STEPS),
    "metres": make_depth_image(METRES, noise="lidar"),
    "beside": make_depth_image(STEPS, 0.0002, LENS, BESIDE, DepthNoise(0.01, 0.002, 0.01), CONFIDENCE),
}


def frame(depth: DepthImage | None) -> Frame:
    return Frame(0, "a.png", 0, np.zeros((6, 8, 3), np.uint8), None, depth=depth)


def same(found: DepthImage | None, depth: DepthImage | None) -> bool:
    if depth is None or found is None:
        return found is depth
    apart = replace(found, values=depth.values, confidence=depth.confidence)
    fields = ("unit_m", "intrinsics", "T_camera_depth", "noise")
    alike = all(getattr(apart, name) == getattr(depth, name) for name in fields)
    equal = np.array_equal(found.values, depth.values, equal_nan=depth.values.dtype == np.float32)
    beside = (found.confidence is None) == (depth.confidence is None)
    return alike and equal and beside and (found.confidence is None or bool((found.confidence == CONFIDENCE).all()))


def test_whole_numbers_are_millimetres_and_floats_metres():
    assert make_depth_image(np.array([[1500]], np.uint16)).metres == pytest.approx(1.5)
    assert make_depth_image(np.array([[1.5]])).metres == pytest.approx(1.5)
    assert make_depth_image(np.array([[5000]], np.uint16), unit_m=1 / 5000).metres == pytest.approx(1.0)
    assert make_depth_image(np.array([[7]], np.int32).astype(np.uint32)).values.dtype == np.uint16


def test_what_is_not_known_or_not_believed_is_zero():
    assert make_depth_image(METRES).metres.tolist() == [[0.5, 0.0, 0.0, 2.25]] * 3
    assert make_depth_image(np.array([[-1.0, np.inf, 2000.0]])).metres.tolist() == [[0.0, 0.0, 0.0]]
    trusted = make_depth_image(STEPS, confidence=np.where(CONFIDENCE > 128, 255, 0).astype(np.uint8))
    assert ((trusted.metres > 0) == ((CONFIDENCE > 128) & (STEPS > 0))).all()


def test_noise_grows_with_the_square_of_the_depth():
    assert DepthNoise(0.002, 0.01).compute_sigma(np.array([1.0, 2.0])) == pytest.approx([0.012, 0.042])
    assert {"stereo", "structured_light", "time_of_flight", "lidar"} == NOISES.keys()


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: make_depth_image(np.zeros((2, 2, 3), np.uint16)), r"must be \(H, W\) uint16"),
        (lambda: make_depth_image(np.zeros((2, 2), np.uint8)), "uint16 of millimetres"),
        (lambda: make_depth_image(np.full((2, 2), 70_000, np.uint32)), "within 65535, got 70000"),
        (lambda: make_depth_image(np.zeros((0, 2), np.uint16)), "1 to"),
        (lambda: make_depth_image(STEPS, unit_m=0.0), "unit of a depth image"),
        (lambda: make_depth_image(STEPS, unit_m=float("nan")), "unit of a depth image"),
        (lambda: make_depth_image(STEPS, T_camera_depth=BESIDE), "lens of its own: give intrinsics"),
        (lambda: make_depth_image(STEPS, intrinsics=LENS, T_camera_depth=2 * np.eye(4)), "rigid motion"),
        (lambda: make_depth_image(STEPS, intrinsics=LENS, T_camera_depth=np.eye(3)), r"\(4, 4\)"),
        (
            lambda: make_depth_image(STEPS, intrinsics=LENS, T_camera_depth=BESIDE + 1000.0 * (BESIDE == 0.02)),
            "in metres",
        ),
        (lambda: make_depth_image(STEPS, confidence=np.zeros((2, 2), np.uint8)), r"must be \(3, 4\) uint8"),
        (lambda: make_depth_image(STEPS, noise="sonar"), "must be one of stereo"),
        (lambda: DepthNoise(-1.0, 0.0), "a_m"),
        (lambda: DepthNoise(0.0, 0.0), "above 1 nm"),
        (lambda: DepthNoise(0.0, 1e-320), "above 1 nm"),
        (lambda: make_depth_image(np.ones((3, 8), np.uint16), intrinsics=LENS), "shape of its lens, 8 x 6; got 8 x 3"),
        (lambda: DepthNoise(0.1, float("nan")), "b_per_m"),
    ],
)
def test_what_is_no_depth_image_is_refused(make, why):
    with pytest.raises(ValueError, match=why):
        make()


@pytest.mark.parametrize("depth", DEPTHS.values(), ids=DEPTHS.keys())
def test_messages_recordings_and_checkpoints_keep_it(tmp_path, depth):
    numbering = Numbering()
    parts = [zmq.Frame(bytes(part)) for part in encode_frame(frame(depth), numbering)]
    came = decode_frame(Key(numbering.session, 0), parts, Limits()).frame
    assert isinstance(came, Frame) and same(came.depth, depth)
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(depth))
    (seen,) = read(tmp_path / "recorded").frames()
    assert isinstance(seen, Frame) and same(seen.depth, depth)
    path = tmp_path / file_name(3)
    write_frame(path, ("0" * 32, 0), frame(depth))
    assert same(read_frame(path).frame.depth, depth)


def test_a_message_without_one_is_that_of_a_splatnode_that_knows_none():
    without, having = (
        msgspec.msgpack.decode(encode_frame(frame(DEPTHS[each]), Numbering("0" * 32))[1]) for each in ("none", "beside")
    )
    assert set(having[0]) == {*without[0], "depth"} and len(without[1]) == 1 and len(having[1]) == 3


def test_an_aligned_one_has_the_shape_of_its_image():
    with pytest.raises(ValueError, match=r"shape of its image, 8 x 6; got 8 x 3.*give the lens"):
        frame(make_depth_image(np.ones((3, 8), np.uint16)))
    assert frame(make_depth_image(np.ones((3, 8), np.uint16), intrinsics=LENS.resized(8, 3))).depth is not None


def test_arrays_that_are_no_depth_image_are_refused():
    header = decode(encode_frame(frame(DEPTHS["beside"]), Numbering()), FrameHeader).header
    image = np.zeros((6, 8, 3), np.uint8)
    for arrays in ([image, STEPS], [image, STEPS, STEPS], [STEPS, CONFIDENCE], [image, CONFIDENCE, CONFIDENCE]):
        with pytest.raises(ValueError, match="depth image|one image"):
            frame_in(header, 0, arrays)


def test_a_recorded_depth_image_that_was_changed_is_told(tmp_path):
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(DEPTHS["millimetres"]))
    (tmp_path / "recorded" / "000000-depth.png").write_bytes(encode_png(np.zeros((6, 8, 3), np.uint8)))
    (seen,) = read(tmp_path / "recorded").frames()
    assert seen == DroppedFrame("a.png", "000000-depth.png is not the file that was recorded")


def test_a_straightened_frame_keeps_the_pixels_of_its_depth_and_tells_their_lens():
    bent = replace(LENS, distortion=(-0.1, 0.0, 0.0, 0.0))
    aligned = undistort_frame(replace(frame(DEPTHS["millimetres"]), intrinsics=bent)).depth
    assert aligned is not None and aligned.intrinsics == bent and aligned.values is DEPTHS["millimetres"].values
    straight = undistort_frame(replace(frame(DEPTHS["millimetres"]), intrinsics=LENS)).depth
    assert straight is DEPTHS["millimetres"], "a pinhole's frame is not resampled"
    beside = undistort_frame(replace(frame(DEPTHS["beside"]), intrinsics=bent)).depth
    assert beside is DEPTHS["beside"], "a depth camera of its own lens keeps it"


def test_what_is_no_number_is_unknown_whoever_sends_it():
    values = np.array([[np.nan, np.inf, -np.inf, 2.0]], np.float32)
    sent = DepthImage(values, 1.0)
    for found in (make_depth_image(values), read_depth(describe_depth(sent), depth_arrays(sent))):
        assert found.values.tolist() == [[0.0, 0.0, 0.0, 2.0]] and found.values.dtype == np.float32


# Units that are probably others: what is far too near or too far for a depth camera.

ROOM = 1.0 + 3.0 * np.random.default_rng(2).random((40, 60))  # metres


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (np.rint(ROOM).astype(np.uint16), "hold whole millimetres; the median is [0-9.]+: probably metres; give float"),
        (np.rint(10 * ROOM).astype(np.uint16), "the median is 2[0-9.]*: probably another unit; .*tell unit_m"),
        ((1000 * ROOM).astype(np.float32), r"floats hold metres; the median is 2[0-9.]*: probably millimetres; divide"),
        (1000 * ROOM, "probably millimetres"),
    ],
)
def test_values_of_another_unit_are_refused_with_their_median_unless_the_unit_is_told(values, why):
    with pytest.raises(ValueError, match=why):
        make_depth_image(values)
    assert make_depth_image(values, unit_m=0.001).unit_m == 0.001
    few = np.zeros_like(values)
    few[:5] = values[:5]
    assert make_depth_image(few) is not None, "of a few pixels nothing is judged"


@pytest.mark.parametrize(
    ("depth", "doubt"),
    [
        (make_depth_image(np.rint(1000 * ROOM).astype(np.uint16)), ""),
        (make_depth_image(ROOM), ""),
        (make_depth_image(np.full((40, 60), 0, np.uint16)), ""),
        (make_depth_image((1000 * np.rint(ROOM)).astype(np.uint16)), "2400 pixels have 4 different depths alone"),
        (make_depth_image(200 * ROOM), "the median depth is 4[0-9.]+ m: where floats are no metres"),
        (DepthImage(np.rint(ROOM).astype(np.uint16)), "probably metres"),
    ],
)
def test_what_may_be_right_is_doubted_alone(depth, doubt):
    said = describe_doubtful_unit(depth)
    assert re.search(doubt, said) if doubt else said == "", said
