"""A scene crosses the wire unchanged, and what is no scene is refused."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import Clock, DroppedFrame, Intrinsics, Stamp
from splatnode.capture.messaging.messages import Message, Numbering, WireError, decode, encode, make_jpeg_array
from splatnode.recon.result.message import (
    CameraRecord,
    SceneHeader,
    decode_snapshot,
    encode_snapshot,
    make_camera_record,
)
from splatnode.recon.result.snapshot import CameraEstimate, DepthCheck, DepthCode, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import RELATIVE, Bounds, Code, Scale, Verdict
from tests.support.schemas import without

RANDOM = np.random.default_rng(0)
NUMBERED = Numbering(session="0123456789abcdef" * 2).next() | {"sequence": 7}


def turned(angle: float) -> np.ndarray:
    """A camera's pose, turned about y."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    T[:3, 3] = RANDOM.normal(size=3)
    return T


def camera(index: int) -> CameraEstimate:
    return CameraEstimate(
        f"{index}.png",
        index,
        turned(0.3 * index),
        np.diag([300.0, 301, 1]),
        320,
        200,
        Bounds(0.1, 0.02, 2.0, 1.5, ((0.03, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.005, 0.0))),
        Stamp(10**18 + index, Clock.UTC) if index else None,
    )


def snapshot(cameras: int = 3, count: int = 10) -> Snapshot:
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "sh": (count, 1, 3),
    }
    arrays = {name: RANDOM.random(shape).astype(np.float32) for name, shape in shapes.items()}
    estimates = tuple(camera(index) for index in range(cameras))
    return Snapshot(
        sequence=7,
        verdict=Verdict(Code.OK_PARTIAL, "2 of 3.", "Add one.", ("2.png",), publishable=True),
        cameras=estimates,
        gaussians=GaussianArrays(**arrays, source_frame=np.arange(count, dtype=np.int32)),
        images={c.name: RANDOM.integers(0, 255, (400, 640, 3), np.uint8) for c in estimates},
        dropped=(DroppedFrame("blurred.png", "blurred"),),
        iterations=50,
        seconds={"poses": 1.5},
        final=True,
    )


def sent(scene: Snapshot) -> Message[SceneHeader]:
    header, arrays = encode_snapshot(scene, "scene-0002", NUMBERED)
    return decode([bytes(part) for part in encode(header, arrays)], SceneHeader)


def test_a_scene_comes_out_as_it_went_in():
    scene = snapshot()
    live = decode_snapshot(sent(scene))
    assert (live.scene_id, live.session) == ("scene-0002", NUMBERED["session"])
    assert live.snapshot.verdict == scene.verdict and live.snapshot.dropped == scene.dropped
    assert (live.snapshot.sequence, live.snapshot.iterations, live.snapshot.final) == (7, 50, True)
    for name in GaussianArrays.__dataclass_fields__:
        assert np.array_equal(getattr(live.snapshot.gaussians, name), getattr(scene.gaussians, name)), name
    for one, other in zip(live.snapshot.cameras, scene.cameras, strict=True):
        assert np.array_equal(one.T_world_camera, other.T_world_camera) and np.array_equal(one.K, other.K)
        assert (one.name, one.frame_id, one.width, one.height) == (
            other.name,
            other.frame_id,
            other.width,
            other.height,
        )
        assert one.bounds == other.bounds is not None and one.captured_at == other.captured_at


def test_a_camera_tells_the_lens_that_was_taken_out_of_its_photograph():
    scene = snapshot()
    lens = Intrinsics(1280, 800, 900.0, 900.0, 640.0, 400.0, "estimated", (-0.2,))
    first, *others = scene.cameras
    live = decode_snapshot(sent(replace(scene, cameras=(replace(first, lens=lens), *others)))).snapshot
    assert [camera.lens for camera in live.cameras] == [lens, *(None for _ in others)]
    plain, _ = encode_snapshot(scene, "scene-0002", NUMBERED)
    assert "lens" not in msgspec.to_builtins(plain.cameras[0])  # as a viewer that knows none expects it


@pytest.mark.parametrize(
    "scale",
    [
        Scale(True, "poses of 3 photographs, known to 2.1 %", (0.9797, 1.0207)),
        Scale(False, "marker 0 contradicts poses of 3 photographs"),
    ],
)
def test_metres_and_the_reason_why_there_are_none_come_out_as_they_went_in(scale):
    assert decode_snapshot(sent(replace(snapshot(), scale=scale))).snapshot.scale == scale


CHECKS = (
    DepthCheck(DepthCode.FITS, "depth images of 4 photographs fit 900 points of the images", "wrist", 900),
    DepthCheck(DepthCode.SHIFTED, "they lie beside", "", 40, (10.0, -2.0), shift_is_least=True),
    DepthCheck(DepthCode.SCALE, "3 % too large", "head", 50, scale_error=0.03),
)


