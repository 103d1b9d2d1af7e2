"""The OAK camera: DepthAI's own replay node stands for the stream; the device itself is a stand-in made of Python."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
import time
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatnode.capture.cameras import depthai as oak
from splatnode.capture.cameras.depthai import (
    Config,
    DepthConverter,
    Source,
    convert_frame,
    convert_stereo_pair,
    find,
    read,
    stream,
)
from splatnode.capture.depth_image import DepthNoise
from splatnode.capture.frame import (
    Baseline,
    CameraUnavailable,
    Clock,
    DroppedFrame,
    ExposureSettings,
    Frame,
    Intrinsics,
)
from tests.conftest import ROOT

PERSPECTIVE = "CameraModel.Perspective"
LENS = [[800.0, 0, 639.5], [0, 801.0, 359.5], [0, 0, 1]]


class QueueException(RuntimeError):
    pass


def message(index=0, K=LENS, distortion=(), model=PERSPECTIVE):
    transformation = SimpleNamespace(
        getIntrinsicMatrix=lambda: K,
        getDistortionCoefficients=lambda: list(distortion),
        getDistortionModel=lambda: model,
    )
    return SimpleNamespace(
        getTimestamp=lambda: timedelta(seconds=100_000, microseconds=index),
        getCvFrame=lambda: np.full((720, 1280, 3), (1, 2, 3), np.uint8),
        getTransformation=lambda: transformation,
        getExposureTime=lambda: timedelta(milliseconds=8),
        getSensitivity=lambda: 200,
    )


class FakeDepthai:
    """As much of `dai` as the camera uses; remembers what it was told."""

    def __init__(self, devices=(), messages=()):
        self.told: list[Any] = []
        infos = [
            SimpleNamespace(
                getDeviceId=lambda name=name: name,
                name=f"usb-{name}",
                platform=SimpleNamespace(name="RVC2"),
                state=SimpleNamespace(name="UNBOOTED"),
            )
            for name in devices
        ]
        supply = iter(messages)
        queue = SimpleNamespace(get=lambda timeout: self._next(supply))
        output = SimpleNamespace(createOutputQueue=lambda **how: self.told.append(how) or queue)
        camera = SimpleNamespace(
            build=lambda socket: camera,
            requestOutput=lambda size, *rest, **how: self.told.append((size, how)) or output,
            inputControl=SimpleNamespace(createInputQueue=lambda: SimpleNamespace(send=self.told.append)),
        )
        pipeline = SimpleNamespace(create=lambda node: camera, start=lambda: self.told.append("start"))
        self.Device = _Opened(lambda info: self.told.append(info.getDeviceId()), None)
        self.Device.getAllAvailableDevices = lambda: infos
        self.Pipeline = _Opened(lambda device: None, pipeline)
        self.node = SimpleNamespace(Camera="Camera")
        self.CameraBoardSocket = SimpleNamespace(CAM_A="A")
        self.ImgFrame = SimpleNamespace(Type=SimpleNamespace(BGR888i="BGR"))
        self.ImgResizeMode = SimpleNamespace(CROP="crop")
        self.LengthUnit = SimpleNamespace(METER="m")
        self.MessageQueue = SimpleNamespace(QueueException=QueueException)
        self.CameraControl = _Control

    @staticmethod
    def _next(supply):
        item = next(supply, None)
        if isinstance(item, Exception):
            raise item
        return item


class _Opened:
    """A class whose instances are context managers around `inside`."""

    getAllAvailableDevices: Any

    def __init__(self, on_open, inside):
        self._on_open, self._inside = on_open, inside

    def __call__(self, argument):
        self._on_open(argument)
        return self

    def __enter__(self):
        return self._inside

    def __exit__(self, *_):
        return None


class _Control:
    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *values: self.calls.append((name, *values))


def use(monkeypatch, fake):
    monkeypatch.setattr(oak, "_depthai", lambda: fake)
    return fake


def framed(message, frame_id: int) -> Frame:
    """The frame of a message that is one."""
    frame = convert_frame(message, frame_id)
    assert isinstance(frame, Frame)
    return frame


def test_a_frame_has_its_own_calibration():
    frame = framed(message(7, distortion=(0.1, -0.2, 0, 0, 0.05)), 3)
    assert (frame.frame_id, frame.stamp_ns, frame.name) == (3, 100_000_000_007_000, "100000.000007")
    assert frame.captured_at is not None and frame.captured_at.clock is Clock.UTC
    assert abs(frame.captured_at.ns - frame.stamp_ns - (time.time_ns() - time.monotonic_ns())) < 100_000_000
    assert frame.image[0, 0].tolist() == [3, 2, 1]
    expected = Intrinsics(1280, 720, 800.0, 801.0, 640.0, 360.0, "calibration", (0.1, -0.2, 0, 0, 0.05))
    assert frame.intrinsics == expected
    assert framed(message(distortion=(0.0,) * 14), 0).intrinsics.distortion == ()
    fisheye = framed(message(distortion=(0.1, 0.02, 0, 0) + (0.0,) * 10, model="CameraModel.Fisheye"), 0).intrinsics
    assert (fisheye.model, fisheye.distortion) == ("fisheye", (0.1, 0.02, 0, 0))


def test_a_frame_has_the_exposure_that_the_camera_tells():
    assert framed(message(), 0).exposure == ExposureSettings(0.008, 200.0)
    left = convert_stereo_pair(Baseline(0.075), pair(), 0)
    assert isinstance(left, Frame) and left.exposure == ExposureSettings(0.008, 200.0)


@pytest.mark.parametrize(
    ("told", "strange"),
    [
        *(("getExposureTime", each) for each in (timedelta(0), timedelta(days=-1), timedelta.max, None, 8000)),
        *(("getSensitivity", each) for each in (0, -1, 2**31, None, "200")),
    ],
)
def test_an_exposure_that_cannot_be_is_none(told, strange):
    changed = message()
    setattr(changed, told, lambda: strange)
    assert framed(changed, 0).exposure is None


@pytest.mark.parametrize(
    ("K", "distortion", "model"),
    [(np.eye(3).tolist(), (), PERSPECTIVE), ([], (), PERSPECTIVE), (LENS, (0.1, 0, 0, 0), "CameraModel.Radial")],
)
def test_what_is_no_pinhole_calibration_is_unknown(K, distortion, model):
    assert framed(message(K=K, distortion=distortion, model=model), 0).intrinsics is None


def test_without_a_camera_it_says_so_at_once(monkeypatch):
    use(monkeypatch, FakeDepthai())
    with pytest.raises(CameraUnavailable, match="no OAK camera is connected.*udev"):
        next(stream(Config()))


@pytest.mark.parametrize("device", ["", "third"])
def test_which_of_several_must_be_said(monkeypatch, device):
    use(monkeypatch, FakeDepthai(["first", "second"]))
    with pytest.raises(CameraUnavailable, match="must name one of: first at usb-first, second at usb-second"):
        next(stream(Config(device=device)))


def test_what_the_camera_is_asked_for(monkeypatch):
    fake = use(monkeypatch, FakeDepthai(["first", "second"], map(message, range(9))))
    config = Config(device="second", warmup_s=0, focus=120, fps=15, undistort=False)
    frames = list(itertools.islice(stream(config), 2))
    name, (size, how), queue, start, focus, hold = fake.told
    assert (name, size, start) == ("second", (1280, 720), "start")
    assert how == {"fps": 15, "enableUndistortion": False} and queue == {"maxSize": 2, "blocking": False}
    assert focus.calls == [("setManualFocus", 120)]
    assert hold.calls == [("setAutoExposureLock", True), ("setAutoWhiteBalanceLock", True)]
    assert [frame.name for frame in frames] == ["100000.000001", "100000.000002"]  # the first was exposed before


def test_a_given_exposure_is_set(monkeypatch):
    fake = use(monkeypatch, FakeDepthai(["only"], map(message, range(9))))
    next(stream(Config(warmup_s=0, exposure_us=5000, iso=200)))
    assert fake.told[-1].calls == [("setManualExposure", 5000, 200), ("setAutoWhiteBalanceLock", True)]


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (None, "no frame for 4 s"),
        (QueueException("closed"), "ended its stream: closed"),
        (RuntimeError("X_LINK_ERROR"), "the camera only failed: X_LINK_ERROR"),
    ],
)
def test_a_lost_camera_says_why(monkeypatch, end, reason):
    use(monkeypatch, FakeDepthai(["only"], [message(0), message(1), end]))
    frames = stream(Config(lock_exposure=False))
    assert [next(frames).name, next(frames).name] == ["100000.000000", "100000.000001"]
    with pytest.raises(CameraUnavailable, match=reason):
        next(frames)


def test_found_cameras_are_named_as_the_configuration_wants_them(monkeypatch):
    pytest.importorskip("depthai", reason="find() asks only where depthai is installed")
    use(monkeypatch, FakeDepthai(["first"]))
    assert find() == [{"device": "first", "description": "RVC2 at usb-first (UNBOOTED)"}]


def test_the_real_library_is_asked_and_prints_nothing():
    pytest.importorskip("depthai", reason="needs the extra oak")
    program = "from splatnode.capture.cameras import depthai; assert isinstance(depthai.find(), list)"
    environment = {key: value for key, value in os.environ.items() if key != "DEPTHAI_LEVEL"}
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_depthais_own_replay(tmp_path, monkeypatch):
    """The messages and queues are DepthAI's; only the camera is a file."""
    monkeypatch.setenv("DEPTHAI_LEVEL", "off")
    dai = pytest.importorskip("depthai", reason="needs the extra oak")
    file = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 20, (160, 120))
    for index in range(12):
        writer.write(np.full((120, 160, 3), (20 * index, 100, 50), np.uint8))
    writer.release()
    with dai.Pipeline(False) as pipeline:
        replay = pipeline.create(dai.node.ReplayVideo)
        replay.setReplayVideoFile(file)
        replay.setOutFrameType(dai.ImgFrame.Type.BGR888i)
        replay.setLoop(False)
        replay.setFps(20)
        queue = replay.out.createOutputQueue(maxSize=30, blocking=True)
        pipeline.start()
        frames = []
        with pytest.raises(CameraUnavailable, match="ended its stream"):
            for frame in read(dai, Source(queue, (), convert_frame), Config(lock_exposure=False), hold=lambda: None):
                frames.append(frame)
    assert len(frames) >= 10
    assert all(frame.image.shape == (120, 160, 3) and frame.intrinsics is None for frame in frames)
    assert np.allclose([frame.image[60, 80, 2] for frame in frames], 20 * np.arange(len(frames)), atol=6)
    assert (np.diff([frame.stamp_ns for frame in frames]) > 0).all()


