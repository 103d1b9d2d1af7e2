"""A Luxonis OAK camera through DepthAI v3: its colour stream, with depth images or not, or its stereo pairs."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from types import ModuleType
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import NOISES, DepthNoise, make_depth_image
from splatnode.capture.frame import (
    Baseline,
    CameraUnavailable,
    DroppedFrame,
    ExposureSettings,
    Frame,
    FramesPerSecond,
    Intrinsics,
    RightImage,
    grey,
    make_frame,
    parse_exposure,
    wall_clock,
)
from splatnode.capture.process.terminal import event
from splatnode.capture.process.text import sanitize_text

log = logging.getLogger(__name__)

LIVE = True
_MIN_FOCAL = 0.1  # in longer image sides; a device without calibration gives the identity matrix
_STEREO_SIZE = (640, 400)  # pixels, at which the device matches its stereo cameras' images
_MATCH_PX = 0.25  # standard deviation of a disparity at that size, with subpixels
_SATURATED = 65_535  # millimetres: of what is farther than 16 bits can say


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    device: str = ""  # as `splatnode list-cameras` prints it: id, IP address or USB port; "": the only one
    width: Annotated[int, msgspec.Meta(ge=1)] = 1280  # of an image, pixels
    height: Annotated[int, msgspec.Meta(ge=1)] = 720  # of an image, pixels
    fps: FramesPerSecond = 10.0  # that the camera is asked for
    undistort: bool = True  # take the distortion out on the camera; otherwise it goes with the intrinsics
    lock_exposure: bool = True  # hold exposure and white balance, once the camera has chosen them
    # After the start, in which the camera chooses them; these frames are not given
    warmup_s: Annotated[float, msgspec.Meta(ge=0)] = 1.5
    # Instead of what the camera chooses; None: it chooses
    exposure_us: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] | None = None
    iso: Annotated[int, msgspec.Meta(ge=100, le=1600)] = 400  # sensitivity, with exposure_us
    focus: Annotated[int, msgspec.Meta(ge=0, le=255)] | None = None  # position of the lens; None: as it is at the start
    frame_timeout_s: Annotated[float, msgspec.Meta(gt=0)] = 4.0  # so long without a frame, the camera counts as lost
    # Use the left stereo camera, not the colour camera, and send the right image with each frame: lengths are metres by
    # the device's baseline. Rectified on the device; grey where the sensors are
    stereo: bool = False
    # Depth images of the device's stereo cameras, aligned with the colour images, with each frame: lengths are metres.
    # available: where the device cannot measure depth, it says so, and sends colour images alone; required: it stops
    depth: Literal["none", "available", "required"] = "none"

    def __post_init__(self) -> None:
        if self.depth != "none" and self.stereo:
            raise ValueError("stereo and depth are two ways to metres; set one of them: stereo: true, or depth")
        if self.depth != "none" and not self.undistort:
            raise ValueError(
                f"depth: {self.depth} needs undistort: true: the device aligns depth with undistorted images alone"
            )

    @property
    def sync_s(self) -> float:
        """How far apart images that count as taken together may be, seconds: half of the time between frames."""
        return 0.5 / self.fps


@dataclass(frozen=True)
class Source:
    """The parts of a pipeline that are read and commanded."""

    queue: Any
    cameras: tuple[Any, ...]  # nodes
    to_frame: Callable[[Any, int], Frame | DroppedFrame]
    # Of a message of the queue, the ImgFrame that tells its exposure
    lead: Callable[[Any], Any] = lambda message: message


def stream(config: Config) -> Iterator[Frame | DroppedFrame]:
    """Frames as they come, with the calibration that the camera carries. Raises CameraUnavailable, also when unplugged.

    Whether there is a camera is asked first: opening one that is not there takes 11 seconds to fail.
    """
    dai = _depthai()
    info = _select_device(dai, config.device)
    try:
        with dai.Device(info) as device, dai.Pipeline(device) as pipeline:
            source = _choose_source(dai, device, pipeline, config)
            controls = [camera.inputControl.createInputQueue() for camera in source.cameras]
            pipeline.start()
            if config.focus is not None:
                _send(controls, _control(dai, focus=config.focus))
            yield from read(dai, source, config, hold=lambda: _send(controls, make_exposure_lock(dai, config)))
    except RuntimeError as error:
        if isinstance(error, CameraUnavailable):
            raise
        raise CameraUnavailable(f"the camera {info.getDeviceId()} failed: {error}") from error


def _send(controls: list[Any], command: Any) -> None:
    for each in controls:
        each.send(command)


def _choose_source(dai: ModuleType, device: Any, pipeline: Any, config: Config) -> Source:
    """Returns what the configuration asks for, or colour alone where depth may be missing. Raises CameraUnavailable."""
    if config.stereo:
        return _pairs(dai, device, pipeline, config)
    if config.depth == "none":
        return _colour(dai, pipeline, config)
    try:
        noise = _find_noise(dai, device)
    except CameraUnavailable as error:
        if config.depth == "required":
            raise CameraUnavailable(
                f"{error}, so it measures no depth. Set camera.depth to available for colour images alone"
            ) from error
        event(log, logging.WARNING, "no_depth", reason=sanitize_text(error), sent="colour images alone")
        return _colour(dai, pipeline, config)
    event(log, logging.INFO, "depth", sigma_at_2_m=f"{noise.a_m + 4 * noise.b_per_m:.3f}", within_s=config.sync_s)
    return _colour_with_depth(dai, device, pipeline, config, noise)


def _request_colour(dai: ModuleType, pipeline: Any, config: Config) -> tuple[Any, Any]:
    """Returns the node of the colour camera, and its output."""
    camera = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A)
    output = camera.requestOutput(
        (config.width, config.height),
        dai.ImgFrame.Type.BGR888i,
        dai.ImgResizeMode.CROP,
        fps=config.fps,
        enableUndistortion=config.undistort,
    )
    return camera, output


def _colour(dai: ModuleType, pipeline: Any, config: Config) -> Source:
    camera, output = _request_colour(dai, pipeline, config)
    return Source(output.createOutputQueue(maxSize=2, blocking=False), (camera,), convert_frame)


def _colour_with_depth(dai: ModuleType, device: Any, pipeline: Any, config: Config, noise: DepthNoise) -> Source:
    """Returns the colour and the depth image of one moment, which the device aligns: RVC2 as it matches, RVC4 behind.

    The node's confidence map is not aligned, so it is not used.
    """
    camera, colour = _request_colour(dai, pipeline, config)
    stereo, sync = pipeline.create(dai.node.StereoDepth), pipeline.create(dai.node.Sync)
    stereo.setRectification(True)
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    sides = ((dai.CameraBoardSocket.CAM_B, stereo.left), (dai.CameraBoardSocket.CAM_C, stereo.right))
    for socket, side in sides:
        beside = pipeline.create(dai.node.Camera).build(socket)
        beside.requestOutput(_STEREO_SIZE, resizeMode=dai.ImgResizeMode.CROP, fps=config.fps).link(side)
    if device.getPlatform() == dai.Platform.RVC4:
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        colour.link(align.inputAlignTo)
        align.outputAligned.link(sync.inputs["depth"])
    else:
        colour.link(stereo.inputAlignTo)
        stereo.depth.link(sync.inputs["depth"])
    colour.link(sync.inputs["colour"])
    sync.setSyncThreshold(timedelta(seconds=config.sync_s))
    queue = sync.out.createOutputQueue(maxSize=2, blocking=False)
    convert = DepthConverter(noise, config.sync_s)
    return Source(queue, (camera,), convert, lambda group: group["colour"])


def _find_noise(dai: ModuleType, device: Any) -> DepthNoise:
    """Computes what an error of matching makes of depth, by the calibration of this very device.

    Raises CameraUnavailable where it has no stereo cameras, or does not know them.
    """
    left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    there = list(device.getConnectedCameras())
    if left not in there or right not in there:
        raise CameraUnavailable("the camera has no pair of stereo cameras (CAM_B and CAM_C)")
    try:
        calibration = device.readCalibration()
        metres = abs(float(calibration.getBaselineDistance(right, left, False, dai.LengthUnit.METER)))
        focal = float(calibration.getCameraIntrinsics(right, *_STEREO_SIZE)[0][0])
        Baseline(metres)  # raises ValueError
        if not focal >= _MIN_FOCAL * max(_STEREO_SIZE):
            raise ValueError(f"its focal length is {focal:g} pixels")
        return DepthNoise(NOISES["stereo"].a_m, _MATCH_PX / (focal * metres))
    except (RuntimeError, ValueError, LookupError, TypeError) as error:
        raise CameraUnavailable(f"the camera's stereo cameras are not calibrated ({sanitize_text(error)})") from error


def _pairs(dai: ModuleType, device: Any, pipeline: Any, config: Config) -> Source:
    """The left and right pictures of one moment, which the camera rectifies. Raises CameraUnavailable."""
    left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    baseline = _baseline(dai, device, left, right)
    cameras = tuple(pipeline.create(dai.node.Camera).build(socket) for socket in (left, right))
    stereo, sync = pipeline.create(dai.node.StereoDepth), pipeline.create(dai.node.Sync)
    stereo.setRectification(True)
    size = (config.width, config.height)
    for camera, side in zip(cameras, (stereo.left, stereo.right), strict=True):
        camera.requestOutput(size, resizeMode=dai.ImgResizeMode.CROP, fps=config.fps).link(side)
    stereo.rectifiedLeft.link(sync.inputs["left"])
    stereo.rectifiedRight.link(sync.inputs["right"])
    sync.setSyncThreshold(timedelta(seconds=config.sync_s))
    queue = sync.out.createOutputQueue(maxSize=2, blocking=False)
    return Source(queue, cameras, partial(convert_stereo_pair, baseline), lambda group: group["left"])


def _baseline(dai: ModuleType, device: Any, left: Any, right: Any) -> Baseline:
    try:  # by the calibration of this very camera, not by the design of its board
        metres = device.readCalibration().getBaselineDistance(right, left, False, dai.LengthUnit.METER)
        return Baseline(abs(float(metres)))
    except (RuntimeError, ValueError) as error:
        raise CameraUnavailable(
            f"the camera's stereo baseline is not known ({error}). Calibrate it with Luxonis' tools, or set "
            "camera.stereo to false"
        ) from error


def find() -> list[dict[str, str]]:
    """The cameras that are connected; none where depthai is not installed."""
    if importlib.util.find_spec("depthai") is None:
        return []
    return [
        {"device": info.getDeviceId(), "description": f"{info.platform.name} at {info.name} ({info.state.name})"}
        for info in _depthai().Device.getAllAvailableDevices()
    ]


def read(dai: ModuleType, source: Source, config: Config, hold: Callable[[], None]) -> Iterator[Frame | DroppedFrame]:
    """The frames of a running pipeline's source; `hold` is called once the camera has settled."""
    settled, held, frame_id = time.monotonic() + config.warmup_s, not config.lock_exposure, 0
    while True:
        try:
            message = source.queue.get(timedelta(seconds=config.frame_timeout_s))
        except dai.MessageQueue.QueueException as error:
            raise CameraUnavailable(f"the camera ended its stream: {error}") from error
        if message is None:
            hint = "" if config.depth == "none" else " If it is, it may measure no depth: try camera.depth: none"
            raise CameraUnavailable(f"no frame for {config.frame_timeout_s:g} s; is the camera still plugged in?{hint}")
        if not held and time.monotonic() < settled:
            continue
        if not held:
            hold()
            held = True
            lead = source.lead(message)
            exposure_us = lead.getExposureTime() / timedelta(microseconds=1)
            event(log, logging.INFO, "locked", exposure_us=exposure_us, iso=lead.getSensitivity())
            continue  # it was exposed before
        item = source.to_frame(message, frame_id)
        frame_id += isinstance(item, Frame)
        yield item