def test_what_the_images_say_of_depth_images_comes_out_as_it_went_in():
    assert decode_snapshot(sent(replace(snapshot(), depth_checks=CHECKS))).snapshot.depth_checks == CHECKS
    header, arrays = encode_snapshot(snapshot(), "scene-0002", NUMBERED)
    assert "depth_checks" not in msgspec.msgpack.decode(encode(header, arrays)[1])[0], "none came"
    assert decode_snapshot(sent(snapshot())).snapshot.depth_checks == ()


def test_a_relative_scene_is_the_message_of_a_splatnode_that_knows_no_live_metres():
    header, arrays = encode_snapshot(snapshot(), "scene-0002", NUMBERED)
    fields, _ = msgspec.msgpack.decode(encode(header, arrays)[1])
    assert "scale" not in fields
    assert decode_snapshot(sent(snapshot())).snapshot.scale == RELATIVE


def test_a_viewer_of_before_live_metres_refuses_a_metric_scene_with_a_sentence():
    earlier = without(SceneHeader, "scale")
    metric = replace(snapshot(), scale=Scale(True, "marker 0 of 100 mm", (0.98, 1.02)))
    relative, new = (
        encode(*encode_snapshot(scene, "scene-0002", NUMBERED)) for scene in (replace(metric, scale=RELATIVE), metric)
    )
    assert decode(relative, earlier).header.publishable
    with pytest.raises(WireError, match="^header refused: Object contains unknown field `scale`"):
        decode(new, earlier)


def test_thumbnails_are_small_and_look_like_the_photograph():
    scene = snapshot()
    images = decode_snapshot(sent(scene)).snapshot.images
    assert list(images) == list(scene.images)
    for name, image in images.items():
        assert image.shape == (200, 320, 3)
        assert abs(image.mean() - scene.images[name].mean()) < 1.5


def test_a_scene_that_may_not_be_shown_is_a_message_too():
    refused = Snapshot(1, Verdict(Code.TOO_FEW_VIEWS, "One.", "More."), (), GaussianArrays.empty(), {}, (), 0)
    live = decode_snapshot(sent(refused))
    assert len(live.snapshot.gaussians) == 0 and not live.snapshot.verdict.publishable


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda arrays: arrays[:5], "5 arrays"),
        (lambda arrays: arrays[:-1], "3 cameras with 2"),
        (lambda arrays: [arrays[0][:, :2], *arrays[1:]], "means"),
        (lambda arrays: [arrays[0], arrays[1][:-1], *arrays[2:]], "quats"),
        (lambda arrays: [*arrays[:5], arrays[5].astype(np.int64), *arrays[6:]], "source_frame"),
        (lambda arrays: [*arrays[:-1], np.zeros((100, 100, 3), np.uint8)], "bytes of a JPEG"),
        (
            lambda arrays: [*arrays[:-1], make_jpeg_array(np.zeros((321, 320, 3), np.uint8), 50)],
            "more than 102400 pixels",
        ),
        (lambda arrays: [*arrays[:-1], make_jpeg_array(np.zeros((321, 10, 3), np.uint8), 50)], "at most 320 pixels"),
        (lambda arrays: [*arrays[:-1], np.zeros(50, np.uint8)], "cannot be shown"),
    ],
)
def test_arrays_that_do_not_belong_to_the_header_are_refused(change, words):
    header, arrays = encode_snapshot(snapshot(), "scene-0001", NUMBERED)
    with pytest.raises(WireError, match=words):
        decode_snapshot(Message(header, tuple(change(arrays))))


LEAVES = {
    "cameras.0.T_world_camera": [(1.0, 2.0), (float("nan"),) * 16, (1e300,) * 16, (0.0,) * 16, np.diag([1, 1, -1, 1])],
    "cameras.0.T_world_camera.3": [float("nan"), float("inf"), 1e10, -1e10],
    "cameras.0.T_world_camera.15": [0.0, 2.0],
    "cameras.0.K": [(1.0, 2.0), (float("nan"),) * 9, (0.0,) * 9, np.diag([-1, 1, 1]), np.diag([5e-324, 1, 1])],
    "cameras.0.K.0": [0.0, -1.0, float("nan"), float("inf"), 1e10, 5e-324],
    "cameras.0.K.1": [1.0],
    "cameras.0.K.8": [0.0],
    "cameras.0.width": [0, -1, 2**16, 2**31, 2**62, 2**63, 1.5, "1"],
    "cameras.0.height": [0, -1, 65_535 + 1],
    "cameras.0.frame_id": [-2, 2**63],
    "cameras.0.name": ["", "\x1b[2J", "a" * 256, "\u202egnp", 5],
    "cameras.0.bounds.rotation_deg": [-1.0, float("nan")],
    "cameras.0.bounds.centre": [float("inf"), 1e300],
    "cameras.0.bounds.axes": [((0.0, 0.0, 0.0),) * 2, ((0.0, float("nan"), 0.0),) * 3],
    "code": ["FINE", "", 5, "\x07"],
    "message": ["\n", "a" * 1001],
    "advice": ["\u2028"],
    "scene_id": ["", "\x00"],
    "frames": [["\x1b"], ["a"] * 1001, "abc"],
    "dropped": [[["a", "\x1b"]], [["", ""]], [["a"]], [["a", "b"]] * 201],
    "iterations": [-2, 2**63, 1.5],
    "seconds": [{"poses": float("nan")}, {"poses": -1.0}, {"\x1b": 1.0}, {f"{i}": 1.0 for i in range(65)}],
    "cameras": [None, [1]],
    "session": ["0" * 31, "0" * 32 + "\n"],
}