class FakeStereo(FakeDepthai):
    """A device with two stereo cameras; `baseline` is what its calibration tells."""

    def __init__(self, messages, baseline=0.075):
        super().__init__(["only"])
        self.links: list[str] = []
        supply = iter(messages)
        queue = SimpleNamespace(get=lambda timeout: self._next(supply))
        nodes = {"Camera": self._camera, "StereoDepth": self._stereo, "Sync": lambda: self._sync(queue)}
        pipeline = SimpleNamespace(create=lambda node: nodes[node](), start=lambda: self.told.append("start"))
        found = self.Device.getAllAvailableDevices
        calibration = SimpleNamespace(getBaselineDistance=lambda *asked: self._baseline(asked, baseline))
        self.Device = _Opened(lambda info: None, SimpleNamespace(readCalibration=lambda: calibration))
        self.Device.getAllAvailableDevices = found
        self.Pipeline = _Opened(lambda device: None, pipeline)
        self.node = SimpleNamespace(Camera="Camera", StereoDepth="StereoDepth", Sync="Sync")
        self.CameraBoardSocket = SimpleNamespace(CAM_B="B", CAM_C="C")

    @staticmethod
    def _baseline(asked, baseline):
        assert asked == ("C", "B", False, "m")
        if baseline is None:
            raise RuntimeError("no calibration data")
        return baseline

    def _camera(self):
        sockets = []
        camera = SimpleNamespace(
            build=lambda socket: sockets.append(socket) or camera,
            requestOutput=lambda size, **how: self.told.append((size, how)) or self._linked(f"camera {sockets[0]}"),
            inputControl=SimpleNamespace(createInputQueue=lambda: SimpleNamespace(send=self.told.append)),
        )
        return camera

    def _stereo(self):
        return SimpleNamespace(
            left="left",
            right="right",
            setRectification=lambda on: self.told.append(("rectified", on)),
            rectifiedLeft=self._linked("rectified left"),
            rectifiedRight=self._linked("rectified right"),
        )

    def _sync(self, queue):
        return SimpleNamespace(
            inputs={"left": "sync left", "right": "sync right"},
            setSyncThreshold=lambda apart: self.told.append(("together within", apart)),
            out=SimpleNamespace(createOutputQueue=lambda **how: queue),
        )

    def _linked(self, name):
        return SimpleNamespace(link=lambda to: self.links.append(f"{name} -> {to}"))


