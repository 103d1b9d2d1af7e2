"""The thread that tracks the live camera: where it is in the finished scene, and whether it has moved."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.lenses.undistort import undistort_image
from splatnode.capture.messaging.network import Network
from splatnode.capture.preview import decode_preview
from splatnode.capture.process.logs import event
from splatnode.capture.process.problems import Problems, is_logged
from splatnode.capture.stamp import Stamp
from splatnode.recon.daemon.previews import PreviewReceiver
from splatnode.recon.daemon.tracking import CameraMotion, Tracker, TrackingConfig, compute_landmarks
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FinalScene:
    """A finished scene and the keyframes that it was made of."""

    snapshot: Snapshot
    keyframes: Sequence[Keyframe]


class Watcher:
    def __init__(
        self,
        network: Network,
        config: TrackingConfig,
        finished: Callable[[], FinalScene | None],
        problems: Problems,
        stopping: threading.Event,
    ) -> None:
        """`finished` returns the finished scene, the same object until it changes; None while it is being changed."""
        self._config, self._finished = config, finished
        self._problems, self._stopping = problems, stopping
        self._previews = PreviewReceiver(network, problems, stopping)
        self.tracked: CameraEstimate | None = None  # the live camera in the finished scene, where it is known
        self.motion: CameraMotion | None = None  # since the scene was finished

    def run(self) -> None:
        """Until the daemon stops."""
        if self._config.every_s <= 0:
            return
        receiving = threading.Thread(target=self._previews.run, name="previews", daemon=True)
        receiving.start()
        self._watch()
        receiving.join()

    def _watch(self) -> None:
        watched: FinalScene | None = None
        tracker = None
        while not self._stopping.wait(self._config.every_s):
            finished = self._finished()
            if finished is not watched:
                watched, tracker, self.motion, self.tracked = finished, None, None, None
            message = self._previews.take()
            if watched is None or message is None:
                continue
            try:
                image = undistort_image(decode_preview(message), watched.snapshot.cameras[-1].lens)
                tracker = tracker or Tracker(
                    compute_landmarks(watched.snapshot, watched.keyframes, self._config), self._config
                )
                self._track(tracker, image, message.header.captured_at, watched.snapshot)
            except Exception as error:  # of one picture; the next one may do
                self.tracked = None
                if is_logged(self._problems.add("previews in which the camera could not be tracked", error)):
                    log.warning("the camera could not be tracked: %s: %s", type(error).__name__, error)

    def _track(
        self, tracker: Tracker, image: npt.NDArray[np.uint8], captured_at: Stamp | None, snapshot: Snapshot
    ) -> None:
        height, width = image.shape[:2]
        position, motion = tracker.track(image, scale_intrinsics(snapshot.cameras[-1], width, height))
        self.tracked = position and CameraEstimate(
            "live", -1, position.T_world_camera, position.K, width, height, captured_at=captured_at
        )
        if motion is not None and motion.moved and not (self.motion and self.motion.moved):
            event(log, logging.WARNING, "camera_moved", how=motion)
        self.motion = motion


def scale_intrinsics(camera: CameraEstimate, width: int, height: int) -> npt.NDArray[np.float64]:
    """(3, 3) intrinsic matrix of the same camera's image resized to `width` x `height`."""
    return np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
