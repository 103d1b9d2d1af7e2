"""Where moments come from: a result on disk, or a running node."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from capture.frame import DroppedFrame
from capture.image_file import UnusableImage, decode_image
from capture.messaging.broadcast import Subscriber
from capture.messaging.network import Network
from capture.messaging.services import RECON_SCENE, RECON_STATUS
from capture.messaging.state import StateClient
from capture.messaging.wire import WireError
from recon.daemon.scene_message import CameraRecord, SceneHeader, camera_from, from_message
from recon.daemon.status import ReconStatus
from recon.export import read_cameras, read_gaussians, viewer_safe
from recon.snapshot import CameraEstimate, GaussianArrays, Snapshot
from recon.verdict import Code, Verdict
from viewer.moment import Moment

log = logging.getLogger(__name__)

_POLL_S = 0.25
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
        self._newest: Moment | None = None
        self._tracked: CameraEstimate | None = None
        self._lock = threading.Lock()
        self._error: BaseException | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="live scene", daemon=True)
        self._thread.start()

    @property
    def age_s(self) -> float | None:
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

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._client.close()
        self._heartbeats.close()

    def _listen(self) -> None:
        told: CameraRecord | None = None  # by the last heartbeat: what has not changed is not drawn again
        try:
            while not self._closing.is_set():
                message = self._client.poll(_POLL_S)
                heartbeat = self._heartbeats.latest(0)
                if heartbeat is not None and heartbeat.header.tracked != told:
                    told = heartbeat.header.tracked
                    tracked = told and camera_from(told)
                    self._tracked = tracked if tracked and is_camera(tracked) else None
                if message is None:
                    continue
                try:
                    live = from_message(message)
                except WireError as error:
                    log.warning("a scene of the node was refused: %s", error)
                    continue
                moment = Moment(_safe(live.snapshot), time.monotonic(), live.scene_id)
                with self._lock:
                    self._newest = moment
        except Exception as error:
            self._error = error


def load_result(place: Path, photographs: Path | None = None) -> Moment:
    """The moment in a result's folder or a scene file, with the photographs that are found.

    They are looked for in `photographs`, or else where the report says that they were, where a result of
    `splatnode demo` has them, and beside the scene.
    A folder without a scene must have a report that says why. Raises SceneFileError, FileNotFoundError, ValueError.
    """
    folder = place if place.is_dir() else place.parent
    scene = place / "scene.ply" if place.is_dir() else place
    report = _report(folder / "report.json") if place.is_dir() else {}
    if not scene.is_file() and not report:
        raise FileNotFoundError(
            f"{scene} is not there. Give a result's folder (splatnode replay FOLDER --out DIR), a .ply, .spz or .splat "
            "file, or the node's configuration (.yaml)"
        )
    gaussians = read_gaussians(scene) if scene.is_file() else GaussianArrays.empty()
    cameras = read_cameras(folder / "cameras.json") if (folder / "cameras.json").is_file() else ()
    beside = [folder / "images", folder / "capture" / "images"]
    reported = [Path(there)] if isinstance(there := report.get("photographs"), str) else []
    snapshot = Snapshot(
        sequence=0,
        verdict=_verdict(report),
        cameras=cameras,
        gaussians=gaussians,
        images=_photographs(cameras, [photographs] if photographs else reported + beside),
        dropped=tuple(DroppedFrame(str(one["name"]), str(one["reason"])) for one in report.get("frames_dropped", ())),
        iterations=int(report.get("iterations", 0)),
        seconds={str(stage): float(seconds) for stage, seconds in report.get("seconds", {}).items()},
        final=True,
    )
    return Moment(snapshot, time.monotonic())


def _safe(snapshot: Snapshot) -> Snapshot:
    """What comes over the network is input: Gaussians that cannot be drawn are left out."""
    cameras = tuple(camera for camera in snapshot.cameras if is_camera(camera))
    return replace(snapshot, gaussians=viewer_safe(snapshot.gaussians), cameras=cameras)


def is_camera(camera: CameraEstimate) -> bool:
    """Whether it can be looked through: a rigid motion and positive focal lengths."""
    rotation = camera.T_world_camera[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-2 and np.linalg.det(rotation) > 0
    return bool(rigid and camera.K[0, 0] > 0 and camera.K[1, 1] > 0)


def _report(path: Path) -> dict:
    """report.json, empty where there is none. Raises ValueError where it is something else."""
    if not path.is_file():
        return {}
    try:
        report = json.loads(path.read_bytes())
        _verdict(report)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a report of splatnode, or is damaged: {error!r}") from error
    return report


def _verdict(report: dict) -> Verdict:
    if not report:
        return Verdict(Code.OK, "A scene from a file, without a report.", "", publishable=True)
    verdict = report["verdict"]
    return Verdict(
        Code(verdict["code"]),
        str(verdict["message"]),
        str(verdict["advice"]),
        tuple(str(name) for name in verdict["frames"]),
        bool(verdict["publishable"]),
    )


def _photographs(cameras: tuple[CameraEstimate, ...], folders: list[Path]) -> dict[str, npt.NDArray[np.uint8]]:
    found = {}
    for camera in cameras:
        for folder in folders:
            path = folder / camera.name
            if not path.is_file():
                continue
            try:
                found[camera.name] = _small(decode_image(path.read_bytes())[0])
            except UnusableImage as error:
                log.warning("%s is shown without its photograph: %s", camera.name, error)
            break
    return found


def _small(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    scale = min(1.0, _PHOTOGRAPH_SIDE / max(image.shape[:2]))
    size = math.ceil(image.shape[1] * scale), math.ceil(image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