def pair(index=0, left=60, right=90, shape=(120, 160)):
    """A group of the messages of two grey cameras."""
    group = {"left": message(index), "right": message(index)}
    group["left"].getCvFrame = lambda: np.full((120, 160), left, np.uint8)
    group["right"].getCvFrame = lambda: np.full(shape, right, np.uint8)
    return group


def test_stereo_cameras_give_pairs_with_the_baseline_of_their_calibration(monkeypatch):
    fake = use(monkeypatch, FakeStereo([pair(index) for index in range(4)]))
    first, second = itertools.islice(stream(Config(stereo=True, warmup_s=0, width=160, height=120)), 2)
    assert isinstance(first, Frame) and (first.frame_id, second.name) == (0, "100000.000002")
    assert first.image.shape == (120, 160, 3) and np.unique(first.image).tolist() == [60]
    assert first.right is not None and np.unique(first.right.image).tolist() == [90]
    assert first.right.baseline == Baseline(0.075)
    linked = ["camera B -> left", "camera C -> right", "rectified left -> sync left", "rectified right -> sync right"]
    assert fake.links == linked
    assert ("rectified", True) in fake.told and ("together within", timedelta(seconds=0.05)) in fake.told
    assert [each.calls[0][0] for each in fake.told if isinstance(each, _Control)] == ["setAutoExposureLock"] * 2


