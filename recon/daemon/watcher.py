"""The thread that watches the live camera: where it is in the finished scene, and whether it still stands there."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.broadcast import Subscriber
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.services import CAPTURE_PREVIEW
from splatnode.capture.messaging.wire import WireError
from splatnode.capture.preview import PreviewHeader, decode_preview
from splatnode.capture.process.logs import event
from splatnode.recon.daemon.tracking import Config, Motion, Watch, landmarks
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Finished:
    """A finished scene and the keyframes that it was made of."""

    snapshot: Snapshot
    keyframes: Sequence[Keyframe]


class Watcher:
    def __init__(
        self, network: Network, config: Config, finished: Callable[[], Finished | None], stopping: threading.Event
    ) -> None:
        """`finished` gives the finished scene, the same as long as it is; None while it changes."""
        self._network, self._config, self._finished, self._stopping = network, config, finished, stopping
        self.tracked: CameraEstimate | None = None  # the live camera in the finished scene, where it is known
        self.motion: Motion | None = None  # since the scene was finished

    def run(self) -> None:
        """Until the daemon stops. Raises NotAllowed."""
        if self._config.every_s <= 0:
            return
        watched: Finished | None = None
        watch = None
        with Subscriber(CAPTURE_PREVIEW, self._network, PreviewHeader, queue=4) as previews:
            while not self._stopping.wait(self._config.every_s):
                finished = self._finished()
                if finished is not watched:
                    watched, watch, self.motion, self.tracked = finished, None, None, None
                message = previews.latest(0)
                if watched is None or message is None:
                    continue
                if watch is None:
                    watch = Watch(landmarks(watched.snapshot, watched.keyframes, self._config), self._config)
                try:
                    self._look(watch, decode_preview(message), watched.snapshot)
                except WireError as error:
                    log.warning("a preview was refused: %s", error)

    def _look(self, watch: Watch, image: npt.NDArray[np.uint8], snapshot: Snapshot) -> None:
        height, width = image.shape[:2]
        position, motion = watch.look(image, preview_intrinsics(snapshot.cameras[-1], width, height))
        self.tracked = position and CameraEstimate(
            "live", -1, position.T_world_camera, position.K, width, height, None, None
        )
        if motion is not None and motion.moved and not (self.motion and self.motion.moved):
            event(log, logging.WARNING, "camera_moved", how=motion)
        self.motion = motion


def preview_intrinsics(camera: CameraEstimate, width: int, height: int) -> npt.NDArray[np.float64]:
    """(3, 3) of a picture `width` x `height` by the same camera."""
    return np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
