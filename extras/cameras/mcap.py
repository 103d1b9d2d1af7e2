"""An image topic of an MCAP file as a camera: what a robot logged, by Foxglove's schemas or by ROS 2. Needs mcap."""

from __future__ import annotations

import bisect
import contextlib
import itertools
import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import ALIGNED, DepthImage, make_depth_image
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, Pace, make_frame, pace_frames
from splatnode.capture.image_file import MAX_PIXELS, MaxPixels
from splatnode.capture.lenses import same_aspect
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_name, sanitize_text
from splatnode.capture.rig import TOLERANCE_S, Rig
from splatnode.extras.logged import transforms
from splatnode.extras.logged.mcap import Message, Topic, UnusableLog, messages, topics
from splatnode.extras.logged.messages import (
    CALIBRATIONS,
    PICTURES,
    READ,
    Calibration,
    MessageTime,
    Picture,
    UnusableMessage,
    calibration_topic,
    decode_depth,
    is_colour_image,
    is_depth_image,
    lens,
    read_in_order,
    read_picture,
    read_times,
    rgb,
)
from splatnode.extras.logged.transforms import RobotMotion, climb_tree, read_robot_motion, read_static_transforms

# The image topics of a log: which ones show photographs, and the lens of each.

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
    readable_heads = {name: head for name, head in heads.items() if head is not None}
    depths = [topic for topic in there if topic.name in readable_heads and is_depth_image(readable_heads[topic.name])]
    copies = {f"{topic.name}{behind}" for topic in depths for behind in (*COPIES, PACKED_DEPTH)}
    kept = tuple(topic for topic in depths if topic.name not in copies)
    return ImageSurvey(tuple(photographs), kept, {name: head.sensor for name, head in readable_heads.items()})


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
    calibration_names = {each.name for each in topics(file) if each.kind in CALIBRATIONS}
    known: dict[str, Calibration] = {}
    sensor = read_sensor(file, topic)
    with contextlib.suppress(UnusableLog):  # what there is before the damage counts
        for first in _read_firsts(file, calibration_names):
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


# The depth images that go with the images of a topic: which topic has them, where its camera stands, which goes with
# which.
#
# Both cameras' coordinate frames, lenses and the static transforms of the log tell the place. Times pair them: those
# of the headers where both topics have any, else those of the log.

NO_DEPTH = "none"  # in place of a topic
_ALIGNED_NAMES = ("aligned_depth_to_color", "depth_registered")  # as the drivers of ROS name topics
_SAME_PX, _SAME_FOCAL = 0.5, 1e-3  # pixels, and a share: by so much equal lenses may differ, as after rounding
_MOST_COMPARED = 100_000  # pairs of an image topic and a depth topic, beyond which frames alone tell what goes together
_MOST_NAMES = 10  # that a line of the log lists
_SAME_PLACE = 1e-6  # metres, and sines of angles
_NAME_ONE = "name one behind the topic of the images, as in FILE.mcap#TOPIC,depth=TOPIC, or in camera.depth_topic"


class UnknownPlace(ValueError):
    """A depth topic of which nothing tells how it lies beside the images; the text says what was looked for."""


@dataclass(frozen=True)
class DepthPlace:
    """The place of the depth camera beside the images' camera, and what tells it."""

    intrinsics: Intrinsics | None  # of the depth camera; None: its pixels are those of the images
    T_camera_depth: tuple[float, ...]  # row by row, metres
    known_by: str


@dataclass(frozen=True)
class DepthPairs:
    """Which depth image goes with which image: the nearest in time."""

    depth_of: tuple[int | None, ...]  # the number of its depth image for each image, never falling
    offsets_ns: tuple[int, ...]  # of the depth images that go with an image: how much later they were taken
    nearest_ns: int | None  # between any image and any depth image; None: there are none

    @property
    def count(self) -> int:
        return len(self.offsets_ns)


# The topic.