@pytest.mark.parametrize("baseline", [None, 0.0, float("nan")])
def test_stereo_cameras_without_a_calibration_say_so(monkeypatch, baseline):
    use(monkeypatch, FakeStereo([pair()], baseline))
    with pytest.raises(CameraUnavailable, match="stereo baseline is not known.*set camera.stereo to false"):
        next(stream(Config(stereo=True)))


def test_a_right_picture_of_another_size_leaves_the_pair_out():
    left_out = convert_stereo_pair(Baseline(0.075), pair(shape=(60, 80)), 0)
    assert isinstance(left_out, DroppedFrame) and "its right image cannot be used" in left_out.reason


def test_depthai_has_what_pairs_need():
    """The names are DepthAI's own; only a device could run them."""
    dai = pytest.importorskip("depthai", reason="needs the extra oak")
    with dai.Pipeline(False) as pipeline:
        sync = pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.05))
        assert sync.inputs["left"] and sync.inputs["right"]
    stereo = dai.node.StereoDepth
    assert stereo.setRectification and stereo.rectifiedLeft and stereo.rectifiedRight and stereo.left and stereo.right
    assert dai.CalibrationHandler().getBaselineDistance and dai.LengthUnit.METER
    assert dai.CameraBoardSocket.CAM_B and dai.CameraBoardSocket.CAM_C


