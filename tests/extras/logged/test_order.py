"""All images of a log come in the order of the times at which they were taken, whatever the log's own times are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.frame import Clock, DroppedFrame, Frame, Stamp
from splatnode.capture.reader import Config as Reading
from splatnode.capture.reader import Reader, ReaderState
from splatnode.extras.cameras.mcap import Config, stream
from splatnode.extras.logged import messages
from splatnode.extras.logged.mcap import topics
from tests.support.mcap_files import START_NS, compressed, write

COUNT, STEP_NS = 8, 100_000_000
UTC = [START_NS + STEP_NS * index for index in range(COUNT)]
SIMULATED = [STEP_NS * index for index in range(COUNT)]  # a simulation begins at 0
DISORDER = [3, 0, 1, 2, 7, 6, 5, 4]


def level(index: int) -> int:
    return 20 + 25 * index


def log_of(file: Path, headers_ns: list[int], logged_ns: list[int], lie: list[int] | None = None, **options) -> Path:
    """Images of levels that tell their numbers, in the file in the order of `lie`."""
    lie = list(range(len(headers_ns))) if lie is None else lie
    images = [np.full((48, 64, 3), level(index), np.uint8) for index in lie]
    told = [compressed("/image", image, header_ns=headers_ns[i]) for i, image in zip(lie, images, strict=True)]
    return write(file, told, log_ns=lambda place: logged_ns[lie[place]], **options)


def read_frames(file: Path) -> list[tuple[int, int, Stamp | None]]:
    """The number, the time in the stream and the time of capture of each image, through the reader of `record`."""
    found = []
    with Reader(lambda: stream(Config(file)), live=False, config=Reading()) as reader:
        while reader.state is not ReaderState.FINISHED:
            if (item := reader.next(0.05)) is not None:
                assert isinstance(item, Frame), item
                assert item.name == f"image_{len(found):06d}.png"
                number = round((float(item.image[24, 32, 0]) - level(0)) / 25)
                found.append((number, item.stamp_ns, item.captured_at))
    return found


@pytest.mark.parametrize("lie", [None, DISORDER, list(range(COUNT))[::-1]], ids=["in order", "mixed", "reversed"])
@pytest.mark.parametrize("chunk_size", [1000, 1 << 20])
@pytest.mark.parametrize(("headers_ns", "clock"), [(UTC, Clock.UTC), (SIMULATED, Clock.RECORDING)])
@pytest.mark.parametrize("logged_ns", [UTC, [START_NS] * COUNT], ids=["logged apart", "one log time"])
def test_the_headers_times_and_their_order(tmp_path, headers_ns, clock, logged_ns, lie, chunk_size):
    file = log_of(tmp_path / "a.mcap", headers_ns, logged_ns, lie, chunk_size=chunk_size)
    assert read_frames(file) == [(index, ns, Stamp(ns, clock)) for index, ns in enumerate(headers_ns)]


@pytest.mark.parametrize("lie", [None, DISORDER], ids=["in order", "mixed"])
def test_where_no_header_tells_a_time_it_is_the_logs(tmp_path, lie):
    file = log_of(tmp_path / "a.mcap", [0] * COUNT, UTC, lie)
    assert read_frames(file) == [(index, ns, Stamp(ns, Clock.UTC)) for index, ns in enumerate(UTC)]


def test_one_header_that_was_not_filled_in_has_the_logs_time(tmp_path):
    file = log_of(tmp_path / "a.mcap", [*UTC[:3], 0, *UTC[4:]], [ns + 5 for ns in UTC])
    assert [ns for _, ns, _ in read_frames(file)] == [*UTC[:3], UTC[3] + 5, *UTC[4:]]


def test_where_all_headers_tell_one_time_the_stream_has_the_logs(tmp_path):
    file = log_of(tmp_path / "a.mcap", [START_NS] * COUNT, UTC)
    assert read_frames(file) == [(index, ns, Stamp(START_NS, Clock.UTC)) for index, ns in enumerate(UTC)]


def test_images_of_one_time_keep_the_order_of_the_file(tmp_path):
    file = log_of(tmp_path / "a.mcap", [0] * COUNT, [START_NS] * COUNT, DISORDER)
    assert [number for number, *_ in read_frames(file)] == DISORDER


def test_what_waits_takes_no_more_than_its_memory(tmp_path, monkeypatch):
    """Of a file that lies backwards only three messages may wait, so it is read again and again."""
    lie = list(range(COUNT))[::-1]
    file = log_of(tmp_path / "a.mcap", UTC, UTC, lie, chunk_size=1000)
    plain, passes = messages.messages, list[int]()
    one = max(len(message.data) for message in plain(file, {"/image"}))
    monkeypatch.setattr(messages, "_MAX_HELD_BYTES", 3 * one)
    monkeypatch.setattr(messages, "messages", lambda *args: passes.append(1) or plain(*args))
    assert [number for number, *_ in read_frames(file)] == list(range(COUNT))
    assert len(passes) == 1 + 2, "once for the times, and once for each four: three that wait, and one that comes"


def test_a_damaged_file_in_disorder_gives_what_there_is_and_says_so(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (COUNT, 48, 64, 3)).astype(np.uint8)
    told = [compressed("/image", noise[index], header_ns=UTC[index]) for index in DISORDER]
    file = write(tmp_path / "a.mcap", told, chunk_size=5000)
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 6 // 10])
    *found, last = stream(Config(file))
    stamps = [item.stamp_ns for item in found if isinstance(item, Frame)]
    assert 2 < len(stamps) == len(found) < COUNT and stamps == sorted(stamps)
    assert isinstance(last, DroppedFrame) and last.name == "image_rest"


def test_an_image_that_cannot_be_read_is_named_where_it_lies(tmp_path):
    told = [compressed("/image", np.full((48, 64, 3), 9, np.uint8), header_ns=SIMULATED[1 + index]) for index in (0, 1)]
    (topic, schema, kind, definition, _) = told[0]
    file = write(tmp_path / "a.mcap", [told[0], (topic, schema, kind, definition, b"{}"), told[1]])
    first, broken, last = stream(Config(file))
    assert isinstance(first, Frame) and isinstance(broken, DroppedFrame) and isinstance(last, Frame)
    assert (broken.name, last.name) == ("image_000001.png", "image_000002.png")
    (known,) = topics(file)
    assert [each.place for each in messages.read_times(file, known)] == [0, 1, 2]
