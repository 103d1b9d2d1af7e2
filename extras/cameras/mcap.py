"""An image topic of an MCAP file as a camera: what a robot logged, by Foxglove's schemas or by ROS 2. Needs mcap."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, make_frame
from splatnode.capture.image_file import MAX_PIXELS, MaxPixels
from splatnode.capture.lens_file import same_aspect
from splatnode.capture.pace import Pace, pace_frames
from splatnode.capture.process.logs import event
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_name, sanitize_text
from splatnode.capture.rig import Rig
from splatnode.extras.logged import static_rig
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, messages, topics
from splatnode.extras.logged.messages import (
    CALIBRATIONS,
    PICTURES,
    READ,
    Calibration,
    MessageTime,
    UnusableMessage,
    calibration_topic,
    is_colour_image,
    lens,
    read_in_order,
    read_picture,
    read_times,
    rgb,
)
from splatnode.extras.logged.robot_motion import RobotMotion, read_robot_motion

log = logging.getLogger(__name__)

SUFFIX = ".mcap"
_LONGEST_STEM = LONGEST_NAME - 25  # characters: the number of the message comes behind it
_COPIES = ("/compressed", "/theora", "/ffmpeg")  # behind a topic's name: ROS sends its images once more, packed
_NOT_PHOTOGRAPHS = "/compressedDepth"  # the end of a topic's name: depth that ROS packs into a PNG


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Path  # the MCAP file
    topic: str = ""  # with the images; "": the only one that has any
    max_pixels: MaxPixels = MAX_PIXELS  # larger images are left out
    pace: Pace = "fastest"  # recorded: at the pace of the log; fastest: as fast as frames are taken
    intrinsics: Intrinsics | None = None  # the lens, of images of its aspect ratio, instead of what the file tells
    base_frame: str = "base_link"  # of the robot: where the camera stands on it is read from tf and tf_static
    # In which tf, or else a topic of odometry, tells where the robot is: the images carry that as their poses; "": none
    odometry_frame: str = "odom"


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
    return {"file": path, "topic": part}


def explain_many(path: Path) -> None:
    """A file is a film as a whole where one topic has images; `stream` says so where that is not so."""


def list_cameras(path: Path, part: str) -> list[tuple[list[str], str]] | None:
    """The topics with images, each once; None where one of them is meant. Raises as `image_topics`."""
    if part or not path.is_file():
        return None
    names = [topic.name for topic in image_topics(path)]
    names = [name for name in names if not any(name == f"{each}{copy}" for each in names for copy in _COPIES)]
    return [([segment for segment in name.split("/") if segment], name) for name in names]


def read_rig(path: Path, parts: Mapping[str, str]) -> Rig:
    """Returns where the cameras of these topics stand to each other. Raises as `static_rig.read_rig`."""
    return static_rig.read_rig(path, parts)


def image_topics(file: Path) -> list[Topic]:
    """Those whose messages are photographs, by name. Raises UnusableLog, OSError, ModuleNotFoundError without mcap."""
    pictures = [topic for topic in topics(file) if topic.kind in PICTURES and not topic.name.endswith(_NOT_PHOTOGRAPHS)]
    return [topic for topic in pictures if topic.schema.endswith("CompressedImage") or _has_colour_images(file, topic)]


def _has_colour_images(file: Path, topic: Topic) -> bool:
    """Whether the first image of a topic is a photograph, and not depth; one that cannot be read may be."""
    first = next(messages(file, {topic.name}), None)
    if first is None:
        return False
    try:
        return is_colour_image(read_picture(first))
    except UnusableMessage:
        return True


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
    known = config.intrinsics or _lens(config.file, topic)
    robot, sensor = read_robot_motion(config.file), _sensor(config.file, topic)
    if not (robot.says_nothing or robot.has_frame(sensor)):
        event(log, logging.WARNING, "camera_not_on_robot", topic=sanitize_text(topic.name), frame=sanitize_text(sensor))
    index, told = 0, False
    try:
        for message, time in read_in_order(config.file, topic, read_times(config.file, topic)):
            item = _frame(message, time, index, config, known)
            if isinstance(item, Frame):
                at_ns = time.log_ns if item.captured_at is None else item.captured_at.ns
                item = _add_motion(item, robot, sensor, config, at_ns)
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
    if index == 0:
        raise ValueError(f"{str(config.file)!r} has no message of {sanitize_text(topic.name, LONGEST_NAME)}")


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


def _add_motion(frame: Frame, robot: RobotMotion, sensor: str, config: Config, at_ns: int) -> Frame:
    """The frame with its camera's place on the robot, its pose by odometry, and gravity, as far as the log tells."""
    if robot.says_nothing or not sensor:
        return frame
    mount = robot.find_pose(config.base_frame, sensor, at_ns)
    return replace(
        frame,
        T_base_camera=None if mount is None else tuple(mount.ravel().tolist()),
        given_pose=robot.make_given_pose(config.odometry_frame, sensor, at_ns),
        gravity=robot.make_gravity(sensor, at_ns),
    )


def _lens(file: Path, topic: Topic) -> Intrinsics | None:
    """Reads the lens of the topic's camera; where it cannot be used, logs that and returns None."""
    told = [each.name for each in topics(file) if each.kind in CALIBRATIONS]
    known: dict[str, Calibration] = {}
    sensor = _sensor(file, topic)
    for name in told:
        first = next(messages(file, {name}), None)
        try:
            with guard_untrusted(UnusableMessage):
                if first is not None:
                    known[name] = CALIBRATIONS[first.topic.kind](first.data)
        except UnusableMessage as error:
            event(log, logging.WARNING, "calibration_unreadable", topic=sanitize_text(name), error=sanitize_text(error))
    chosen = calibration_topic(topic.name, sensor, known)
    try:
        return None if chosen is None else lens(topic.name, known[chosen])
    except UnusableMessage as error:
        event(log, logging.WARNING, "calibration_unusable", topic=sanitize_text(chosen), error=sanitize_text(error))
        return None


def _sensor(file: Path, topic: Topic) -> str:
    first = next(messages(file, {topic.name}), None)
    try:
        return "" if first is None else read_picture(first).sensor
    except UnusableMessage:
        return ""


def _stem(topic: Topic) -> str:
    """The topic in the name of a frame, which may name a file."""
    return sanitize_name(topic.name.strip("/").replace("/", "_"), _LONGEST_STEM) or "image"