def select_depth_topic(survey: ImageSurvey, topic: Topic, wanted: str) -> Topic | None:
    """Selects the topic of depth that is `wanted`, or that goes with the images of `topic`; None where none does.

    Of several that may the log tells, and none is taken. Raises ValueError where the wanted one is not there.
    """
    if wanted:
        for each in survey.depths:
            if each.name == wanted:
                return each
        raise ValueError(
            f"there are no depth images of a topic {sanitize_text(wanted, LONGEST_NAME)!r}; there are: "
            f"{_list_names(survey.depths) or 'none'}. Depth is read of the encodings 16UC1 and 32FC1"
        )
    beside = _select_best(survey, topic, _select_beside(survey, topic))
    if len(beside) > 1:
        event(log, logging.WARNING, "depth_left_out", topics=_list_names(beside), reason=_NAME_ONE)
    return beside[0] if len(beside) == 1 else None


def _list_names(found: Sequence[Topic]) -> str:
    names = [sanitize_text(each.name, LONGEST_NAME) for each in found[:_MOST_NAMES]]
    return ", ".join([*names, *(["..."] if len(found) > _MOST_NAMES else [])])


def _select_beside(survey: ImageSurvey, topic: Topic) -> Sequence[Topic]:
    """Selects those to which no other image topic is nearer: by the coordinate frame, then by the names."""
    others = [each for each in survey.photographs if each.name != topic.name]
    if len(others) * len(survey.depths) > _MOST_COMPARED:
        return survey.depths

    def rate(image: Topic, depth: Topic) -> tuple[bool, int]:
        return _have_one_frame(survey, image, depth), _count_common(image.name, depth.name)

    return [depth for depth in survey.depths if all(rate(each, depth) <= rate(topic, depth) for each in others)]


def _have_one_frame(survey: ImageSurvey, topic: Topic, other: Topic) -> bool:
    sensor = survey.sensors.get(topic.name, "")
    return sensor != "" and sensor == survey.sensors.get(other.name, "")


def _select_best(survey: ImageSurvey, topic: Topic, beside: Sequence[Topic]) -> list[Topic]:
    """Selects of several topics those in the images' frame, then those that are aligned by name, then the nearest."""
    found = list(beside)
    ratings = (
        lambda each: _have_one_frame(survey, topic, each),
        lambda each: _is_aligned_by_name(each),
        lambda each: _count_common(topic.name, each.name),
    )
    for rate in ratings:
        if len(found) > 1:
            rated = [rate(each) for each in found]
            best = max(rated)
            found = [each for each, mark in zip(found, rated, strict=True) if mark == best]
    return found


def _count_common(name: str, other: str) -> int:
    """How many segments both names begin with."""
    pairs = zip(name.strip("/").split("/"), other.strip("/").split("/"), strict=False)
    return len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _is_aligned_by_name(topic: Topic) -> bool:
    return any(word in topic.name for word in _ALIGNED_NAMES)


# Its place.


def find_place(file: Path, survey: ImageSurvey, topic: Topic, depth: Topic) -> DepthPlace:
    """Finds where the camera of `depth` stands beside that of `topic`. Raises UnknownPlace, and what reading raises."""
    lens, own = read_topic_lens(file, topic), read_topic_lens(file, depth)
    sensor, own_sensor = (survey.sensors.get(each.name, "") for each in (topic, depth))
    is_named, is_equal = _is_aligned_by_name(depth), lens is not None and own is not None and _are_equal(lens, own)
    if sensor and sensor == own_sensor:
        is_aligned = is_equal or own is None or (lens is None and is_named)
        return DepthPlace(None if is_aligned else own, ALIGNED, "its frame")
    if is_equal and is_named:
        return DepthPlace(None, ALIGNED, "its lens and name")
    T_camera_depth, why = _find_transform(file, sensor, own_sensor)
    if T_camera_depth is not None and own is not None:
        is_aligned = is_equal and np.abs(T_camera_depth - np.eye(4)).max() <= _SAME_PLACE
        T = ALIGNED if is_aligned else tuple(T_camera_depth.ravel().tolist())
        return DepthPlace(None if is_aligned else own, T, "tf_static")
    if is_equal or is_named:
        return DepthPlace(None, ALIGNED, "its lens" if is_equal else "its name")
    if T_camera_depth is not None:
        why = "its lens is not known"
    raise UnknownPlace(
        f"{sanitize_text(depth.name, LONGEST_NAME)} cannot be used: {why}. Its frame {_quote(own_sensor)} is not that "
        f"of the images, {_quote(sensor)}, nor is its lens; log /tf_static and its camera_info, or depth that is "
        "aligned with the images"
    )


