"""Images of a program of one's own, pushed into the running node as a camera's are."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from splatnode.api.arguments import (
    DepthOf,
    Lens,
    Mounts,
    Sigmas,
    append_motion,
    check_capture_id,
    enter_api,
    find_mount,
    make_gravity,
    make_intrinsics,
    make_pose,
    parse_mounts,
    parse_single_depth,
)
from splatnode.capture.config import Camera, CaptureConfig, ProgramConfig
from splatnode.capture.daemon import CaptureSession
from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import (
    Clock,
    DroppedFrame,
    Frame,
    GivenPose,
    Gravity,
    Motion,
    Stamp,
    nearest_stamp,
    wall_clock,
)
from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.lenses import assign_lens, check_fits
from splatnode.capture.masks import apply_mask, parse_mask
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolFull
from splatnode.capture.process.config import merge_config, parse_config, read_yaml
from splatnode.capture.process.files import LockHeld
from splatnode.capture.process.terminal import Unfailing
from splatnode.capture.process.text import LONGEST_NAME, sanitize_text
from splatnode.capture.reader import ReaderState

SERVE_S = 0.05  # between looks at what recon asks for
SILENT_S = 5.0  # after which status says that the program gives no image
_LOOK_S = 0.01  # between looks at whether there is room, or all is answered

Picture: TypeAlias = Any  # an array, a PIL image, or the bytes of a JPEG or PNG file


@dataclass(frozen=True)
class Published:
    """The outcome for one image that was published."""

    name: str  # of the image in the node
    taken: bool  # whether it is a keyframe, which lies on this disk until recon has it on its own
    reason: str  # why it was taken, or not: what it adds, or that it is blurred, a copy, ...


@dataclass(frozen=True)
class RefusedImage:
    """An image that recon could not take. It is kept in the quarantine beside the spool."""

    name: str  # of the image
    reason: str  # as recon, or the disk, says


@dataclass
class _Program:
    """The program as a source of frames, for the heartbeat."""

    pushed_s: float  # monotonic, of the last image
    is_used: bool = False
    skipped: int = 0

    @property
    def state(self) -> ReaderState:
        if not self.is_used:
            return ReaderState.STARTING
        return ReaderState.STREAMING if self._silent_s <= SILENT_S else ReaderState.DEGRADED

    @property
    def why(self) -> str:
        silent = self.is_used and self._silent_s > SILENT_S
        return f"the program has given no image for {self._silent_s:.0f} s" if silent else ""

    @property
    def _silent_s(self) -> float:
        return time.monotonic() - self.pushed_s


class Publisher:
    """Replaces `splatnode capture` for a program that has the images.

    Keyframes stay in the spool on this disk until recon has stored them; a thread serves recon. Previews and
    `splatnode status` show them as a camera's. Thread-safe. As a context manager it closes itself; the next publisher,
    or `splatnode capture`, sends what still waits.
    """

    @enter_api()
    def __init__(
        self,
        config: str | PathLike[str] | None = None,
        *,
        every_frame: bool = False,
        camera_id: str = "",
        T_base_camera: Mounts | None = None,
        changes: Mapping[str, Any] | None = None,
    ) -> None:
        """`config`: None, or a YAML file as `splatnode capture` takes it, without `camera`. `changes` are laid over it.

        - `every_frame`: take every image that is sharp, well exposed and no copy, not only those that add parallax or
          coverage.
        - `camera_id`: of this publisher, and of images without their own: programs with different ids may send to one
          node. Up to 32 letters, digits, - and _.
        - `T_base_camera`: (4, 4) in metres, the camera on the robot's base (x forward, y left, z up), or by camera id.
        - `changes`: such as `{"network": {"directory": "run"}, "spool": {"max_frames": 50}}`.

        Raises ValueError where the configuration or the id cannot be used, and OSError where another process publishes
        already (BlockingIOError) or a folder cannot be used.
        """
        check_capture_id(camera_id)
        settings = read_yaml(Path(config)) if config is not None else {}
        settings = merge_config(settings, _plain(changes or {}))
        if every_frame:
            settings = merge_config(settings, {"selection": {"every_frame": True}})
        own = parse_config(merge_config(settings, {"camera_id": camera_id} if camera_id else {}), ProgramConfig)
        known = {name: getattr(own, name) for name in own.__struct_fields__}
        self._mounts = parse_mounts(own.T_base_camera if T_base_camera is None else T_base_camera)
        self._config = CaptureConfig(Camera("program", None), **known)
        self._lock = threading.RLock()
        self._closed = threading.Event()
        self._program = _Program(time.monotonic())
        self._number = 0
        self._stamp_ns = -1
        self._motions: dict[str, Motion] = {}  # by camera id, up to the image that was published last
        try:
            self._open()
        except LockHeld as error:
            raise BlockingIOError(
                f"another process gives this node images already: {error}. Stop it, or give this one a camera_id"
            ) from error
        self._serving = Unfailing("the answer to recon")
        self._thread = threading.Thread(target=self._serve, name="splatnode.Publisher", daemon=True)
        self._thread.start()

    def _open(self) -> None:
        with ExitStack() as resources:
            own = self._config
            spool = Spool(own.spool, own.camera_id)
            self._server = resources.enter_context(KeyframeServer(own.network, spool, own.camera_id))
            self._session = CaptureSession(self._config, self._server, resources)
            self._resources = resources.pop_all()

    @enter_api()
    def publish(
        self,
        image: Picture,
        *,
        name: str | None = None,
        captured_at: Stamp | float | None = None,
        camera_id: str | None = None,
        intrinsics: Lens | None = None,
        mask: npt.ArrayLike | None = None,
        pose: npt.ArrayLike | None = None,
        pose_sigma: tuple[float, float] | None = None,
        motion: npt.ArrayLike | None = None,
        motion_sigma: tuple[float, float] | None = None,
        gravity: npt.ArrayLike | None = None,
        gravity_sigma: float | None = None,
        depth: DepthOf = None,
        wait_s: float = 0.0,
    ) -> Published:
        """Gives the node an image: an array (H, W, 3) uint8 RGB or (H, W) grey, a PIL image, or bytes of a JPEG or PNG.

        - `captured_at`: when it was taken: seconds since 1970, UTC, or a Stamp. None: now, or as its EXIF tells.
        - `camera_id`: which of several cameras took it, as for `Publisher`. Each camera's keyframes are selected on
          their own.
        - `intrinsics`: its lens, or a matrix K (3, 3) of a pinhole, in pixels.
        - `mask`: (H, W), what is 0 or False is not used.
        - `pose`, `pose_sigma`: T_world_camera (4, 4) in metres, all in one world; metres and degrees (0.01, 2).
        - `motion`, `motion_sigma`: T_previous_current (4, 4) in metres since the image of this camera that was
          published before, taken or not; metres and degrees of this motion alone (2 % of its length, 2).
        - `gravity`, `gravity_sigma`: the direction of down (3,) in the camera's frame; degrees (2).
        - `depth`: what a depth camera measured with it, aligned (H, W), uint16 of millimetres or float of metres, or a
          `DepthImage`, which has its lens, place and noise.
        - `wait_s`: how long to wait for room where recon is behind and the spool is full.

        Returns once a keyframe is on the disk; the arrays may be written to again. Raises TypeError and ValueError for
        arguments that cannot be used, BufferError where the spool has no room (nothing was taken: publish the image
        again, or drop it), OSError where the disk fails, and RuntimeError after `close`.
        """
        made, moved = self._make_frame(
            image,
            name,
            captured_at,
            camera_id,
            intrinsics,
            mask,
            (make_pose(pose, _pair(pose_sigma)), make_gravity(gravity, gravity_sigma)),
            (motion, _pair(motion_sigma)),
            parse_single_depth(depth),
        )
        deadline = time.monotonic() + wait_s
        while True:
            with self._lock:
                if (outcome := self._try_push(made, moved, time.monotonic() >= deadline)) is not None:
                    return outcome
            self._closed.wait(_LOOK_S)

    def _try_push(self, made: Frame, moved: Motion | None, is_last: bool) -> Published | None:
        """None where there is no room yet."""
        if self._closed.is_set():
            raise RuntimeError("the publisher is closed: begin another one")
        self._program.pushed_s, self._program.is_used = time.monotonic(), True
        try:
            self._server.spool.check_room(made.image.nbytes)
        except SpoolFull as error:
            if not is_last:
                return None
            raise BufferError(
                f"{made.name} was not taken: {error} (spool.max_frames, spool.max_mb, wait_s=)"
            ) from error
        self._stamp_ns = max(self._stamp_ns + 1, time.monotonic_ns())
        frame = replace(made, frame_id=self._number, stamp_ns=self._stamp_ns)
        try:
            decision = self._session.push(frame)
        except SpoolFull as error:  # the disk does not take it
            raise BufferError(f"{made.name} was not taken: {error}") from error
        self._number += 1
        if moved is not None:
            self._motions[made.camera_id] = moved
        return Published(frame.name, decision.take, decision.reason)

    def flush(self, timeout_s: float | None = None) -> bool:
        """Waits until recon has answered all keyframes; False where some still wait after so many seconds."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while self.num_waiting and not self._closed.is_set():
            if deadline is not None and time.monotonic() >= deadline:
                return False
            self._closed.wait(_LOOK_S)
        return not self.num_waiting

    @property
    def num_waiting(self) -> int:
        """Returns how many keyframes recon has not answered; they lie on this disk."""
        with self._lock:
            return self._server.num_queued

    @property
    def num_acknowledged(self) -> int:
        """Returns how many keyframes recon has on its disk, of those that it answered since this object was made."""
        return self._server.acknowledged

    @property
    def is_connected(self) -> bool:
        """Returns whether a recon is there and gets the keyframes."""
        return self._server.is_connected

    @property
    def refusals(self) -> tuple[RefusedImage, ...]:
        """Returns the images in the quarantine, the newest first: recon refused them, or the disk damaged them."""
        with self._lock:
            quarantine = self._server.spool.quarantine
            return tuple(RefusedImage(each.name, each.reason) for each in quarantine.newest(len(quarantine)))

    def close(self) -> None:
        """Ends the connection. Keyframes that wait stay on the disk; `flush` before it waits for recon to take them."""
        self._closed.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        with self._lock:
            self._resources.close()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._closed.wait(SERVE_S):
            with self._lock:
                self._serving.do(self._session.serve)
                self._session.send_heartbeat(self._program)

    def _make_frame(
        self,
        image: Picture,
        name: str | None,
        captured_at: Stamp | float | None,
        camera_id: str | None,
        lens: Lens | None,
        mask: npt.ArrayLike | None,
        pose_and_gravity: tuple[GivenPose | None, Gravity | None],
        motion: tuple[npt.ArrayLike | None, tuple[float, float] | None],
        depth: DepthImage | None,
    ) -> tuple[Frame, Motion | None]:
        """The frame, and the motions up to it. Raises TypeError, ValueError."""
        by = self._config.camera_id if camera_id is None else check_capture_id(camera_id)
        taken_at = _make_stamp(captured_at)
        made = _read_picture(image)
        taken_at = taken_at or made.captured_at or wall_clock(time.monotonic_ns())
        title = sanitize_text(name or "_".join(filter(None, (by, taken_at.seconds))), LONGEST_NAME)
        before = self._motions.get(by)
        if motion[0] is not None and before is None:
            raise ValueError("motion is that since the image before: the first one of a camera has none")
        moved = append_motion(before, title, *motion)
        made = replace(
            made,
            name=title,
            captured_at=taken_at,
            camera_id=by,
            given_pose=pose_and_gravity[0],
            gravity=pose_and_gravity[1],
            motion=moved,
            depth=depth,
            T_base_camera=find_mount(self._mounts, by),
        )
        if lens is not None:
            known = make_intrinsics(lens, made.width, made.height)
            check_fits(known, [(made.width, made.height)])
            made = assign_lens(made, known)
        return (made if mask is None else _apply_mask(made, mask)), moved


