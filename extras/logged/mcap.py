"""The topics of an MCAP file, and the messages of some of them, in the order of the file. Needs the extra mcap.

Where the file has an index, only the chunks that hold these topics are read; one without, such as that of a robot that
lost its power, is read from its beginning as far as it goes.
"""

from __future__ import annotations

import contextlib
import io
import os
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.text import guard_untrusted, sanitize_text

_MOST_BYTES = 1 << 29  # of a record, and of what it is decompressed to
_MOST_TIMES = 256  # the bytes of a file, and _MOST_BYTES beside, to which all its chunks are decompressed; lz4 has 255


class UnusableLog(ValueError):
    """A file that is no MCAP file, or that ends within a record; the text says which."""


@dataclass(frozen=True)
class Topic:
    """A topic of a log, and the kind of its messages."""

    name: str
    schema: str  # its name
    encoding: str  # of the messages: json, protobuf, cdr, ...

    @property
    def kind(self) -> tuple[str, str]:
        return self.schema, self.encoding


@dataclass(frozen=True, eq=False)
class Message:
    topic: Topic
    log_ns: int  # when it was written down, mostly since 1970
    data: bytes


def topics(file: Path) -> list[Topic]:
    """All topics, by name. Raises UnusableLog, OSError; ModuleNotFoundError without mcap."""
    from mcap.exceptions import EndOfFile
    from mcap.records import Channel, Schema

    known = _TopicTable()
    with _open_log(file) as stream:
        summary = _summary(stream)
        records = _records(stream) if summary is None else [*summary.schemas.values(), *summary.channels.values()]
        with contextlib.suppress(EndOfFile):  # what there is before the end counts
            for record in records:
                if isinstance(record, (Schema, Channel)):
                    known.add(record)
    return sorted({topic for topic in known.topics.values()}, key=lambda topic: topic.name)


def messages(file: Path, wanted: Collection[str]) -> Iterator[Message]:
    """The messages of the topics of these names.

    Raises UnusableLog, after the messages before it where it is about a later one; OSError; ModuleNotFoundError
    without mcap.
    """
    from mcap.records import Channel, Schema
    from mcap.records import Message as Record

    known = _TopicTable()
    with _open_log(file) as stream:
        for record in _read_topic_records(stream, wanted, known):
            if isinstance(record, (Schema, Channel)):
                known.add(record)
            elif isinstance(record, Record) and known.topics[record.channel_id].name in wanted:
                yield Message(known.topics[record.channel_id], record.log_time, record.data)


class _TopicTable:
    """The topics that a file has told of so far."""

    def __init__(self) -> None:
        self.topics: dict[int, Topic] = {}  # by the channel's number
        self._schemas: dict[int, str] = {}

    def add(self, record: Any) -> None:
        """A Schema or a Channel of mcap."""
        if hasattr(record, "topic"):
            schema = self._schemas.get(record.schema_id, "")
            self.topics[record.id] = Topic(record.topic, schema, record.message_encoding)
        else:
            self._schemas[record.id] = record.name


@contextlib.contextmanager
def _open_log(file: Path) -> Iterator[IO[bytes]]:
    with (
        file.open("rb") as stream,
        guard_untrusted(UnusableLog, f"{sanitize_text(str(file))!r} is no MCAP file that is whole"),
    ):
        yield stream


def _read_topic_records(stream: IO[bytes], wanted: Collection[str], known: _TopicTable) -> Iterator[Any]:
    """The records of the chunks that may hold these topics, or all; what the index knows is added to `known`."""
    summary = _summary(stream)
    if summary is None or not summary.chunk_indexes:
        yield from _records(stream)
        return
    for record in (*summary.schemas.values(), *summary.channels.values()):
        known.add(record)
    channels = {number for number, topic in known.topics.items() if topic.name in wanted}
    offsets = {
        chunk.chunk_start_offset
        for chunk in summary.chunk_indexes
        if not (channels.isdisjoint(chunk.message_index_offsets) and chunk.message_index_offsets)
    }
    yield from unpack_chunks(_read_chunks(stream, sorted(offsets)), stream)