def _quote(frame: str) -> str:
    return repr(sanitize_text(frame, 100)) if frame else "(none)"


def _are_equal(lens: Intrinsics, other: Intrinsics) -> bool:
    """Whether two lenses are of the same pixels, whatever the sizes of their images."""
    if not same_aspect(lens, other.width, other.height) or lens.model != other.model:
        return False
    if len(lens.distortion) != len(other.distortion) or not np.allclose(lens.distortion, other.distortion, atol=1e-6):
        return False
    own = lens.resized(other.width, other.height)
    is_near = abs(own.cx - other.cx) <= _SAME_PX and abs(own.cy - other.cy) <= _SAME_PX
    return is_near and bool(np.allclose((own.fx, own.fy), (other.fx, other.fy), rtol=_SAME_FOCAL))


def _find_transform(file: Path, sensor: str, own_sensor: str) -> tuple[npt.NDArray[np.float64] | None, str]:
    """Finds T_camera_depth (4, 4) in the static transforms; None, and why, where they do not tell it."""
    if not sensor or not own_sensor:
        return None, "its messages or those of the images name no frame"
    try:
        transforms = read_static_transforms(file)
        (root, T_root_camera), (own_root, T_root_depth) = (
            climb_tree(transforms, each) for each in (sensor, own_sensor)
        )
    except ValueError as error:
        return None, sanitize_text(error)
    if root != own_root:
        return None, "no static transform links its frame with that of the images"
    return np.linalg.inv(T_root_camera) @ T_root_depth, ""


# Its times.


def pair_times(images: Sequence[MessageTime], depths: Sequence[MessageTime], within_ns: int) -> DepthPairs:
    """Pairs each image with the depth image that is nearest in time, if it is near enough; one may go with several."""
    is_stamped = all(any(each.is_stamped for each in times) for times in (images, depths))

    def read_ns(time: MessageTime) -> int:
        return time.stream_ns if is_stamped else time.log_ns

    known = sorted((read_ns(each), number) for number, each in enumerate(depths))
    stamps = [ns for ns, _ in known]
    depth_of: list[int | None] = []
    offsets, nearest, last = [], [], -1
    for ns in map(read_ns, images):
        at = bisect.bisect_left(stamps, ns)
        near = min(known[max(0, at - 1) : at + 1], key=lambda each: abs(each[0] - ns), default=None)
        if near is not None:
            nearest.append(abs(near[0] - ns))
        if near is None or nearest[-1] > within_ns or near[1] < last:
            depth_of.append(None)
            continue
        last = near[1]
        depth_of.append(last)
        offsets.append(near[0] - ns)
    return DepthPairs(tuple(depth_of), tuple(offsets), min(nearest, default=None))


# Its images.


class DepthReader:
    """Reads the depth images of a topic, in the order of the images that they go with.

    What cannot be read is left out: the log tells the first, and `close` how many.
    """

    def __init__(
        self, file: Path, topic: Topic, place: DepthPlace, times: Sequence[MessageTime], pairs: DepthPairs, noise: str
    ) -> None:
        self._place, self._pairs, self._noise = place, pairs, noise
        self._numbers = sorted({number for number in pairs.depth_of if number is not None})
        self._decoded = self._decode(file, topic, [times[number] for number in self._numbers])
        self._depth: DepthImage | ValueError | None = None
        self._at, self._left_out = -1, 0

    def attach_depth(self, frame: Frame, index: int) -> Frame:
        """The frame of the image of this number with its depth image, or without."""
        number = self._pairs.depth_of[index]
        if number is None:
            return frame
        while self._at < 0 or self._numbers[self._at] < number:
            self._at += 1
            self._depth = next(self._decoded, self._depth)  # what ended it is said of the others, too
        try:
            if isinstance(self._depth, ValueError):
                raise self._depth
            return replace(frame, depth=self._depth)
        except ValueError as error:
            if not self._left_out:
                event(log, logging.WARNING, "depth_left_out", name=frame.name, reason=sanitize_text(error))
            self._left_out += 1
            return frame

    def close(self) -> None:
        """Tells of how many images the depth was left out."""
        if self._left_out > 1:
            event(log, logging.WARNING, "depth_left_out", images=self._left_out)

    def _decode(self, file: Path, topic: Topic, times: Sequence[MessageTime]) -> Iterator[DepthImage | ValueError]:
        try:
            for message, _ in read_in_order(file, topic, times):
                try:
                    values = decode_depth(read_picture(message))
                    T = np.array(self._place.T_camera_depth).reshape(4, 4)
                    yield make_depth_image(values, None, self._place.intrinsics, T, self._noise)
                except ValueError as error:
                    yield error
        except UnusableLog as error:
            yield error


