"""trajectory.tum: the columns are those of the benchmark, and other programs' trajectories meet it by its times."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.recon.result.export.formats.tum import encode_tum
from tests.support.exported import make_camera

BEGAN_NS = 1_714_989_607_000_000_000


def at(frame_id, ns, clock=Clock.UTC):
    """The camera of a frame, which is at x = `frame_id`."""
    return replace(make_camera(frame_id), captured_at=None if ns is None else Stamp(ns, clock))


def read(content: bytes) -> tuple[list[str], list[tuple[str, list[float]]]]:
    """The comments, and the time and the seven numbers of each line, as the format is defined."""
    lines = content.decode().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    return [line for line in lines if line.startswith("#")], [(row[0], [float(x) for x in row[1:]]) for row in rows]


def associated(first: list[float], second: list[float], most_s: float = 0.02) -> list[tuple[int, int]]:
    """The benchmark's rule: of all pairs less than `most_s` apart the closest first, each time once."""
    apart = [(abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) < most_s]
    found: dict[int, int] = {}
    for _, i, j in sorted(apart):
        if i not in found and j not in found.values():
            found[i] = j
    return sorted(found.items())


def test_positions_and_xyzw():
    camera = make_camera(2, angle=np.pi / 2)
    _, [(time, row)] = read(encode_tum([camera]))
    assert time == "2" and row[:3] == [2, -0.5, 0.25]
    assert np.allclose(row[3:], [0, np.sqrt(0.5), 0, np.sqrt(0.5)])


def test_times_have_nanoseconds_and_are_in_their_order():
    comments, rows = read(encode_tum([at(0, BEGAN_NS + 1_000_000_007), at(1, BEGAN_NS), at(2, BEGAN_NS)]))
    assert [time for time, _ in rows] == ["1714989607.000000000"] * 2 + ["1714989608.000000007"]
    assert [row[0] for _, row in rows] == [1, 2, 0]
    assert comments[0].startswith("# time (seconds since 1970, UTC), x y z")


@pytest.mark.parametrize("clock", Clock)
def test_the_file_says_by_which_clock(clock):
    comments, _ = read(encode_tum([at(0, 5, clock)]))
    assert f"(seconds {clock.meaning})" in comments[0]


@pytest.mark.parametrize(
    ("cameras", "why"),
    [
        ([at(3, None), at(1, None)], "photographs without a time stamp: 2 of 2"),
        ([at(3, BEGAN_NS), at(1, None)], "photographs without a time stamp: 1 of 2"),
        ([at(3, BEGAN_NS), at(1, 2 * BEGAN_NS, Clock.LOCAL)], "of different clocks: local, utc"),
    ],
)
def test_without_one_clock_for_all_the_frames_are_numbered_and_the_file_says_why(cameras, why):
    comments, rows = read(encode_tum(cameras))
    assert [time for time, _ in rows] == ["1", "3"]
    assert comments[0].startswith("# time (frame id; ") and why in comments[0]


def test_every_line_is_one_that_the_benchmark_s_tools_accept():
    """A comment, or eight decimal numbers with one space between: seconds, x y z, and a unit quaternion x y z w."""
    number = r"-?[0-9]+(\.[0-9]+)?(e-?[0-9]+)?"
    for cameras in ([at(index, BEGAN_NS + index) for index in range(3)], [make_camera(4, angle=3.1), at(7, None)]):
        content = encode_tum(cameras).decode("ascii")
        assert content.endswith("\n") and "\r" not in content and "\t" not in content
        rows = [line for line in content.splitlines() if not line.startswith("#")]
        assert len(rows) == len(cameras)
        for row in rows:
            assert re.fullmatch(f"{number}( {number}){{7}}", row), row
            assert math.isclose(math.hypot(*map(float, row.split()[4:])), 1)


def test_odometry_of_the_same_clock_is_associated_with_the_cameras():
    """A camera every 0.4 s beside odometry at 50 Hz that began earlier: the same metre at the same time."""
    cameras = [at(index, BEGAN_NS + 400_000_000 * index + 3_000_000) for index in range(5)]
    _, rows = read(encode_tum(cameras[::-1]))
    start = BEGAN_NS // 10**9 - 1
    odometry = [(start + index / 50, (index / 50 - 1) / 0.4) for index in range(200)]  # time, x
    pairs = associated([float(time) for time, _ in rows], [time for time, _ in odometry])
    assert len(pairs) == 5
    assert np.allclose([rows[i][1][0] for i, _ in pairs], [odometry[j][1] for _, j in pairs], atol=0.01)
    earlier = [time - 100 for time, _ in odometry]
    assert not associated([float(time) for time, _ in rows], earlier)
