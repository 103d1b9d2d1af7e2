"""An image topic of an MCAP file as a camera: what a robot logged, by Foxglove's schemas or by ROS 2. Needs mcap."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, make_frame
from splatnode.capture.image_file import MAX_PIXELS, MaxPixels
from splatnode.capture.lens_file import same_aspect
from splatnode.capture.pace import Pace, pace_frames
from splatnode.capture.process.logs import event
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_name, sanitize_text
from splatnode.capture.rig import TOLERANCE_S, Rig
from splatnode.extras.logged import static_rig
from splatnode.extras.logged.depth_topics import DepthReader, open_depth
from splatnode.extras.logged.image_topics import COPIES, image_topics, read_topic_lens
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, topics
from splatnode.extras.logged.messages import (
    READ,
    MessageTime,
    UnusableMessage,
    read_in_order,
    read_picture,
    read_times,
    rgb,
)

log = logging.getLogger(__name__)

SUFFIX = ".mcap"
_DEPTH_MARK = ",depth="  # between the topic of the images and that of their depth images
_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the message comes behind it


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Path  # the MCAP file
    topic: str = ""  # with the images; "": the only one that has any
    max_pixels: MaxPixels = MAX_PIXELS  # larger images are left out
    pace: Pace = "fastest"  # recorded: at the pace of the log; fastest: as fast as frames are taken
    # With the depth images; "": the one that goes with the images, if one alone does; none: images go without
    depth_topic: str = ""
    # Between an image and the depth image that goes with it, at most
    depth_tolerance_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = TOLERANCE_S
    # The kind of the depth camera, which tells how unsure its depths are
    depth_noise: Literal["stereo", "structured_light", "time_of_flight", "lidar"] = "stereo"
    intrinsics: Intrinsics | None = None  # the lens, of images of its aspect ratio, instead of what the file tells


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """The images in the order of their times, each with the lens that the file tells for its camera.

    Raises FileNotFoundError, or ValueError where the file or the topic cannot be used. What goes wrong after a frame
    is named as a dropped frame.
    """
    if not config.file.is_file():
        raise FileNotFoundError(f"no file {str(config.file)!r}; give an MCAP file")
    topic = _select_topic(config)
    return pace_frames(_frames(config, topic), config.pace)


def is_recording(path: Path) -> bool:
    return path.suffix.lower() == SUFFIX


def configure_part(path: Path, part: str) -> dict[str, Any]:
    """Behind the topic of the images may stand that of their depth images: /front/image,depth=/front/depth."""
    topic, _, depth = part.partition(_DEPTH_MARK)
    return {"file": path, "topic": topic, **({"depth_topic": depth} if depth else {})}


def explain_many(path: Path) -> None:
    """A file is a film as a whole where one topic has images; `stream` says so where that is not so."""


def list_cameras(path: Path, part: str) -> list[tuple[list[str], str]] | None:
    """The topics with images, each once; None where one of them is meant. Raises as `image_topics`."""
    if part or not path.is_file():
        return None
    names = [topic.name for topic in image_topics(path)]
    names = [name for name in names if not any(name == f"{each}{copy}" for each in names for copy in COPIES)]
    return [([segment for segment in name.split("/") if segment], name) for name in names]


def read_rig(path: Path, parts: Mapping[str, str]) -> Rig:
    """Returns where the cameras of these topics stand to each other. Raises as `static_rig.read_rig`."""
    return static_rig.read_rig(path, parts)


def _select_topic(config: Config) -> Topic:
    """The topic that is configured, or the only one."""
    there = image_topics(config.file)
    names = ", ".join(sanitize_text(topic.name, LONGEST_NAME) for topic in there)
    shown = repr(sanitize_text(str(config.file)))
    if not there:
        others = sorted({topic.schema for topic in topics(config.file) if topic.schema})
        held = f"it holds {sanitize_text(', '.join(others))}" if others else "it holds no messages of any schema"
        raise ValueError(f"{shown} must have a topic of images ({READ}); {held}")
    if not config.topic and len(there) > 1:
        raise ValueError(
            f"{shown} has {len(there)} topics of images: {names}; name one, as in FILE.mcap#TOPIC, or "
            "use several together with --cameras all"
        )
    for topic in there:
        if config.topic in ("", topic.name):
            return topic
    raise ValueError(
        f"{shown} has no images of a topic {sanitize_text(config.topic, LONGEST_NAME)!r}; there are: {names}"
    )


def _frames(config: Config, topic: Topic) -> Iterator[Frame | DroppedFrame]:
    known = config.intrinsics or read_topic_lens(config.file, topic)
    index, told = 0, False
    times = read_times(config.file, topic)
    depth = _open_depth(config, topic, times)
    try:
        for message, time in read_in_order(config.file, topic, times):
            item = _frame(message, time, index, config, known)
            if depth is not None and isinstance(item, Frame):
                item = depth.attach_depth(item, index)
            if isinstance(item, Frame) and known is not None and item.intrinsics is None and not told:
                sizes = {"calibrated": f"{known.width}x{known.height}", "image": f"{item.width}x{item.height}"}
                event(log, logging.WARNING, "lens_of_another_size", topic=sanitize_text(topic.name), **sizes)
                told = True
            yield item
            index += 1
    except UnusableLog as error:
        if index == 0:
            raise
        yield DroppedFrame(f"{_stem(topic)}_rest", str(error))
    if depth is not None:
        depth.close()
    if index == 0:
        raise ValueError(f"{str(config.file)!r} has no message of {sanitize_text(topic.name, LONGEST_NAME)}")


def _open_depth(config: Config, topic: Topic, times: Sequence[MessageTime]) -> DepthReader | None:
    """Opens the depth images; where a damaged file does not give them, logs that and returns None."""
    wanted = config.depth_topic
    try:
        return open_depth(config.file, topic, times, wanted, config.depth_tolerance_s, config.depth_noise)
    except UnusableLog as error:
        event(log, logging.WARNING, "depth_left_out", reason=sanitize_text(error))
        return None


def _frame(
    message: Message, time: MessageTime, index: int, config: Config, known: Intrinsics | None
) -> Frame | DroppedFrame:
    name = f"{_stem(message.topic)}_{index:06d}.png"
    try:
        picture = read_picture(message)
        with guard_untrusted(UnusableMessage):
            image = rgb(picture, config.max_pixels)
    except UnusableMessage as error:
        return DroppedFrame(name, str(error))
    height, width = image.shape[:2]
    fits = known is not None and same_aspect(known, width, height)
    own = known.resized(width, height) if known is not None and fits else None
    return make_frame(index, name, time.stream_ns, image, own, captured_at=time.captured_at)


def _stem(topic: Topic) -> str:
    """The topic in the name of a frame, which may name a file."""
    return sanitize_name(topic.name.strip("/").replace("/", "_"), _LONGEST_STEM) or "image"
