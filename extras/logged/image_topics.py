"""The image topics of a log: which ones show photographs, and the lens of each."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.logs import event
from splatnode.capture.process.text import guard_untrusted, sanitize_text
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, messages, topics
from splatnode.extras.logged.messages import (
    CALIBRATIONS,
    PICTURES,
    Calibration,
    Picture,
    UnusableMessage,
    calibration_topic,
    is_colour_image,
    is_depth_image,
    lens,
    read_picture,
)

log = logging.getLogger(__name__)

COPIES = ("/compressed", "/theora", "/ffmpeg")  # behind a topic's name: ROS sends its images once more, packed
PACKED_DEPTH = "/compressedDepth"  # likewise, of depth


@dataclass(frozen=True, eq=False)
class ImageSurvey:
    """The image topics of a log, by name, each by its first message."""

    photographs: tuple[Topic, ...]
    depths: tuple[Topic, ...]  # each once, whatever further topics have copies of it
    sensors: Mapping[str, str]  # by topic: the coordinate frame of its camera; empty where it is not told


def image_topics(file: Path) -> list[Topic]:
    """Those whose messages are photographs, by name. Raises UnusableLog, OSError, ModuleNotFoundError without mcap."""
    return list(survey_images(file).photographs)


def survey_images(file: Path) -> ImageSurvey:
    """Looks at the first message of each image topic, in one pass; one that cannot be read may be a photograph.

    Of a damaged file, files of images that lie behind the damage count as photographs. Raises as `image_topics`.
    """
    there = [topic for topic in topics(file) if topic.kind in PICTURES]
    heads: dict[str, Picture | None] = {}  # without data
    damage = None
    try:
        for message in _read_firsts(file, {topic.name for topic in there}):
            heads[message.topic.name] = _read_head(message)
    except UnusableLog as error:
        damage = error
    photographs = [
        topic
        for topic in there
        if not topic.name.endswith(PACKED_DEPTH)
        and (_is_photograph(heads[topic.name]) if topic.name in heads else _holds_files(topic))
    ]
    if damage is not None and not heads and not photographs:
        raise damage
    told = {name: head for name, head in heads.items() if head is not None}
    depths = [topic for topic in there if topic.name in told and is_depth_image(told[topic.name])]
    copies = {f"{topic.name}{behind}" for topic in depths for behind in (*COPIES, PACKED_DEPTH)}
    kept = tuple(topic for topic in depths if topic.name not in copies)
    return ImageSurvey(tuple(photographs), kept, {name: head.sensor for name, head in told.items()})


def _read_firsts(file: Path, names: Collection[str]) -> Iterator[Message]:
    """Reads the first message of each topic of these names, and no further than to the last of them."""
    missing = set(names)
    for message in messages(file, names) if missing else ():
        if message.topic.name in missing:
            missing.remove(message.topic.name)
            yield message
            if not missing:
                return


def _read_head(message: Message) -> Picture | None:
    """A picture without its data, of which there may be much; None where it cannot be read."""
    try:
        return replace(read_picture(message), data=b"")
    except UnusableMessage:
        return None


def _is_photograph(head: Picture | None) -> bool:
    return head is None or is_colour_image(head)


def _holds_files(topic: Topic) -> bool:
    return topic.schema.endswith("CompressedImage")


def read_sensor(file: Path, topic: Topic) -> str:
    """Reads the name of the coordinate frame of a topic's camera; empty where its messages do not tell it."""
    for first in _read_firsts(file, {topic.name}):
        head = _read_head(first)
        return "" if head is None else head.sensor
    return ""


def read_topic_lens(file: Path, topic: Topic) -> Intrinsics | None:
    """Reads the lens of the topic's camera; where it cannot be used, logs that and returns None."""
    told = {each.name for each in topics(file) if each.kind in CALIBRATIONS}
    known: dict[str, Calibration] = {}
    sensor = read_sensor(file, topic)
    with contextlib.suppress(UnusableLog):  # what there is before the damage counts
        for first in _read_firsts(file, told):
            name = first.topic.name
            try:
                with guard_untrusted(UnusableMessage):
                    known[name] = CALIBRATIONS[first.topic.kind](first.data)
            except UnusableMessage as error:
                what = {"topic": sanitize_text(name), "error": sanitize_text(error)}
                event(log, logging.WARNING, "calibration_unreadable", **what)
    chosen = calibration_topic(topic.name, sensor, known)
    try:
        return None if chosen is None else lens(topic.name, known[chosen])
    except UnusableMessage as error:
        event(log, logging.WARNING, "calibration_unusable", topic=sanitize_text(chosen), error=sanitize_text(error))
        return None
