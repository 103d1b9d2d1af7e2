"""What a camera says of its exposure: what it may be, what EXIF tells, and that all that carries frames keeps it."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import zmq

from splatnode.capture.cameras.folder import Config, stream
from splatnode.capture.frame import ExposureSettings, Frame, Intrinsics, parse_exposure, rename_frame
from splatnode.capture.image_header import exif_exposure, read_tags
from splatnode.capture.lenses import undistort_frame
from splatnode.capture.masks import apply_mask
from splatnode.capture.messaging.messages import (
    FrameHeader,
    Key,
    Limits,
    Numbering,
    WireError,
    decode,
    decode_frame,
    encode,
    encode_frame,
)
from splatnode.capture.recording import INDEX, Recorder, read
from splatnode.recon.daemon.ledger import file_name, read_frame, write_frame
from tests.capture.cameras.test_folder import encoded, tiff, with_exif

TOLD = ExposureSettings(0.008, 400.0, 2.0)
EXIF = {0x829A: (1, 125), 0x8827: 400, 0x829D: (20, 10)}
BEYOND = 2**32 - 1


def frame(exposure: ExposureSettings | None = TOLD) -> Frame:
    return Frame(0, "a.png", 0, np.zeros((24, 32, 3), np.uint8), None, exposure=exposure)


def test_light_grows_with_time_and_sensitivity_and_shrinks_with_the_square_of_the_f_number():
    assert TOLD.log_exposure == pytest.approx(math.log(0.008))
    for other, times in (
        (replace(TOLD, time_s=0.016), 2.0),
        (replace(TOLD, iso=200.0), 0.5),
        (replace(TOLD, f_number=4.0), 0.25),
    ):
        assert other.log_exposure - TOLD.log_exposure == pytest.approx(math.log(times))
    assert ExposureSettings(0.01, 100.0).log_exposure == pytest.approx(math.log(0.01))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ((0.0, 100.0), "the time of an exposure must be 1e-07 to 100000 seconds, got 0"),
        ((float("nan"), 100.0), "the time of an exposure must be"),
        ((0.01, 0.0), "the sensitivity of an exposure must be 1 to 1e[+]07 ISO, got 0"),
        ((0.01, float("inf")), "the sensitivity of an exposure must be"),
        ((0.01, 100.0, 0.0), "the f-number of an exposure must be 0.1 to 1000, got 0"),
    ],
)
def test_what_no_camera_has_is_refused_and_a_camera_that_tells_it_tells_nothing(told, said):
    with pytest.raises(ValueError, match=said):
        ExposureSettings(*told)
    assert parse_exposure(*told) == (ExposureSettings(*told[:2]) if len(told) == 3 else None)


@pytest.mark.parametrize("order", "<>")
def test_exif_tells_it(tmp_path, order):
    (tmp_path / "a.jpg").write_bytes(with_exif(encoded(), {}, EXIF, order))
    (tmp_path / "b.jpg").write_bytes(encoded())
    told, silent = (item for item in stream(Config(tmp_path)) if isinstance(item, Frame))
    assert (told.exposure, silent.exposure) == (TOLD, None)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({0x829D: (0, 0)}, ExposureSettings(0.008, 400.0)),
        ({0x829D: (0, 1)}, ExposureSettings(0.008, 400.0)),
        ({0x829D: (BEYOND, 1)}, ExposureSettings(0.008, 400.0)),
        ({0x829A: (0, 1)}, None),
        ({0x829A: (1, 0)}, None),
        ({0x829A: (BEYOND, 1)}, None),
        ({0x829A: "1/125"}, None),
        ({0x8827: 0}, None),
        ({0x8827: 65_535}, None),  # EXIF: more than 16 bits can say
    ],
)
def test_exif_that_tells_nothing_that_can_be_is_not_believed(changed, expected):
    assert exif_exposure(read_tags(tiff({}, EXIF | changed))) == expected


def test_damaged_exif_tells_none_and_raises_nothing():
    whole = tiff({}, EXIF)
    assert {exif_exposure(read_tags(whole[:end])) for end in range(len(whole))} == {None}
    rng = np.random.default_rng(0)
    for _ in range(500):
        damaged = bytearray(whole)
        for place in rng.integers(8, len(whole), 4):
            damaged[place] = rng.integers(256)
        found = exif_exposure(read_tags(bytes(damaged)))
        assert found is None or math.isfinite(found.log_exposure)


def test_a_message_without_it_is_that_of_a_splatnode_that_knows_none():
    both = frame(None), frame()
    without, having = (msgspec.msgpack.decode(encode_frame(each, Numbering("0" * 32))[1]) for each in both)
    assert set(having[0]) - set(without[0]) == {"exposure"}
    header = decode(encode_frame(frame(), Numbering()), FrameHeader).header
    fields = msgspec.to_builtins(header) | {"exposure": {"time_s": -1.0, "iso": 100.0}}
    with pytest.raises(WireError, match="the time of an exposure must be"):
        decode(encode(fields, [frame().image]), FrameHeader)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("exposure", [None, TOLD, ExposureSettings(0.5, 100.0)])
def test_messages_recordings_and_checkpoints_keep_it(tmp_path, exposure):
    numbering = Numbering()
    message = [zmq.Frame(bytes(part)) for part in encode_frame(frame(exposure), numbering)]
    sent = decode_frame(Key(numbering.session, 0), message, Limits()).frame
    assert isinstance(sent, Frame) and sent.exposure == exposure
    with Recorder(tmp_path / "recorded") as recorder:
        recorder.write(frame(exposure))
    (seen,) = read(tmp_path / "recorded").frames()
    assert isinstance(seen, Frame) and seen.exposure == exposure
    assert ("exposure" in (tmp_path / "recorded" / INDEX).read_text()) == (exposure is not None)
    path = tmp_path / file_name(3)
    write_frame(path, ("0" * 32, 0), frame(exposure))
    assert read_frame(path).frame.exposure == exposure


def test_a_frame_that_is_renamed_masked_or_undistorted_keeps_it():
    lens = Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0, "given", (0.05, 0.0, 0.0, 0.0))
    half = np.arange(32) < 16
    changed = (
        rename_frame(frame(), 3, "b.png", 7),
        apply_mask(frame(), np.tile(half, (24, 1))),
        undistort_frame(replace(frame(), intrinsics=lens)),
    )
    assert [each.exposure for each in changed if isinstance(each, Frame)] == [TOLD] * 3