def header_with(path: str, value: object) -> list[bytes]:
    """The parts of a scene whose header has this value in this place."""
    header, arrays = encode_snapshot(snapshot(), "scene-0001", NUMBERED)
    parts = [bytes(part) for part in encode(header, arrays)]
    envelope = msgspec.msgpack.decode(parts[1])
    *way, last = (int(step) if step.isdigit() else step for step in path.split("."))
    place = envelope[0]
    for step in way:
        place = place[step]
    place[last] = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    return [parts[0], msgspec.msgpack.encode(envelope), *parts[2:]]


@pytest.mark.parametrize(("path", "value"), [(path, value) for path, values in LEAVES.items() for value in values])
def test_what_makes_no_sense_in_a_header_does_not_pass_the_wire(path, value):
    with pytest.raises(WireError):
        decode(header_with(path, value), SceneHeader)


def test_a_camera_whose_picture_nobody_could_paint_does_not_pass_the_wire():
    parts = header_with("cameras.0.width", 60_000)
    decode(parts, SceneHeader)
    envelope = msgspec.msgpack.decode(parts[1])
    envelope[0]["cameras"][0]["height"] = 60_000
    with pytest.raises(WireError, match="pixels"):
        decode([parts[0], msgspec.msgpack.encode(envelope), *parts[2:]], SceneHeader)


@pytest.mark.parametrize("bases", [0, 2, 3, 5, 8, 17, 25, 1000])
def test_a_number_of_bases_that_no_degree_has_is_refused(bases):
    header, arrays = encode_snapshot(snapshot(), "scene-0001", NUMBERED)
    arrays[4] = np.zeros((10, bases, 3), np.float32)
    with pytest.raises(WireError, match="1, 4, 9, 16 bases"):
        decode_snapshot(Message(header, tuple(arrays)))


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), 3e38, -3e38])
@pytest.mark.parametrize("field", range(5))
def test_a_gaussian_with_an_absurd_number_is_left_out(field, number):
    header, arrays = encode_snapshot(snapshot(), "scene-0001", NUMBERED)
    arrays[field] = arrays[field].copy()
    arrays[field].reshape(10, -1)[3, -1] = number
    gaussians = decode_snapshot(Message(header, tuple(arrays))).snapshot.gaussians
    assert len(gaussians) == 9 and gaussians.source_frame.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]


def test_what_is_said_of_a_scene_is_cut_to_what_a_message_holds():
    long = "a\n" * 5000
    verdict = Verdict(Code.OK, long, long, ("x",) * 3000)
    live = decode_snapshot(
        sent(replace(snapshot(), verdict=verdict, dropped=(DroppedFrame("", long),) * 2500))
    ).snapshot
    assert len(live.verdict.message) == 1000 and "\n" not in live.verdict.message
    assert len(live.dropped) == 200 and len(live.verdict.frames) == 1000


def test_a_bound_that_cannot_be_reckoned_with_is_refused_and_never_sent():
    scene, tiny = snapshot(1), Bounds(1e-320, 0.0, 1e-15, 1.0, ((0.0, 0.0, 0.0),) * 3)
    exact = replace(scene.cameras[0], bounds=tiny)
    live = decode_snapshot(sent(replace(scene, cameras=(exact,))))
    bounds = live.snapshot.cameras[0].bounds
    assert bounds is not None and (bounds.rotation_deg, bounds.centre, bounds.centre_percent) == (1e-9, 0.0, 1e-9)
    record = msgspec.to_builtins(make_camera_record(exact))
    record["bounds"]["focal_percent"] = 1e-320
    with pytest.raises(msgspec.ValidationError, match="a bound must be 0 or at least 1e-09"):
        msgspec.convert(record, CameraRecord)