def convert_frame(message: Any, frame_id: int) -> Frame | DroppedFrame:
    """An ImgFrame as a Frame: its stamp is of the host's monotonic clock, synchronised by DepthAI.

    It has the exposure that the camera says it was taken with.
    """
    stamp_ns = message.getTimestamp() // timedelta(microseconds=1) * 1000
    image = _rgb(message.getCvFrame())
    intrinsics = _intrinsics(message.getTransformation(), image.shape[1], image.shape[0])
    name = f"{stamp_ns / 1e9:.6f}"
    captured_at, exposure = wall_clock(stamp_ns), _exposure(message)
    return make_frame(frame_id, name, stamp_ns, image, intrinsics, captured_at=captured_at, exposure=exposure)


def _exposure(message: Any) -> ExposureSettings | None:
    """None where the camera does not tell it, as DepthAI's own replay does not: its messages say 0."""
    shutter, iso = message.getExposureTime(), message.getSensitivity()
    if not isinstance(shutter, timedelta) or not isinstance(iso, int):
        return None
    return parse_exposure(shutter.total_seconds(), iso)


def convert_stereo_pair(baseline: Baseline, group: Any, frame_id: int) -> Frame | DroppedFrame:
    """A group of a left and a right ImgFrame as the left one's Frame, with the right image."""
    left, seen = convert_frame(group["left"], frame_id), _rgb(group["right"].getCvFrame())
    if isinstance(left, DroppedFrame):
        return left
    try:
        return replace(left, right=RightImage(grey(seen), baseline))
    except ValueError as error:
        return DroppedFrame(left.name, f"its right image cannot be used: {error}")