class FakeDepth(FakeStereo):
    """A device whose stereo node measures depth beside the colour camera."""

    def __init__(self, messages, platform="RVC2", there=("A", "B", "C"), baseline=0.075, focal=450.0):
        super().__init__(messages, baseline)
        supply = iter(messages)
        self.queue = SimpleNamespace(get=lambda timeout: self._next(supply))
        nodes = {
            "Camera": self._colour_or_side,
            "StereoDepth": self._depth_node,
            "Sync": lambda: self._sync(self.queue),
            "ImageAlign": self._align,
        }
        pipeline = SimpleNamespace(create=lambda node: nodes[node](), start=lambda: self.told.append("start"))
        calibration = SimpleNamespace(
            getBaselineDistance=lambda *asked: self._baseline(asked, baseline),
            getCameraIntrinsics=lambda *asked: self._focal(asked, focal),
        )
        found = self.Device.getAllAvailableDevices
        device = SimpleNamespace(
            getConnectedCameras=lambda: list(there),
            getPlatform=lambda: platform,
            readCalibration=lambda: calibration,
        )
        self.Device = _Opened(lambda info: None, device)
        self.Device.getAllAvailableDevices = found
        self.Pipeline = _Opened(lambda device: None, pipeline)
        self.node = SimpleNamespace(**{name: name for name in nodes})
        self.CameraBoardSocket = SimpleNamespace(CAM_A="A", CAM_B="B", CAM_C="C")
        self.Platform = SimpleNamespace(RVC4="RVC4")

    @staticmethod
    def _focal(asked, focal):
        assert asked == ("C", 640, 400)
        return [[focal, 0.0, 320.0], [0.0, focal, 200.0], [0.0, 0.0, 1.0]]

    def _colour_or_side(self):
        camera = self._camera()
        request = camera.requestOutput

        def request_output(size, *rest, **how):
            output = request(size, **how)
            output.createOutputQueue = lambda **options: self.queue
            return output

        camera.requestOutput = request_output
        return camera

    def _depth_node(self):
        return SimpleNamespace(
            left="left",
            right="right",
            inputAlignTo="stereo's colour",
            setRectification=lambda on: self.told.append(("rectified", on)),
            setLeftRightCheck=lambda on: self.told.append(("checked", on)),
            setSubpixel=lambda on: self.told.append(("subpixels", on)),
            depth=self._linked("depth"),
        )

    def _align(self):
        return SimpleNamespace(input="align", inputAlignTo="align's colour", outputAligned=self._linked("aligned"))

    def _sync(self, queue):
        node = super()._sync(queue)
        node.inputs = {"colour": "sync colour", "depth": "sync depth"}
        return node


def shot(index=0, late_ms=0.0, values=None):
    """A group of a colour message and of the depth beside it: 1 and 2 m, a hole, and what 16 bits cannot say."""
    depth = np.tile(np.array([1000, 2000, 0, 65_535], np.uint16), (720, 320)) if values is None else values
    measured = SimpleNamespace(
        getTimestamp=lambda: timedelta(seconds=100_000, microseconds=index, milliseconds=late_ms),
        getCvFrame=lambda: depth,
    )
    return {"colour": message(index), "depth": measured}


SIDES = ["camera B -> left", "camera C -> right"]
ALIGNED_BY = {
    "RVC2": [*SIDES, "camera A -> stereo's colour", "depth -> sync depth", "camera A -> sync colour"],
    "RVC4": [
        *SIDES,
        "depth -> align",
        "camera A -> align's colour",
        "aligned -> sync depth",
        "camera A -> sync colour",
    ],
}


@pytest.mark.parametrize("platform", ["RVC2", "RVC4"])
@pytest.mark.parametrize("depth", ["available", "required"])
def test_depth_goes_with_the_colour_frames(monkeypatch, platform, depth):
    fake = use(monkeypatch, FakeDepth([shot(index) for index in range(4)], platform))
    first, second = itertools.islice(stream(Config(depth=depth, warmup_s=0)), 2)
    assert isinstance(first, Frame) and (first.frame_id, second.name) == (0, "100000.000002")
    assert first.image.shape == (720, 1280, 3) and first.right is None and first.depth is not None
    assert first.depth.is_aligned and first.depth.metres[5, :4].tolist() == [1.0, 2.0, 0.0, 0.0]
    assert first.depth.confidence is None
    near, far = first.depth.noise.compute_sigma(np.array([1.0, 4.0]))
    assert near == pytest.approx(0.002 + 0.25 / (450 * 0.075)) and far - 0.002 == pytest.approx(16 * (near - 0.002))
    assert fake.links == ALIGNED_BY[platform]
    for told in (
        ("rectified", True),
        ("checked", True),
        ("subpixels", True),
        ((640, 400), {"resizeMode": "crop", "fps": 10}),
    ):
        assert told in fake.told
    assert ("together within", timedelta(seconds=0.05)) in fake.told
    assert [each.calls[0][0] for each in fake.told if isinstance(each, _Control)] == ["setAutoExposureLock"]  # colour's


