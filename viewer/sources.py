"""Where moments come from: a result on disk, or a running node."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Protocol, runtime_checkable

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.image_file import UnusableImage, decode_photograph, read_image_file
from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.services import RECON_SCENE, RECON_STATUS
from splatnode.capture.messaging.state import StateClient
from splatnode.capture.process.foreign import foreign
from splatnode.capture.process.printable import is_printable
from splatnode.capture.process.problems import Problems, is_said
from splatnode.recon.daemon.status import ReconStatus
from splatnode.recon.result.export import SceneFileError, read_cameras, read_gaussians, viewer_safe
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.sources import SOURCES
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.message import CameraRecord, SceneHeader, camera_from, from_message
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer.moment import Moment

log = logging.getLogger(__name__)

_POLL_S = 0.25
_LONGEST_SENTENCE = 10_000  # characters, of a report
_PHOTOGRAPH_SIDE = 640  # pixels: a blend with the render in a window needs no more


class Source(Protocol):
    def take(self) -> Moment | None:
        """The newest moment, once; None where nothing has come since. Never waits."""

    @property
    def age_s(self) -> float | None:
        """Seconds since something came; None where nothing more will."""

    @property
    def tracked(self) -> CameraEstimate | None:
        """Where the live camera is just now in the newest scene; None: not known."""

    def close(self) -> None: ...


@runtime_checkable
class Roaming(Protocol):
    """A source that has more than fits into memory, and gives what is near."""

    def look_from(self, eye: npt.NDArray[np.float64], which: int) -> None:
        """Where the person looks from now (3,), and at which of its maps. Never waits."""


class Finished:
    """One moment that is there from the start."""

    age_s = None
    tracked = None

    def __init__(self, moment: Moment) -> None:
        self._moment: Moment | None = moment

    def take(self) -> Moment | None:
        moment, self._moment = self._moment, None
        return moment

    def close(self) -> None:
        self._moment = None


class Live:
    """The scene of a running node. A thread listens; it keeps one moment, the newest."""

    def __init__(self, network: Network) -> None:
        """Raises what opening the network raises: NetworkError, KeyFileError."""
        self._client = StateClient(RECON_SCENE, network, SceneHeader)
        self._heartbeats = Subscriber(RECON_STATUS, network, ReconStatus)
        self._refusals = Problems()
        self._newest: Moment | None = None
        self._tracked: CameraEstimate | None = None
        self._lock = threading.Condition()
        self._error: BaseException | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="live scene", daemon=True)
        self._thread.start()

    @property
    def age_s(self) -> float:
        """A scene that is being refined is silent for long: the node's heartbeats tell that it lives."""
        return min(self._client.age_s, self._heartbeats.age_s)

    @property
    def tracked(self) -> CameraEstimate | None:
        return self._tracked

    def take(self) -> Moment | None:
        """Raises what the connection failed with, for example NotAllowed."""
        if self._error is not None:
            raise self._error
        with self._lock:
            moment, self._newest = self._newest, None
        return moment

    def wait(self, timeout_s: float | None = None) -> Moment | None:
        """As `take`, but waits until one comes; None where none comes in time, or when it is closed."""
        with self._lock:
            self._lock.wait_for(lambda: self._newest or self._error or self._closing.is_set(), timeout_s)
        return self.take()

    def close(self) -> None:
        self._closing.set()
        with self._lock:
            self._lock.notify_all()
        self._thread.join()
        self._client.close()
        self._heartbeats.close()

    def _listen(self) -> None:
        last: CameraRecord | None = None  # of the last heartbeat: what has not changed is not drawn again
        try:
            while not self._closing.is_set():
                message = self._client.poll(_POLL_S)
                heartbeat = self._heartbeats.latest(0)
                if heartbeat is not None and heartbeat.header.tracked != last:
                    last = heartbeat.header.tracked
                    self._tracked = last and camera_from(last)
                if message is None:
                    continue
                try:
                    live = from_message(message)
                    moment = Moment(_safe(live.snapshot), time.monotonic(), live.scene_id)
                except Exception as error:  # of one scene; the next one may do
                    if is_said(self._refusals.add("scenes that were refused", error)):
                        log.warning("a scene of the node was refused: %s", error)
                    continue
                with self._lock:
                    self._newest = moment
                    self._lock.notify_all()
        except Exception as error:
            with self._lock:
                self._error = error
                self._lock.notify_all()


