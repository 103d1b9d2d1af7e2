"""EXIF's time of exposure: to the sub-second, in UTC where the time zone is stated, and never invented."""

from __future__ import annotations

import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.image_header import DATE_TIME_ORIGINAL, OFFSET_ORIGINAL, SUB_SECONDS_ORIGINAL, exif_time
from tests.capture.cameras.test_folder import tiff

DATE = "2024:05:06 10:00:07"
SHOWN_S = 1_714_989_607  # of a clock that shows DATE in UTC


def told(date=DATE, sub_seconds=None, offset=None, order=">"):
    texts = {DATE_TIME_ORIGINAL: date, SUB_SECONDS_ORIGINAL: sub_seconds, OFFSET_ORIGINAL: offset}
    return exif_time(tiff({}, {tag: text for tag, text in texts.items() if text is not None}, order))


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(
    ("sub_seconds", "ns"),
    [
        (None, 0), ("", 0), ("x", 0), ("5", 500_000_000), ("050 ", 50_000_000), ("250", 250_000_000),
        ("123456789", 123_456_789), ("1234567899", 123_456_789),
    ],
)  # fmt: skip
def test_sub_seconds_are_the_digits_after_the_second(sub_seconds, ns, order):
    assert told(sub_seconds=sub_seconds, order=order) == Stamp(SHOWN_S * 10**9 + ns, Clock.LOCAL)


@pytest.mark.parametrize(
    ("offset", "seconds"), [("+02:00", -7200), ("-03:30", 12_600), ("+00:00", 0), ("+14:00", -50_400)]
)
def test_with_the_time_zone_it_is_utc(offset, seconds):
    assert told(offset=offset) == Stamp((SHOWN_S + seconds) * 10**9, Clock.UTC)


@pytest.mark.parametrize("offset", ["   :  ", "+99:00", "+02:75", "Z", "\u0660"])
def test_a_time_zone_that_is_none_leaves_the_camera_s_own_clock(offset):
    assert told(offset=offset) == Stamp(SHOWN_S * 10**9, Clock.LOCAL)


@pytest.mark.parametrize(
    "date",
    [
        None, "", "0000:00:00 00:00:00", "    :  :     :  :  ", "2024:13:06 10:00:07", "2024:05:06 10:00:60",
        "1969:12:31 23:59:59", "2024:05:06", DATE + " and more", "x" * 5000,
    ],
)  # fmt: skip
def test_a_time_that_is_none_is_not_invented(date):
    assert told(date, sub_seconds="250", offset="+02:00") is None


def test_a_damaged_exif_part_tells_no_time():
    whole = tiff({}, {DATE_TIME_ORIGINAL: DATE})
    assert exif_time(whole) is not None
    assert {exif_time(whole[:end]) for end in range(len(whole) - 1)} == {None}