class DepthConverter:
    """Makes a group of a colour and a depth ImgFrame the colour one's Frame, with its depth image.

    A depth image that cannot be used is left out; the log tells the first of them, and why.
    """

    def __init__(self, noise: DepthNoise, within_s: float) -> None:
        self._noise, self._within_s, self._has_warned = noise, within_s, False

    def __call__(self, group: Any, frame_id: int) -> Frame | DroppedFrame:
        frame = convert_frame(group["colour"], frame_id)
        if isinstance(frame, DroppedFrame):
            return frame
        try:
            return self._attach_depth(frame, group)
        except ValueError as error:
            if not self._has_warned:
                event(log, logging.WARNING, "depth_left_out", name=frame.name, reason=sanitize_text(error))
                self._has_warned = True
            return frame

    def _attach_depth(self, frame: Frame, group: Any) -> Frame:
        """Raises ValueError."""
        apart_s = (group["depth"].getTimestamp() - group["colour"].getTimestamp()).total_seconds()
        if abs(apart_s) > self._within_s:
            raise ValueError(
                f"it was taken {1000 * apart_s:.1f} ms from its image, at most {1000 * self._within_s:.1f} ms count"
            )
        values = np.asarray(group["depth"].getCvFrame())
        if values.dtype != np.uint16:
            raise ValueError(f"it must be of 16 bits, millimetres, got {values.dtype}")
        return replace(
            frame, depth=make_depth_image(np.where(values == _SATURATED, np.uint16(0), values), noise=self._noise)
        )