def _read_chunks(stream: IO[bytes], offsets: Sequence[int]) -> Iterator[Any]:
    """The chunks at these rising places, none of which begins within another one.

    So all of them together are no longer than the file, however many an index names.
    """
    num_bytes, behind = stream.seek(0, io.SEEK_END), 0
    for offset in offsets:
        if offset >= num_bytes:  # a place that cannot be sought would be an error of the disk's
            raise UnusableLog(f"its index leads to byte {offset}, it has {num_bytes}")
        if offset < behind:
            raise UnusableLog(f"its index leads to byte {offset}, within a chunk that goes on to byte {behind}")
        stream.seek(offset)
        chunk = next(_reader(stream, skip_magic=True).records)
        behind = stream.tell()
        yield chunk


def _summary(stream: IO[bytes]) -> Any:
    """The index at the end of the file; None where it has none."""
    from mcap.reader import SeekingReader

    stream.seek(0)
    reader = SeekingReader(stream, record_size_limit=_MOST_BYTES)
    try:
        return reader.get_summary()
    except Exception as error:  # its end is not there; what the parser meets instead may be anything
        raise_shortage(error)
        return None


def _records(stream: IO[bytes]) -> Iterator[Any]:
    stream.seek(0)
    yield from unpack_chunks(_reader(stream).records, stream)


def unpack_chunks(records: Iterable[Any], stream: IO[bytes]) -> Iterator[Any]:
    """The records of a file, those of chunks unpacked one after the other.

    A chunk of 20 kB may hold half a gigabyte of zeros, and a file thousands of those: hours of work for nothing. Raises
    UnusableLog where a chunk, or all so far together, hold more than any log does.
    """
    from mcap.records import Chunk

    num_bytes = os.fstat(stream.fileno()).st_size
    most, declared_size = _MOST_TIMES * num_bytes + _MOST_BYTES, 0
    for record in records:
        if isinstance(record, Chunk):
            declared_size += record.uncompressed_size
            if declared_size > most:
                raise UnusableLog(
                    f"its {num_bytes} bytes may be decompressed to {most}, its chunks say that they hold "
                    f"{declared_size} or more"
                )
        yield from unpack_chunk(record)


def unpack_chunk(record: Any) -> Iterator[Any]:
    """Unpacks a chunk; yields any other record itself. Raises UnusableLog where it would take too much memory."""
    from mcap.records import Chunk

    if not isinstance(record, Chunk):
        yield record
        return
    if record.uncompressed_size > _MOST_BYTES:
        raise UnusableLog(f"a chunk must have at most {_MOST_BYTES} bytes, it has {record.uncompressed_size}")
    yield from _inside(_decompress_chunk(record))


def _inside(chunk: Any) -> Iterator[Any]:
    """The records of a chunk, one after the other: millions of them, which half a gigabyte may hold, take more memory.

    Raises UnusableLog where they are not those that were written.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    if chunk.compression:
        raise UnusableLog(
            f"a chunk must be compressed by lz4, zstd or not, it is by {sanitize_text(chunk.compression, 40)!r}"
        )
    if chunk.uncompressed_crc and zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise UnusableLog("a chunk does not hold what was written: its checksum is another one")
    stream = ReadDataStream(io.BytesIO(chunk.data))
    while stream.count < len(chunk.data):
        opcode, length = stream.read1(), stream.read8()
        if opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _decompress_chunk(chunk: Any) -> Any:
    """The chunk as one that is not compressed: no more of it is decompressed than it says that it holds."""
    declared_size, is_whole = chunk.uncompressed_size, True
    if chunk.compression == "lz4":
        import lz4.frame

        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(chunk.data, max_length=declared_size + 1)
        is_whole = decompressor.eof
    elif chunk.compression == "zstd":
        import zstandard

        data = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(chunk.data)).read(declared_size + 1)
    else:  # none, or one that mcap does not know and names
        return chunk
    if len(data) != declared_size or not is_whole:
        raise UnusableLog(f"a chunk says that it holds {declared_size} bytes, and holds more or fewer")
    return replace(chunk, compression="", data=data)


def _reader(stream: IO[bytes], skip_magic: bool = False) -> Any:
    from mcap.stream_reader import StreamReader

    make: Callable = StreamReader
    return make(stream, skip_magic=skip_magic, emit_chunks=True, record_size_limit=_MOST_BYTES)
