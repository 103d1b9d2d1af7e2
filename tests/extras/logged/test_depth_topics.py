"""Depth topics beside image topics: which goes with which, where its camera stands, and what the log tells of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType

from splatnode.capture import film
from splatnode.capture.depth_image import ALIGNED, NOISES
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.cameras import mcap as image_topics_module
from splatnode.extras.cameras.mcap import (
    Config,
    configure_part,
    image_topics,
    list_cameras,
    pair_times,
    stream,
    survey_images,
)
from splatnode.extras.logged.messages import MessageTime
from tests.support.mcap_files import (
    START_NS,
    Written,
    pack_depth,
    raw,
    ros_file,
    ros_image,
    ros_lens,
    ros_static,
    write,
)

MS = 10**6
K = (50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0)
OTHER_K = (40.0, 0.0, 15.5, 0.0, 40.0, 11.5, 0.0, 0.0, 1.0)
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
TURN, STILL = (-0.5, 0.5, -0.5, 0.5), (0.0, 0.0, 0.0, 1.0)


def image(ns: int, topic: str = COLOUR, sensor: str = "color_optical") -> Written:
    return ros_image(topic, np.full((48, 64, 3), 90, np.uint8), "rgb8", sensor, ns)


def measured(
    ns: int, topic: str = DEPTH, sensor: str = "depth_optical", mm: int = 1000, size: tuple[int, int] = (32, 24)
) -> Written:
    return ros_image(topic, np.full(size[::-1], mm, np.uint16), "16UC1", sensor, ns)


def at(index: int, late_ms: float = 0.0) -> int:
    return START_NS + round((100 * index + late_ms) * MS)


def frames(file: Path, **options: Any) -> list[Frame]:
    found = list(stream(Config(file, **{"topic": COLOUR, **options})))
    assert all(isinstance(each, Frame) for each in found)
    return [each for each in found if isinstance(each, Frame)]


def only(file: Path, **options: Any) -> Frame:
    (frame,) = frames(file, **options)
    return frame


def log_of(tmp_path: Path, *messages: Written) -> Path:
    return write(tmp_path / "drive.mcap", messages)


def test_each_image_gets_the_nearest_depth_image_and_the_log_tells_how_many(tmp_path, caplog):
    caplog.set_level("INFO")
    shown = [image(at(index)) for index in range(4)]
    depth = [measured(at(i, late), sensor="color_optical", mm=1000 + i) for i, late in ((0, 5), (1, -10), (3, 30))]
    found = frames(log_of(tmp_path, *shown, *depth))
    values = [None if frame.depth is None else int(frame.depth.values[0, 0]) for frame in found]
    assert values == [1000, 1001, None, None]
    assert found[0].depth is not None and found[0].depth.is_aligned and found[0].depth.noise == NOISES["stereo"]
    assert "event=depth_images" in caplog.text and 'images="2 of 4"' in caplog.text
    assert "later_ms=-2.5 most_ms=10.0 within_ms=20" in caplog.text and "aligned, by its frame" in caplog.text
    wide = frames(tmp_path / "drive.mcap", depth_tolerance_s=0.03, depth_noise="time_of_flight")
    assert [frame.depth is not None for frame in wide] == [True, True, False, True]
    assert wide[0].depth is not None and wide[0].depth.noise == NOISES["time_of_flight"]


def test_times_that_never_meet_are_told(tmp_path, caplog):
    assert only(log_of(tmp_path, image(at(0)), measured(at(32), sensor="color_optical"))).depth is None
    assert 'images="0 of 1" nearest_ms=3200.0 within_ms=20' in caplog.text and "WARNING" in caplog.text


def test_without_headers_the_log_tells_the_times(tmp_path):
    told = [image(0), measured(0, sensor="color_optical", mm=1500)]
    file = write(tmp_path / "a.mcap", told, log_ns=lambda index: START_NS + 5 * MS * index)
    frame = only(file)
    assert frame.depth is not None and frame.depth.metres[3, 3] == pytest.approx(1.5)


def test_one_depth_image_may_go_with_several_images():
    def taken(*ms: int) -> tuple[MessageTime, ...]:
        return tuple(MessageTime(place, 0, MS * each, None) for place, each in enumerate(ms))

    pairs = pair_times(taken(0, 10, 20, 50), taken(9, 45), 15 * MS)
    assert pairs.depth_of == (0, 0, 0, 1) and pairs.offsets_ns == (9 * MS, -MS, -11 * MS, -5 * MS)
    assert pair_times(taken(0), (), MS).depth_of == (None,) and pair_times((), taken(0), MS).depth_of == ()
    assert pair_times((), (), MS).nearest_ns is None and pairs.nearest_ns == MS


@pytest.mark.parametrize("packed", [False, True])
def test_packed_depth_is_read_and_raw_depth_is_preferred(tmp_path, packed):
    values = np.full((48, 64), 1234, np.uint16)
    topic = "/camera/depth/image_raw"
    file = ros_file(
        f"{topic}/compressedDepth", pack_depth(values), "16UC1; compressedDepth png", "color_optical", at(0)
    )
    other = ros_file(f"{topic}/compressed", pack_depth(values)[12:], "16UC1; png compressed ", "color_optical", at(0))
    there = [image(at(0)), file, *([] if packed else [other, measured(at(0), topic, "color_optical", 1234)])]
    log = log_of(tmp_path, *there)
    assert [each.name for each in survey_images(log).depths] == [f"{topic}/compressedDepth" if packed else topic]
    assert [each.name for each in image_topics(log)] == [COLOUR]
    depth = only(log, topic="").depth
    assert depth is not None and np.unique(depth.metres).tolist() == [pytest.approx(1.234)]


def test_metres_of_floats_and_what_was_not_measured(tmp_path):
    metres = np.full((48, 64), 2.5, np.float32)
    metres[0, :3] = np.nan, np.inf, -1.0
    told = raw("/depth", 64, 48, "32FC1", 256, metres.tobytes(), sensor="color_optical")
    depth = only(write(tmp_path / "a.mcap", [image(START_NS + 500), told])).depth
    assert depth is not None and depth.metres[0, :4].tolist() == [0.0, 0.0, 0.0, 2.5]


# Where the depth camera stands.


def test_a_depth_camera_beside_is_placed_by_the_static_transforms(tmp_path, caplog):
    caplog.set_level("INFO")
    links = ros_static(
        ("link", "color_optical", (0.0, 0.015, 0.0), TURN), ("link", "depth_optical", (0.0, -0.035, 0.0), TURN)
    )
    lenses = (
        ros_lens("/camera/color/camera_info", (64, 48), K, "color_optical"),
        ros_lens("/camera/depth/camera_info", (32, 24), OTHER_K, "depth_optical"),
    )
    depth = only(log_of(tmp_path, links, *lenses, image(at(0)), measured(at(0)))).depth
    assert depth is not None and depth.intrinsics is not None
    assert (depth.intrinsics.fx, depth.intrinsics.cx, depth.intrinsics.width) == (40.0, 16.0, 32)
    np.testing.assert_allclose(depth.matrix[:3, 3], [0.05, 0.0, 0.0], atol=1e-12)  # to the right of the colour camera
    np.testing.assert_allclose(depth.matrix[:3, :3], np.eye(3), atol=1e-12)
    assert "its own, by tf_static" in caplog.text


HALF_K = (25.0, 0.0, 15.5, 0.0, 25.0, 11.5, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("topic", "sensor", "own_K", "by"),
    [
        ("/camera/aligned_depth_to_color/image_raw", "color_optical", K, "its frame"),
        ("/camera/depth/image_raw", "color_optical", HALF_K, "its frame"),  # of half the size
        ("/camera/depth/image_raw", "other", K, "its lens"),
        ("/camera/depth_registered/image_raw", "other", None, "its name"),
        ("/camera/aligned_depth_to_color/image_raw", "", K, "its lens and name"),
    ],
)
def test_aligned_depth_is_known_by_frame_lens_or_name(tmp_path, caplog, topic, sensor, own_K, by):
    caplog.set_level("INFO")
    size = (32, 24) if own_K is HALF_K else (64, 48)
    told = [ros_lens("/camera/color/camera_info", (64, 48), K, "color_optical")]
    if own_K is not None:
        told.append(ros_lens(f"{topic.rpartition('/')[0]}/camera_info", size, own_K, sensor))
    depth = only(log_of(tmp_path, *told, image(at(0)), measured(at(0), topic, sensor, size=size))).depth
    assert depth is not None and depth.is_aligned and depth.T_camera_depth == ALIGNED
    assert f'place="aligned, by {by}"' in caplog.text


def test_depth_of_the_same_frame_with_another_lens_has_that_lens(tmp_path):
    told = [
        ros_lens("/camera/color/camera_info", (64, 48), K, "color_optical"),
        ros_lens("/camera/depth/camera_info", (32, 24), OTHER_K, "color_optical"),
    ]
    depth = only(log_of(tmp_path, *told, image(at(0)), measured(at(0), sensor="color_optical"))).depth
    assert depth is not None and depth.intrinsics is not None and depth.intrinsics.fx == 40.0
    assert depth.T_camera_depth == ALIGNED


UNPLACED = [
    ([], "no static transform links its frame with that of the images"),
    ([ros_static(("link", "color_optical", (0.0,) * 3, STILL), ("link", "depth_optical", (0.1, 0.0, 0.0), STILL))],
     "its lens is not known"),
    ([ros_static(("depth_optical", "a", (0.0,) * 3, STILL), ("a", "depth_optical", (0.0,) * 3, STILL))],
     "the transforms of a log must be a tree"),
]  # fmt: skip


@pytest.mark.parametrize(("told", "reason"), UNPLACED)
def test_a_depth_camera_that_nothing_places_is_told_and_left_out(tmp_path, caplog, told, reason):
    file = log_of(tmp_path, *told, image(at(0)), measured(at(0)))
    assert only(file).depth is None
    assert re.search(f"depth_left_out.*{DEPTH} cannot be used: {reason}", caplog.text)
    assert "log /tf_static and its camera_info" in caplog.text
    with pytest.raises(ValueError, match=reason):
        frames(file, depth_topic=DEPTH)


# Which topic.


def test_aligned_depth_is_taken_of_several_topics(tmp_path):
    aligned = "/camera/aligned_depth_to_color/image_raw"
    told = [image(at(0)), measured(at(0)), measured(at(0), aligned, "color_optical", 2000)]
    depth = only(log_of(tmp_path, *told)).depth
    assert depth is not None and depth.metres[0, 0] == 2.0


def test_of_topics_that_are_alike_one_must_be_named(tmp_path, caplog):
    told = [image(at(0)), *(measured(at(0), f"/camera/{name}/depth", "color_optical", mm)
                            for name, mm in (("a", 1000), ("b", 2000)))]  # fmt: skip
    file = log_of(tmp_path, *told)
    assert only(file).depth is None
    assert "depth_left_out" in caplog.text and "/camera/a/depth, /camera/b/depth" in caplog.text
    assert "FILE.mcap#TOPIC,depth=TOPIC" in caplog.text
    named = only(file, depth_topic="/camera/b/depth").depth
    assert named is not None and named.metres[0, 0] == 2.0
    for part, metres in ((f"{COLOUR},depth=/camera/b/depth", 2.0), (",depth=/camera/a/depth", 1.0)):
        (frame,) = film.stream(film.part_of(file, part))
        assert isinstance(frame, Frame) and frame.depth is not None and frame.depth.metres[0, 0] == metres
    with pytest.raises(ValueError, match="no depth images of a topic '/lost'; there are: /camera/a/depth, /camera/b"):
        frames(file, depth_topic="/lost")
    with pytest.raises(ValueError, match="no depth images of a topic '/camera/color/image_raw'"):
        frames(file, depth_topic=COLOUR)


def test_depth_may_be_left_out(tmp_path, caplog):
    caplog.set_level("INFO")
    file = log_of(tmp_path, image(at(0)), measured(at(0), sensor="color_optical"))
    assert only(file, depth_topic="none").depth is None and "depth" not in caplog.text
    assert configure_part(file, f"{COLOUR},depth=none") == {"file": file, "topic": COLOUR, "depth_topic": "none"}
    assert configure_part(file, COLOUR) == {"file": file, "topic": COLOUR}


def test_several_cameras_get_each_the_depth_of_its_own(tmp_path):
    told = [image(at(0), f"/{name}/image", f"{name}_optical") for name in ("left", "right", "rear")]
    told += [
        measured(at(0), "/left/depth", "left_optical", 1000),
        measured(at(0), "/right/depth", "right_optical", 2000),
    ]
    file = log_of(tmp_path, *told)
    assert list_cameras(file, "") is not None and len(list_cameras(file, "") or []) == 3
    found = [only(file, topic=f"/{name}/image").depth for name in ("left", "right", "rear")]
    assert [None if depth is None else float(depth.metres[0, 0]) for depth in found] == [1.0, 2.0, None]


def test_many_topics_are_looked_at_in_one_pass(tmp_path, monkeypatch):
    told = [image(at(0), f"/camera{number}/image", f"eye{number}") for number in range(40)]
    told += [measured(at(0), f"/camera{number}/depth", f"eye{number}") for number in range(40)]
    file, passes, read = log_of(tmp_path, *told), [], image_topics_module.messages
    monkeypatch.setattr(image_topics_module, "messages", lambda *asked: passes.append(asked) or read(*asked))
    survey = survey_images(file)
    assert len(survey.photographs) == len(survey.depths) == 40 and len(passes) == 1
    assert survey.sensors["/camera7/depth"] == "eye7"


# Damage.


def test_depth_that_cannot_be_decoded_costs_only_itself(tmp_path, caplog):
    bad = ros_file(DEPTH, b"x" * 40, "16UC1; compressedDepth png", "color_optical", at(1))
    good = [ros_file(DEPTH, pack_depth(np.full((24, 32), 900, np.uint16)), "16UC1; compressedDepth png",
                     "color_optical", at(index)) for index in (0, 3)]  # fmt: skip
    worse = ros_file(DEPTH, b"", "16UC1; compressedDepth rvl", "color_optical", at(2))
    shown = [image(at(index)) for index in range(4)]
    found = frames(log_of(tmp_path, *shown, good[0], bad, worse, good[1]))
    assert [frame.depth is not None for frame in found] == [True, False, False, True]
    assert caplog.text.count("depth_left_out") == 2 and "images=2" in caplog.text


def test_depth_of_another_shape_is_left_out(tmp_path, caplog):
    found = frames(log_of(tmp_path, image(at(0)), measured(at(0), sensor="color_optical", size=(24, 24))))
    assert found[0].depth is None and "must have the shape of its image" in caplog.text


def test_a_file_that_ends_early_gives_the_depth_that_it_has(tmp_path):
    rng = np.random.default_rng(0)
    told = []
    for index in range(12):
        told.append(ros_image(COLOUR, rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), "rgb8", "eye", at(index)))
        values = rng.integers(500, 5000, (48, 64)).astype(np.uint16)
        told.append(ros_image(DEPTH, values, "16UC1", "eye", at(index)))
    file = write(tmp_path / "a.mcap", told, compression=CompressionType.ZSTD, chunk_size=20_000)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    *read, last = stream(Config(file, topic=COLOUR))
    assert isinstance(last, DroppedFrame) and len(read) >= 4
    assert all(isinstance(each, Frame) for each in read)
    assert sum(isinstance(each, Frame) and each.depth is not None for each in read) >= len(read) - 1
