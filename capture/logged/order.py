"""The messages of an image topic in the order of their times, by the clock of who took the images where it tells.

Writers may log messages late, many at one time, or in any order; simulations count from their own beginning.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from splatnode.capture.logged.mcap import Message, Topic, UnusableLog, messages
from splatnode.capture.logged.message import Picture, UnusableMessage
from splatnode.capture.logged.schemas import PICTURES
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.stamp import LARGEST_NS, Clock, Stamp

EARLIEST_UTC_NS = 946_684_800 * 10**9  # the year 2000: a smaller stamp is of a clock that began with the recording
_MAX_HELD_BYTES = 1 << 28  # of messages that wait for earlier ones; what is beyond is read again


@dataclass(frozen=True)
class MessageTime:
    """When a message was taken and logged."""

    place: int  # among the messages of its topic, as they lie in the file
    log_ns: int  # when it was written down
    stream_ns: int  # when its image comes in the stream; never before that of an earlier image
    captured_at: Stamp | None  # None: no clock can count so far


def read_picture(message: Message) -> Picture:
    """Parses a message of an image topic. Raises UnusableMessage."""
    with guard_untrusted(UnusableMessage):
        return PICTURES[message.topic.kind](message.data)


def read_times(file: Path, topic: Topic) -> tuple[MessageTime, ...]:
    """The times of all messages of an image topic, in their order; equal ones in that of the file.

    All messages are read, and no image is decoded. A time is that of the message's header, also where a simulation
    counts it from its own beginning; it is the log's where no header of the topic tells any. Where all headers tell one
    time, the stream has the times of the log. Raises OSError; a damaged file is read as far as it goes.
    """
    told: list[tuple[int, int | None]] = []  # the log's time, and the header's; None: it cannot be read
    with suppress(UnusableLog):
        for message in messages(file, {topic.name}):
            try:
                told.append((message.log_ns, read_picture(message).captured_ns))
            except UnusableMessage:
                told.append((message.log_ns, None))
    headers = [header for _, header in told if header is not None]
    latest = max(headers, default=0)
    is_one_time = len(headers) > 1 and min(headers) == latest
    found: list[MessageTime] = []
    for place, (log_ns, header) in enumerate(told):
        # A header of 0 is the beginning of a simulation, or was never filled in where others tell the time of day.
        is_told = header is not None and latest > 0 and (header > 0 or latest < EARLIEST_UTC_NS)
        captured_ns = header if is_told and header is not None else log_ns
        stream_ns = log_ns if is_one_time else captured_ns
        if header is None and found and not is_one_time:
            stream_ns = found[-1].stream_ns  # it is left out, where it lies
        found.append(MessageTime(place, log_ns, stream_ns, _stamp(captured_ns)))
    return tuple(sorted(found, key=lambda each: each.stream_ns))


def read_in_order(file: Path, topic: Topic, times: Sequence[MessageTime]) -> Iterator[tuple[Message, MessageTime]]:
    """The messages of the topic in the order of `times`, which `read_times` gave.

    A file in order is read once. Of one in disorder as many messages wait in memory as there is room for; the others
    are read again. Raises UnusableLog, after all messages before the damage; OSError.
    """
    ranks = {each.place: rank for rank, each in enumerate(times)}
    held: dict[int, Message] = {}
    heap: list[int] = []  # of the ranks in `held`, negative: the last one first
    held_bytes = rank = 0
    problem: UnusableLog | None = None
    while rank < len(times):
        before = rank
        try:
            for place, message in enumerate(messages(file, {topic.name})):
                mine = ranks.get(place, -1)
                if mine < rank or mine in held:
                    continue
                held[mine] = message
                heapq.heappush(heap, -mine)
                held_bytes += len(message.data)
                while rank in held:
                    ready = held.pop(rank)
                    held_bytes -= len(ready.data)
                    yield ready, times[rank]
                    rank += 1
                while held_bytes > _MAX_HELD_BYTES and len(held) > 1:
                    last = -heapq.heappop(heap)
                    if last in held:
                        held_bytes -= len(held.pop(last).data)
        except UnusableLog as error:
            problem = error
        if rank == before:
            raise problem or UnusableLog("it changed while it was read; read it again when it is complete")
    if problem is not None:
        raise problem


def _stamp(captured_ns: int) -> Stamp | None:
    if captured_ns > LARGEST_NS:
        return None
    return Stamp(captured_ns, Clock.UTC if captured_ns >= EARLIEST_UTC_NS else Clock.RECORDING)