def _plain(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Changes with paths as text, as YAML has them."""
    return {
        key: _plain(value) if isinstance(value, Mapping) else str(value) if isinstance(value, PathLike) else value
        for key, value in changes.items()
    }


def _pair(sigmas: Sequence[float] | None) -> Sigmas | None:
    """Two numbers in any sequence, as a tuple."""
    return None if sigmas is None else tuple(sigmas)  # pyright: ignore[reportReturnType]  # checked where it is used


def _make_stamp(captured_at: Stamp | float | None) -> Stamp | None:
    if captured_at is None or isinstance(captured_at, Stamp):
        return captured_at
    seconds = float(captured_at)
    if not 0 <= seconds < 1e11:
        raise ValueError(f"captured_at must be seconds since 1970, UTC, or a Stamp; got {captured_at}")
    return nearest_stamp(round(seconds * 1e9), Clock.UTC)


def _read_picture(picture: Picture) -> Frame:
    """A frame without a name of its own. Raises TypeError, ValueError."""
    if isinstance(picture, (bytes, bytearray, memoryview)):
        data = bytes(picture)
        try:
            found = decode_image(data)
        except UnusableImage as error:
            raise ValueError(f"an image must be the bytes of a JPEG or PNG file that can be read: {error}") from error
        known = {"captured_at": found.captured_at, "exposure": found.exposure, "camera": found.camera}
        made = Frame(0, "image", 0, found.image, found.intrinsics, encoded=data, **known)
        return made if found.mask is None else _apply_mask(made, found.mask)
    array = np.asarray(picture.convert("RGB")) if hasattr(picture, "convert") else picture
    if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
        got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise TypeError(
            f"an image must be an array (H, W, 3) uint8 RGB, a PIL image, or the bytes of a JPEG or PNG file; got {got}"
        )
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim == 2:
        array = np.repeat(array[..., None], 3, 2)
    if array.ndim != 3 or array.shape[2] != 3:
        raise ValueError(f"an image must be (H, W, 3) RGB or (H, W) grey, got {array.shape}; leave alpha out")
    return Frame(0, "image", 0, np.ascontiguousarray(array), None)


def _apply_mask(made: Frame, mask: npt.ArrayLike) -> Frame:
    used = apply_mask(made, parse_mask(mask))
    if isinstance(used, DroppedFrame):
        raise ValueError(f"mask: {used.reason}")
    return used
