"""Messages of Foxglove's schemas as an MCAP file, or added to one that is there. Needs the extra mcap."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import IO, Any

from mcap.records import Attachment, Channel, DataEnd, Header, Metadata, Schema
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.extras.logged.mcap import UnusableLog, unpack_chunks
from splatnode.extras.viewers.mcap import Message, add_messages, encode_mcap


def encode_messages(messages: Sequence[Message], schemas: Mapping[str, str]) -> bytes:
    """The file; `schemas` names that of each topic."""
    return encode_mcap(Writer, messages, schemas)


def write_with_messages(source: Path, target: Path, messages: Sequence[Message], schemas: Mapping[str, str]) -> None:
    """Writes all that `source` holds to `target`, then `messages`; earlier ones of their topics are left out.

    The messages, attachments and metadata of `source` keep their order, times and bytes, which is checked here by
    reading both. The same messages give the same file, however often. Raises UnusableLog, OSError.
    """
    with source.open("rb") as stream, target.open("wb") as file, _raise_as_unusable_log(source):
        writer = Writer(file)
        _copy(stream, writer, schemas)
        add_messages(writer, messages, schemas)
        writer.finish()
    with source.open("rb") as before, target.open("rb") as after, _raise_as_unusable_log(source):
        for one, other in zip_longest(_contents(before, schemas), _contents(after, schemas)):
            if one != other:
                raise UnusableLog(f"{sanitize_text(str(source))!r} could not be copied as it is; it is left unchanged")


def _raise_as_unusable_log(file: Path) -> Any:
    return guard_untrusted(UnusableLog, f"{sanitize_text(str(file))!r} is no MCAP file that is whole")


def _copy(stream: IO[bytes], writer: Writer, left_out: Collection[str]) -> None:
    """All but the topics `left_out`. A schema is written with the first channel that has it."""
    known: dict[int, Schema] = {}
    schema_ids, channel_ids = {0: 0}, dict[int, int]()
    for record in _records(stream):
        if isinstance(record, Header):
            writer.start(record.profile, record.library)
        elif isinstance(record, Schema):
            known[record.id] = record
        elif isinstance(record, Channel):
            if record.topic in left_out or record.id in channel_ids:
                continue
            if record.schema_id not in schema_ids:
                of = known[record.schema_id]
                schema_ids[of.id] = writer.register_schema(of.name, of.encoding, of.data)
            channel_ids[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema_ids[record.schema_id], record.metadata
            )
        elif isinstance(record, Record) and record.channel_id in channel_ids:
            writer.add_message(
                channel_ids[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)


def _contents(stream: IO[bytes], left_out: Collection[str]) -> Iterator[tuple]:
    """Yields what must be the same in a copy, in order; numbers of schemas and channels need not be."""
    schemas: dict[int, tuple] = {0: ()}
    channels: dict[int, tuple] = {}
    for record in _records(stream):
        if isinstance(record, Header):
            yield "header", record.profile, record.library
        elif isinstance(record, Schema):
            schemas[record.id] = record.name, record.encoding, record.data
        elif isinstance(record, Channel) and record.topic not in left_out:
            metadata = tuple(record.metadata.items())
            channels[record.id] = record.topic, record.message_encoding, metadata, schemas[record.schema_id]
        elif isinstance(record, Record) and record.channel_id in channels:
            fields = record.log_time, record.publish_time, record.sequence, record.data
            yield "message", channels[record.channel_id], *fields
        elif isinstance(record, Attachment):
            fields = record.create_time, record.log_time, record.name, record.media_type, record.data
            yield "attachment", *fields
        elif isinstance(record, Metadata):
            yield "metadata", record.name, tuple(record.metadata.items())


def _records(stream: IO[bytes]) -> Iterator[Any]:
    """Up to the end of the data; what follows is an index."""
    for record in unpack_chunks(StreamReader(stream, emit_chunks=True).records, stream):
        if isinstance(record, DataEnd):
            return
        yield record
    raise UnusableLog("it ends before the end of its data")
