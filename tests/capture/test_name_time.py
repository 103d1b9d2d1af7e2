"""The time in a file's name: of every common form, to the nanosecond, and never guessed."""

from __future__ import annotations

import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.capture.image_header import name_time

SHOWN_S = 1_706_715_901  # of a clock that shows 2024-01-31 15:45:01 in UTC


@pytest.mark.parametrize(
    ("name", "ns"),
    [
        ("1341847980.722988.png", 1_341_847_980_722_988_000),
        ("1305031102.1.png", 1_305_031_102_100_000_000),
        ("rgb_1341847980.722988123.jpg", 1_341_847_980_722_988_123),
        ("frame_1700000000123.png", 1_700_000_000_123_000_000),
        ("1700000000123456.png", 1_700_000_000_123_456_000),
        ("1403636579763555584.png", 1_403_636_579_763_555_584),
        ("cam0-1403636579763555584.png", 1_403_636_579_763_555_584),
        ("0007_1700000000123_left.JPG", 1_700_000_000_123_000_000),
        ("1700000000123", 1_700_000_000_123_000_000),
    ],
)
def test_a_number_that_counts_from_1970_is_utc(name, ns):
    assert name_time(name) == Stamp(ns, Clock.UTC)


@pytest.mark.parametrize(
    ("name", "ns"),
    [
        ("20240131_154501.jpg", 0),
        ("IMG_20240131_154501.jpg", 0),
        ("IMG_20240131_154501_HDR.jpg", 0),
        ("PXL_20240131_154501123.jpg", 123_000_000),
        ("20240131154501.png", 0),
        ("20240131-154501.250.png", 250_000_000),
        ("2024-01-31 15.45.01.heic", 0),
        ("2024-01-31_15-45-01.jpg", 0),
        ("Screenshot_2024-01-31-15-45-01.png", 0),
        ("Photo 2024-01-31 at 15.45.01.jpeg", 0),
        ("2024-01-31T15:45:01.123456.png", 123_456_000),
        ("20240131_154501123456789.png", 123_456_789),
    ],
)
def test_a_date_and_a_time_are_of_a_clock_whose_zone_is_not_known(name, ns):
    assert name_time(name) == Stamp(SHOWN_S * 10**9 + ns, Clock.LOCAL)


@pytest.mark.parametrize("name", ["20240131T154501Z.png", "2024-01-31T15:45:01Z.png", "cam_20240131T154501z_left.png"])
def test_z_says_utc(name):
    assert name_time(name) == Stamp(SHOWN_S * 10**9, Clock.UTC)


@pytest.mark.parametrize(
    "name",
    [
        # No time at all.
        "IMG_1234.jpg", "000123.png", "DSC01234.JPG", "a.png", "", "20240131.jpg", "IMG-20240131-WA0003.jpg",
        # A number that may be another one: of too few or too many digits, or outside 2001 to 2033.
        "1341847980.png", "17000000001.png", "170000000012345.png", "0000000000001.png", "9700000000123.png",
        "78150445_10153459384.jpg", "11700000000123.png", "1341847980.7229881234.png",
        # No day, no hour, or the day first.
        "20241331_154501.jpg", "20240230_154501.jpg", "20240131_254501.jpg", "20240131_154560.jpg",
        "31012024_154501.jpg", "2024-01_31_154501.jpg", "2024-01-31 at 03.45.01 PM.png", "2024-01-31 at 03.45.01pm.png",
        # A tail that may be a fraction or a counter.
        "20240131_1545011.jpg", "20240131_154501.5.jpg",
        # The time of a whole sequence, with a number for each image; two times.
        "20240131_154501_0001.png", "20240131_154501 (1).jpg", "1700000000123_0001.png",
        "VID_20240131_154501_000012.png", "20240131_154501_1700000000123.png", "1341847980.722988-1341847981.5.png",
    ],
)  # fmt: skip
def test_a_name_that_can_be_read_in_two_ways_tells_no_time(name):
    assert name_time(name) is None
