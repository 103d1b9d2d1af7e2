"""A stored message comes back as it was, or its file is named as what it is."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatnode.capture.messaging.keyframe_queue import MessageFileError, read_message, write_message
from splatnode.capture.messaging.messages import MAGIC, VERSION

EDGES = (0, 1, 7, 8, 9, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)


def crafted(count: int, body: bytes, size: int | None = None) -> bytes:
    size = len(body) if size is None else size
    return struct.pack("<8sIQI", b"SPLSPOOL", count % 2**32, size, zlib.crc32(body)) + body


def part(content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<Q", len(content) if length is None else length) + content


@given(st.lists(st.binary(max_size=50), max_size=5))
def test_parts_come_back(tmp_path_factory, parts):
    path = tmp_path_factory.mktemp("messages") / "one"
    write_message(path, parts)
    assert [bytes(each) for each in read_message(path)] == parts


@pytest.mark.parametrize("version", range(1, VERSION))
def test_a_file_of_an_earlier_version_is_a_message_of_today(tmp_path, version):
    write_message(tmp_path / "one", [MAGIC[:-1] + bytes([version]), b"head"])
    assert [bytes(each) for each in read_message(tmp_path / "one")] == [MAGIC, b"head"]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"SPLSPOOL",
        *(crafted(count, part(b"one")) for count in (0, 2, 2**31, 2**32 - 1)),
        *(crafted(1, part(b"one", length)) for length in EDGES),
        *(crafted(1, part(b"one"), size) for size in EDGES),
        crafted(1, b"1234567"),
        crafted(1, part(b"one") + b"more"),
        crafted(2, part(b"one") + part(b"two", 2**64 - 8)),
    ],
)
def test_crafted_sizes_are_an_error_of_the_file(tmp_path, content):
    (tmp_path / "one.frame").write_bytes(content)
    with pytest.raises(MessageFileError, match="one.frame"):
        read_message(tmp_path / "one.frame")


@given(st.binary(max_size=200), st.integers(0, 2**32 - 1))
def test_any_body_at_all(tmp_path_factory, body, count):
    path = tmp_path_factory.mktemp("messages") / "one"
    path.write_bytes(crafted(count, body))
    try:
        parts = read_message(path)
    except MessageFileError:
        return
    assert b"".join(part(bytes(each)) for each in parts) == body and len(parts) == count