def test_a_device_that_gives_no_pair_says_what_to_try(monkeypatch):
    use(monkeypatch, FakeDepth([shot(), None]))
    frames = stream(Config(depth="required", lock_exposure=False))
    next(frames)
    with pytest.raises(CameraUnavailable, match="still plugged in. If it is, it may measure no depth: try"):
        next(frames)


LACKING = [
    ({"there": ("A",)}, "has no pair of stereo cameras"),
    ({"baseline": None}, "are not calibrated .no calibration data"),
    ({"baseline": 0.0}, "are not calibrated"),
    ({"focal": 1.0}, "are not calibrated .its focal length is 1 pixels"),
    ({"focal": float("nan")}, "are not calibrated"),
]


@pytest.mark.parametrize(("lacking", "reason"), LACKING)
def test_a_device_that_cannot_measure_depth_says_so_or_sends_colour_alone(monkeypatch, caplog, lacking, reason):
    use(monkeypatch, FakeDepth(map(message, range(4)), **lacking))
    with pytest.raises(CameraUnavailable, match=f"{reason}.*so it measures no depth. Set camera.depth to available"):
        next(stream(Config(depth="required")))
    fake = use(monkeypatch, FakeDepth(map(message, range(4)), **lacking))
    frame = next(stream(Config(depth="available", lock_exposure=False)))
    assert isinstance(frame, Frame) and frame.depth is None and fake.links == []
    assert re.search(f"no_depth.*{reason}", caplog.text) and "colour images alone" in caplog.text


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"late_ms": 51.0}, "taken 51.0 ms from its image, at most 50.0 ms count"),
        ({"values": np.full((720, 1280), 90, np.uint8)}, "must be of 16 bits, millimetres, got uint8"),
        (
            {"values": np.full((400, 400), 900, np.uint16)},
            "must have the shape of its image, 1280 x 720; got 400 x 400",
        ),
    ],
)
def test_a_depth_image_that_cannot_be_used_is_left_out_and_told_once(caplog, changed, reason):
    convert = DepthConverter(DepthNoise(0.002, 0.008), 0.05)
    for index in range(3):
        frame = convert(shot(index, **changed), index)
        assert isinstance(frame, Frame) and frame.depth is None
    assert caplog.text.count("depth_left_out") == 1 and reason in caplog.text
    good = convert(shot(4, late_ms=-49.0), 3)
    assert isinstance(good, Frame) and good.depth is not None


@pytest.mark.parametrize(
    ("changed", "reason"),
    [({"stereo": True}, "set one of them"), ({"undistort": False}, "needs undistort: true")],
)
def test_depth_that_goes_with_no_colour_image_is_refused(changed, reason):
    with pytest.raises(ValueError, match=reason):
        Config(depth="available", **changed)


def test_depthai_has_what_depth_needs():
    """The names are DepthAI's own, and so is the message; only a device could run the nodes."""
    dai = pytest.importorskip("depthai", reason="needs the extra oak")
    stereo, align = dai.node.StereoDepth, dai.node.ImageAlign
    assert stereo.depth and stereo.inputAlignTo and stereo.setLeftRightCheck and stereo.setSubpixel
    assert align.input and align.inputAlignTo and align.outputAligned
    assert dai.Device.getConnectedCameras and dai.Device.getPlatform and dai.Platform.RVC4
    assert "resizeWidth: int" in dai.CalibrationHandler.getCameraIntrinsics.__doc__
    measured = dai.ImgFrame()
    measured.setCvFrame(np.full((4, 6), 1234, np.uint16), dai.ImgFrame.Type.RAW16)
    assert measured.getCvFrame().dtype == np.uint16 and (measured.getCvFrame() == 1234).all()


def test_depthai_s_messages_tell_time_and_sensitivity_or_zeros():
    dai = pytest.importorskip("depthai", reason="needs the extra oak")
    fresh = dai.ImgFrame()
    assert (fresh.getExposureTime(), fresh.getSensitivity()) == (timedelta(0), 0)
