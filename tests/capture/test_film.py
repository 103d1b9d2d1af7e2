"""The names by which recordings, and parts of them, are found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splatnode.capture import film
from splatnode.extras import batch
from splatnode.extras.audit import Film, find_recordings
from splatnode.extras.batch import Outcome
from splatnode.extras.batch.command import write_back
from tests.support.clips import level_images, write_clip

TIMES_MS = [0, 40, 80, 1080, 2080, 2120]


@pytest.fixture
def video(tmp_path) -> Path:
    return write_clip(tmp_path / "film.mp4", "libx264", level_images(6), TIMES_MS)


@pytest.mark.parametrize(
    ("part", "left"),
    [("t=0.08,2.08", [2, 3]), ("t=1", [3, 4, 5]), ("t=,1.08", [0, 1, 2]), ("t=2.1", [5]), ("t=0,9", [*range(6)])],
)
def test_seconds_of_a_video_are_a_part_of_it(video, part, left):
    found: list[Any] = list(film.stream(Path(f"{video}#{part}")))
    assert [frame.name for frame in found] == [f"film_{index:06d}.png" for index in left]
    assert [frame.stamp_ns for frame in found] == [TIMES_MS[index] * 10**6 for index in left]


@pytest.mark.parametrize(
    "part",
    ["3", "t=", "t=,", "t=2,1", "t=1,1", "t=-1,2", "t=1e3", "/front/image", "t=1,2,3", "t=2.1,", f"t={'9' * 200}"],
)
def test_what_is_no_range_of_seconds_is_refused(video, part):
    with pytest.raises(ValueError, match=r"behind the # must be seconds of the video, .* #t=10 or #t=,20.5; got"):
        film.stream(film.part_of(video, part))


def test_a_part_without_a_frame_says_so(video):
    with pytest.raises(ValueError, match=r"no frame between 0.5 and 1 s; convert"):
        list(film.stream(Path(f"{video}#t=0.5,1")))
    with pytest.raises(ValueError, match=r"no frame from 9 s on; convert"):
        list(film.stream(Path(f"{video}#t=9")))


def test_a_batch_and_an_audit_take_parts_of_a_video(video, tmp_path):
    part = Path(f"{video}#t=1,3")
    (one,) = batch.recordings([part], tmp_path / "out")
    assert (one.name, one.source) == ("film_t=1,3", str(part.resolve()))
    (visit,) = find_recordings([part])
    assert visit.problem == "" and list(visit.cameras.values()) == [Film(part)]
    row = Outcome(one.name, one.source, "OK", "", True, *[None] * 6, 1.0, None, 1.0, 0, 0.0)
    assert list(write_back([row], tmp_path / "out", in_place=False)) == [], "a video has nothing that is written into"