def load_result(place: Path, photographs: Path | None = None) -> Moment:
    """The moment in a result's folder or a scene file, with the photographs that are found.

    They are looked for in `photographs`, or else where `read_result` tells. Raises what that raises.
    """
    snapshot, folders = read_result(place)
    images = found_photographs(snapshot.cameras, [photographs] if photographs else folders)
    return Moment(replace(snapshot, images=images), time.monotonic())


def read_result(place: Path) -> tuple[Snapshot, list[Path]]:
    """The snapshot in a result's folder or a scene file, and the folders in which its photographs may be.

    These are where the report says that they were, where a result of `splatnode demo` has them, and beside the scene.
    A folder without a scene must have a report that says why. Raises SceneFileError, FileNotFoundError, ValueError.
    """
    folder = place if place.is_dir() else place.parent
    scene = place / "scene.ply" if place.is_dir() else place
    report = _report(folder / "report.json") if place.is_dir() else None
    if not scene.is_file() and report is None:
        raise FileNotFoundError(
            f"{scene} is not there. Give a result's folder (splatnode replay FOLDER --out DIR), a .ply, .spz or .splat "
            "file, or the node's configuration (.yaml)"
        )
    report = report or _Report(Verdict(Code.OK, "A scene from a file, without a report.", "", publishable=True))
    gaussians = _gaussians(scene) if scene.is_file() else GaussianArrays.empty()
    cameras = read_cameras(folder / "cameras.json") if (folder / "cameras.json").is_file() else ()
    beside = [folder / "images", folder / "capture" / "images"]
    reported = [] if report.photographs is None else [Path(report.photographs)]
    snapshot = Snapshot(
        sequence=0,
        verdict=report.verdict,
        cameras=cameras,
        gaussians=gaussians,
        images={},
        dropped=report.frames_dropped,
        iterations=report.iterations,
        seconds=report.seconds,
        final=True,
        scale=StoredResult(scene).scale(),
    )
    return snapshot, reported + beside


def _gaussians(scene: Path) -> GaussianArrays:
    """With their source frames where the file beside the scene has them. Raises SceneFileError, OSError."""
    sources = scene.with_name(SOURCES)
    if scene.suffix.lower() == ".ply" and sources.is_file():
        try:
            return read_gaussians(scene, sources)
        except SceneFileError as error:
            log.warning("it is not known which photographs the Gaussians come from: %s", error)
    return read_gaussians(scene)


def _safe(snapshot: Snapshot) -> Snapshot:
    """What comes over the network is input: Gaussians that cannot be drawn are left out."""
    return replace(snapshot, gaussians=viewer_safe(snapshot.gaussians))


class _Report(msgspec.Struct, frozen=True):
    """What is shown of report.json."""

    verdict: Verdict
    frames_dropped: tuple[DroppedFrame, ...] = ()
    iterations: Annotated[int, msgspec.Meta(ge=0, lt=1 << 31)] = 0
    seconds: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1e9)]] = {}
    photographs: str | None = None

    def texts(self) -> list[str]:
        """All that it says, which is shown."""
        verdict = self.verdict
        dropped = [text for frame in self.frames_dropped for text in (frame.name, frame.reason)]
        return [verdict.message, verdict.advice, *verdict.frames, *dropped, *self.seconds, self.photographs or ""]


def _report(path: Path) -> _Report | None:
    """None where there is none. Raises SceneFileError where it is something else, OSError."""
    if not path.is_file():
        return None
    with foreign(SceneFileError, str(path)):
        try:
            report = msgspec.json.decode(read_json_file(path), type=_Report)
        except msgspec.MsgspecError as error:
            raise SceneFileError(f"{path} is not a report of splatnode, or is damaged: {error}") from error
        if not all(is_printable(text, _LONGEST_SENTENCE) for text in report.texts()):
            longest = f"at most {_LONGEST_SENTENCE} characters"
            raise SceneFileError(f"{path} is not a report of splatnode: its texts must be printable, of {longest}")
        return report


def found_photographs(cameras: tuple[CameraEstimate, ...], folders: Sequence[Path]) -> dict[str, npt.NDArray[np.uint8]]:
    """By camera, its photograph in the first of the `folders` that has one, as large as a window needs it."""
    found = {}
    for camera in cameras:
        for folder in folders:
            path = folder / camera.name
            try:
                if not path.is_file():
                    continue
                found[camera.name] = _small(decode_photograph(read_image_file(path))[0])
            except (UnusableImage, OSError) as error:
                log.warning("%s is shown without its photograph: %s", camera.name, error)
            break
    return found


def _small(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    scale = min(1.0, _PHOTOGRAPH_SIDE / max(image.shape[:2]))
    size = math.ceil(image.shape[1] * scale), math.ceil(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