def open_depth(
    file: Path, topic: Topic, images: Sequence[MessageTime], wanted: str, within_s: float, noise: str
) -> DepthReader | None:
    """Opens the depth images that go with the images of a topic, and tells how many do; None where there are none.

    `wanted` names their topic; empty: one that goes with the images. Raises ValueError where a topic that is named
    cannot be used, and what reading the file raises.
    """
    if wanted == NO_DEPTH:
        return None
    survey = survey_images(file)
    depth = select_depth_topic(survey, topic, wanted)
    if depth is None:
        return None
    try:
        place = find_place(file, survey, topic, depth)
    except UnknownPlace as error:
        if wanted:
            raise
        event(log, logging.WARNING, "depth_left_out", reason=str(error))
        return None
    times = read_times(file, depth)
    pairs = pair_times(images, times, round(1e9 * within_s))
    _tell_pairs(depth, place, pairs, within_s)
    return DepthReader(file, depth, place, times, pairs, noise)


def _tell_pairs(depth: Topic, place: DepthPlace, pairs: DepthPairs, within_s: float) -> None:
    fields = {"topic": sanitize_text(depth.name), "images": f"{pairs.count} of {len(pairs.depth_of)}"}
    if pairs.count:
        offsets = np.array(pairs.offsets_ns) / 1e6
        fields["later_ms"] = f"{np.median(offsets):.1f}"
        fields["most_ms"] = f"{np.abs(offsets).max():.1f}"
    elif pairs.nearest_ns is not None:
        fields["nearest_ms"] = f"{pairs.nearest_ns / 1e6:.1f}"
    fields["within_ms"] = f"{1000 * within_s:g}"
    fields["place"] = f"{'its own' if place.intrinsics else 'aligned'}, by {place.known_by}"
    event(log, logging.INFO if pairs.count else logging.WARNING, "depth_images", **fields)


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
    """Returns where the cameras of these topics stand to each other. Raises as `transforms.read_rig`."""
    return transforms.read_rig(path, parts)


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
    robot, sensor = read_robot_motion(config.file), read_sensor(config.file, topic)
    if not (robot.says_nothing or robot.has_frame(sensor)):
        event(log, logging.WARNING, "camera_not_on_robot", topic=sanitize_text(topic.name), frame=sanitize_text(sensor))
    index, has_warned = 0, False
    times = read_times(config.file, topic)
    depth = _open_depth(config, topic, times)
    try:
        for message, time in read_in_order(config.file, topic, times):
            item = _frame(message, time, index, config, known)
            if isinstance(item, Frame):
                at_ns = time.log_ns if item.captured_at is None else item.captured_at.ns
                item = _add_motion(item, robot, sensor, config, at_ns)
            if depth is not None and isinstance(item, Frame):
                item = depth.attach_depth(item, index)
            if isinstance(item, Frame) and known is not None and item.intrinsics is None and not has_warned:
                sizes = {"calibrated": f"{known.width}x{known.height}", "image": f"{item.width}x{item.height}"}
                event(log, logging.WARNING, "lens_of_another_size", topic=sanitize_text(topic.name), **sizes)
                has_warned = True
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


def _stem(topic: Topic) -> str:
    """The topic in the name of a frame, which may name a file."""
    return sanitize_name(topic.name.strip("/").replace("/", "_"), _LONGEST_STEM) or "image"