def _rgb(image: Any) -> npt.NDArray[np.uint8]:
    """(H, W, 3) of what DepthAI gives, BGR or grey."""
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(image, code).astype(np.uint8, copy=False)


def make_exposure_lock(dai: ModuleType, config: Config) -> Any:
    """The command that holds exposure and white balance where they are, or where the configuration says."""
    control = dai.CameraControl()
    if config.exposure_us is None:
        control.setAutoExposureLock(True)
    else:
        control.setManualExposure(config.exposure_us, config.iso)
    control.setAutoWhiteBalanceLock(True)
    return control


def _control(dai: ModuleType, focus: int) -> Any:
    control = dai.CameraControl()
    control.setManualFocus(focus)
    return control


def _intrinsics(transformation: Any, width: int, height: int) -> Intrinsics | None:
    """For the very pixels that were delivered, cropped and scaled; None where the camera carries no calibration."""
    K = np.array(transformation.getIntrinsicMatrix(), float)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] < _MIN_FOCAL * max(width, height):
        return None
    distortion = tuple(float(value) for value in transformation.getDistortionCoefficients())
    model = str(transformation.getDistortionModel())
    fisheye = "Fisheye" in model and any(distortion)
    if any(distortion[4:] if fisheye else distortion) and "Perspective" not in model:
        return None  # coefficients that mean something else; `undistort` has the camera take them out
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5  # OpenCV's origin is a pixel's centre
    pinhole = Intrinsics(width, height, fx, fy, cx, cy, "calibration")
    if fisheye:
        return replace(pinhole, distortion=distortion[:4], model="fisheye")
    return replace(pinhole, distortion=distortion if any(distortion) else ())


def _select_device(dai: ModuleType, device: str) -> Any:
    found = dai.Device.getAllAvailableDevices()
    if device and found:
        for info in found:
            if device in (info.getDeviceId(), info.name):
                return info
    elif len(found) == 1:
        return found[0]
    listed = ", ".join(f"{info.getDeviceId()} at {info.name}" for info in found)
    if not found:
        raise CameraUnavailable(
            "no OAK camera is connected. Plug one in; if it is, run splatnode config --write configs "
            "and install configs/udev/80-splatnode-oak.rules"
        )
    raise CameraUnavailable(f"camera.device must name one of: {listed}; got {device!r}")


def _depthai() -> ModuleType:
    os.environ.setdefault("DEPTHAI_LEVEL", "error")  # its warnings go to stdout
    try:
        return importlib.import_module("depthai")
    except ImportError as error:
        raise CameraUnavailable("OAK cameras need the package depthai. Run: pip install 'splatnode[oak]'") from error
