"""A scene crosses the wire unchanged, and what is no scene is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.messaging.jpeg import to_jpeg
from splatnode.capture.messaging.wire import Message, Numbering, WireError, decode, encode
from splatnode.recon.result.bounds import Bounds
from splatnode.recon.result.message import SceneHeader, bounds_record, from_message, to_message
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict

RANDOM = np.random.default_rng(0)
NUMBERED = Numbering(session="0123456789abcdef" * 2).next() | {"sequence": 7}


def camera(index: int) -> CameraEstimate:
    return CameraEstimate(
        f"{index}.png",
        index,
        RANDOM.normal(size=(4, 4)),
        np.diag([300.0, 301, 1]),
        320,
        200,
        Bounds(0.1, 0.02, 2.0, 1.5, ((0.03, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.005, 0.0))),
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
    header, arrays = to_message(scene, "scene-0002", NUMBERED)
    return decode([bytes(part) for part in encode(header, arrays)], SceneHeader)


def test_a_scene_comes_out_as_it_went_in():
    scene = snapshot()
    live = from_message(sent(scene))
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
        assert one.bounds == other.bounds is not None


def test_thumbnails_are_small_and_look_like_the_photograph():
    scene = snapshot()
    images = from_message(sent(scene)).snapshot.images
    assert list(images) == list(scene.images)
    for name, image in images.items():
        assert image.shape == (200, 320, 3)
        assert abs(image.mean() - scene.images[name].mean()) < 1.5


def test_a_scene_that_may_not_be_shown_is_a_message_too():
    refused = Snapshot(1, Verdict(Code.TOO_FEW_VIEWS, "One.", "More."), (), GaussianArrays.empty(), {}, (), 0)
    live = from_message(sent(refused))
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
        (lambda arrays: [*arrays[:-1], to_jpeg(np.zeros((321, 320, 3), np.uint8), 50)], "more than 102400 pixels"),
        (lambda arrays: [*arrays[:-1], to_jpeg(np.zeros((321, 10, 3), np.uint8), 50)], "at most 320 pixels"),
        (lambda arrays: [*arrays[:-1], np.zeros(50, np.uint8)], "cannot be shown"),
    ],
)
def test_arrays_that_do_not_belong_to_the_header_are_refused(change, words):
    header, arrays = to_message(snapshot(), "scene-0001", NUMBERED)
    with pytest.raises(WireError, match=words):
        from_message(Message(header, tuple(change(arrays))))


def test_an_unknown_verdict_is_refused():
    header, arrays = to_message(snapshot(), "scene-0001", NUMBERED)
    with pytest.raises(WireError, match="FINE"):
        from_message(Message(msgspec.structs.replace(header, code="FINE"), tuple(arrays)))


@pytest.mark.parametrize(
    "change",
    [
        {"rotation_deg": -1.0},
        {"centre": float("inf")},
        {"axes": ((0.0, 0.0, 0.0),) * 2},
        {"axes": ((0.0, float("nan"), 0.0),) * 3},
    ],
)
def test_bounds_without_meaning_do_not_pass_the_wire(change):
    header, arrays = to_message(snapshot(), "scene-0001", NUMBERED)
    bounds = msgspec.structs.replace(bounds_record(snapshot().cameras[0].bounds), **change)
    broken = msgspec.structs.replace(header.cameras[0], bounds=bounds)
    parts = encode(msgspec.structs.replace(header, cameras=(broken, *header.cameras[1:])), arrays)
    with pytest.raises(WireError):
        decode(parts, SceneHeader)


@pytest.mark.parametrize("field", ["T_world_camera", "K"])
def test_a_matrix_of_the_wrong_size_or_without_numbers_does_not_pass_the_wire(field):
    header, arrays = to_message(snapshot(), "scene-0001", NUMBERED)
    for value in ((1.0, 2.0), (float("nan"),) * len(getattr(header.cameras[0], field))):
        broken = msgspec.structs.replace(header.cameras[0], **{field: value})
        parts = encode(msgspec.structs.replace(header, cameras=(broken, *header.cameras[1:])), arrays)
        with pytest.raises(WireError):
            decode(parts, SceneHeader)
