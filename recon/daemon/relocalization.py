"""Relocalisation: where in the finished scene a preview was taken, and whether the camera has moved since.

A preview's features are matched with those of the keyframes, whose points in the world the scene's depth gives. The
camera is resected from these points (P3P in RANSAC, then least squares). Features hardly depend on the light, and
both positions are resected from the same points, so that errors of the scene are the same in both and cancel.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import chdtr

from splatnode.capture.config import PreviewHeader, decode_preview
from splatnode.capture.frame import Intrinsics, Stamp
from splatnode.capture.lenses import undistort_image
from splatnode.capture.messaging.messages import Message, WireError
from splatnode.capture.messaging.network import CAPTURE_PREVIEW, RECON_LOCATE, Network, NotAllowed, find_captures
from splatnode.capture.messaging.pubsub import QueryServer, Subscriber
from splatnode.capture.process.config import Internal
from splatnode.capture.process.system import is_shortage
from splatnode.capture.process.terminal import Problems, event, is_logged
from splatnode.capture.process.text import sanitize_text
from splatnode.recon import poselib
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.geometry import MIN_DEPTH, project, transform_to_camera
from splatnode.recon.keyframes import PLAIN, Keyframe
from splatnode.recon.locating import (
    QUERY_LIMITS,
    LocateAnswer,
    Located,
    LocateRequest,
    NotLocated,
    decode_query_image,
    make_outcome_records,
)
from splatnode.recon.locating.localize import follow, localize_image
from splatnode.recon.matching import features
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.registration.registration import undistort_pixels
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, Landmarks, Snapshot
from splatnode.recon.threads import apply_thread_limit

Array = npt.NDArray[np.float64]

RAYLEIGH_MEDIAN = 1.1774  # median length of a 2D normal vector with sigma 1, the square root of 2 ln 2
MIN_VARIANCE_PX2 = 1e-4  # of a coordinate: a hundredth of a pixel is the best that a feature is located to
DAMPING = 1e-9  # added to the normal matrix, which points in one line leave singular


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relocalisation: where in the finished scene a preview was taken, and whether the camera has moved since."""

    interval_s: float = 1.0  # between previews that are examined; 0: the camera is not tracked
    num_features: Internal[int] = 2000  # of a preview, at most
    longer_side: Internal[int] = 800  # of the preview in which features are found, pixels
    keyframes: Internal[int] = 3  # with which a preview is compared: those with the most matches
    # Least rendered opacity at a keyframe's feature; below, its depth is not known well enough
    min_alpha: Internal[float] = 0.8
    min_inliers: Internal[int] = 20  # points from which a camera is resected
    min_share: Internal[float] = 0.3  # least inlier ratio; matches with another place reach 0.2
    max_error_px: Internal[float] = 3.0  # reprojection error of an inlier, at `longer_side`
    # Inliers share errors of the scene: more than so many make the position no more certain
    independent: Internal[int] = 50
    certainty: Internal[float] = 0.999  # least probability that the camera has moved, to say so
    # Median shift of the points in the image, at `longer_side`; a smaller one is no motion
    shift_px: Internal[float] = 3.0
    confirmations: Internal[int] = 2  # previews in a row that must show the motion


@dataclass(frozen=True, eq=False)
class KeyframeLandmarks:
    """The features of one keyframe, with their points in the world."""

    name: str
    points: Array  # (M, 3) world
    descriptors: npt.NDArray[np.uint8]  # (M, 128)


@dataclass(frozen=True, eq=False)
class LocalizedCamera:
    """The estimated camera of a preview, with its uncertainty."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of a small motion in the camera's frame: translation, then rotation vector
    K: Array  # (3, 3) of the preview
    points: Array  # (N, 3) world, from which it was resected
    keyframes: tuple[str, ...]  # with the most matches, the most first


@dataclass(frozen=True)
class CameraMotion:
    """Between two positions. Lengths are relative to the median depth of the points, as scenes have no scale."""

    moved: bool
    rotation_deg: float
    translation_rel: float
    shift_px: float  # median shift of the points in the image, at the configured size
    certainty: float  # that the camera is not where it was, in [0, 1]

    def __str__(self) -> str:
        return (
            f"turned by {self.rotation_deg:.1f}°, moved by {100 * self.translation_rel:.1f} % of the distance to the "
            f"scene, {self.shift_px:.0f} px in the image, certain to {100 * self.certainty:.1f} %"
        )


def compute_landmarks(
    snapshot: Snapshot, keyframes: Sequence[Keyframe], config: TrackingConfig
) -> list[KeyframeLandmarks]:
    """The features of the snapshot's keyframes, where the Gaussians are opaque enough for a depth."""
    cameras = {camera.name: camera for camera in snapshot.cameras}
    known = []
    for keyframe in (keyframe for keyframe in keyframes if keyframe.name in cameras):
        camera, found = cameras[keyframe.name], keyframe.features.select_tilt(PLAIN)
        render = render_arrays(
            snapshot.gaussians, camera.T_world_camera, camera.K, camera.width, camera.height, channels=("depth",)
        )
        pixels = _undistort_pixels(found.points[found.point_of], keyframe, camera)
        column, row = np.clip(pixels.astype(int), 0, [camera.width - 1, camera.height - 1]).T
        depth = render.depth[row, column].astype(np.float64)
        good = (depth > 0) & (render.alpha[row, column] >= config.min_alpha)
        rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(camera.K).T
        T_world_camera = camera.T_world_camera
        points = (rays * depth[:, None])[good] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        known.append(KeyframeLandmarks(keyframe.name, points, found.descriptors[good]))
    return known


def _undistort_pixels(points: Array, keyframe: Keyframe, camera: CameraEstimate) -> Array:
    """(M, 2) pixels of the camera's picture for pixels (M, 2) of the keyframe, as it was photographed."""
    if camera.lens is None:
        return points * keyframe.scale
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    return undistort_pixels(points, camera.lens, Intrinsics(camera.width, camera.height, fx, fy, cx, cy, "estimated"))


def localize(
    image: npt.NDArray[np.uint8],
    K: Array,
    known: Sequence[KeyframeLandmarks],
    config: TrackingConfig,
    likely: Sequence[str] = (),
) -> LocalizedCamera | None:
    """Localizes `image` (H, W, 3) with intrinsics `K`; None where too few features match the scene's.

    `likely` names the keyframes to compare it with; without them it is compared with all.
    """
    found = features.extract(image, _feature_config(config))
    chosen = [each for each in known if each.name in likely] if likely else list(known)
    ratio_test = features.NearestNeighbourConfig()
    matches = [features.match(found.descriptors, each.descriptors, ratio_test) for each in chosen]
    best = sorted(range(len(chosen)), key=lambda i: -len(matches[i]))[: config.keyframes]
    if not best or sum(len(matches[i]) for i in best) < config.min_inliers:
        return None
    pixels = np.concatenate([found.points[matches[i][:, 0]] for i in best])
    points = np.concatenate([chosen[i].points[matches[i][:, 1]] for i in best])
    scale = max(image.shape[:2]) / config.longer_side
    T_world_camera, inliers = _resect(pixels, points, K, config.max_error_px * scale)
    if inliers.sum() < max(config.min_inliers, config.min_share * len(inliers)):
        return None
    covariance = _covariance(T_world_camera, pixels[inliers], points[inliers], K, config.independent)
    return LocalizedCamera(T_world_camera, covariance, K, points[inliers], tuple(chosen[i].name for i in best))


def measure_motion(before: LocalizedCamera, now: LocalizedCamera, config: TrackingConfig) -> CameraMotion:
    """How the camera moved between two positions, and how certain that is."""
    T_before_now = np.linalg.inv(before.T_world_camera) @ now.T_world_camera
    rotation = Rotation.from_matrix(T_before_now[:3, :3]).as_rotvec()
    step = np.concatenate([T_before_now[:3, 3], rotation])
    mahalanobis2 = float(step @ np.linalg.solve(before.covariance + now.covariance, step))
    (u, v, depth), (u_now, v_now, _) = (_project(each.T_world_camera, now.K, now.points).T for each in (before, now))
    longer_side = 2 * max(now.K[0, 2], now.K[1, 2])
    shift = float(np.median(np.hypot(u - u_now, v - v_now))) * config.longer_side / longer_side
    certainty = float(chdtr(6, mahalanobis2))  # as scipy.stats has it, which takes half a second to load
    return CameraMotion(
        moved=certainty >= config.certainty and shift >= config.shift_px,
        rotation_deg=float(np.degrees(np.linalg.norm(rotation))),
        translation_rel=float(np.linalg.norm(step[:3]) / max(np.median(depth), MIN_DEPTH)),
        shift_px=shift,
        certainty=certainty,
    )


class Tracker:
    """Remembers where the camera stood and tells when it has moved."""

    def __init__(self, known: Sequence[KeyframeLandmarks], config: TrackingConfig) -> None:
        self._known, self._config = known, config
        self._stood: LocalizedCamera | None = None
        self._in_a_row = 0
        self._likely: tuple[str, ...] = ()

    def track(self, image: npt.NDArray[np.uint8], K: Array) -> tuple[LocalizedCamera | None, CameraMotion | None]:
        """Returns the camera and its motion since the first localized preview; None where unknown.

        `moved` is set once the configured number of previews in a row show a motion.
        """
        position = localize(image, K, self._known, self._config, self._likely)
        self._likely = position.keyframes if position else ()
        if position is None:
            return None, None
        if self._stood is None:
            self._stood = position
        found = measure_motion(self._stood, position, self._config)
        self._in_a_row = self._in_a_row + 1 if found.moved else 0
        confirmed = self._in_a_row >= self._config.confirmations
        return position, CameraMotion(
            confirmed, found.rotation_deg, found.translation_rel, found.shift_px, found.certainty
        )


def _feature_config(config: TrackingConfig) -> features.FeatureConfig:
    side = config.longer_side
    return features.FeatureConfig(max_num_features=config.num_features, max_image_size=side, min_longer_side=side)


def _resect(pixels: Array, points: Array, K: Array, max_error_px: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """T_world_camera (4, 4) from pixels (N, 2) of world points (N, 3), and which of them are inliers (N,)."""
    camera = {
        "model": "PINHOLE",
        "width": int(2 * K[0, 2]),
        "height": int(2 * K[1, 2]),
        "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    }
    pose, info = poselib.estimate_absolute_pose(
        pixels, points, camera, {"max_reproj_error": max_error_px, "seed": 0}, {"loss_type": "CAUCHY"}
    )
    T_camera_world = np.eye(4, dtype=np.float64)
    T_camera_world[:3] = np.asarray(pose.Rt)
    return np.asarray(np.linalg.inv(T_camera_world), np.float64), np.asarray(info["inliers"], bool)


def _project(T_world_camera: Array, K: Array, points: Array) -> Array:
    """(N, 3) columns, rows and depths of world points (N, 3)."""
    in_camera = transform_to_camera(points, T_world_camera)
    return np.c_[project(in_camera, K), np.maximum(in_camera[:, 2], MIN_DEPTH)]


def _covariance(T_world_camera: Array, pixels: Array, points: Array, K: Array, independent: int) -> Array:
    """(6, 6) of a motion of the camera in its own frame, from the residuals of its inliers."""
    projected = _project(T_world_camera, K, points)
    x, y = (projected[:, 0] - K[0, 2]) / K[0, 0], (projected[:, 1] - K[1, 2]) / K[1, 1]
    inverse, zero = 1 / projected[:, 2], np.zeros(len(points))
    # Moving the camera by (t, r) moves a point X in its frame by -t - r x X.
    row_u = K[0, 0] * np.stack([-inverse, zero, x * inverse, x * y, -(1 + x * x), y], 1)
    row_v = K[1, 1] * np.stack([zero, -inverse, y * inverse, 1 + y * y, -x * y, -x], 1)
    jacobian = np.concatenate([row_u, row_v])
    residuals = np.linalg.norm(pixels - projected[:, :2], axis=1)
    # Of one coordinate, robustly: the residuals' lengths have Rayleigh's distribution.
    variance = (float(np.median(residuals)) / RAYLEIGH_MEDIAN) ** 2 + MIN_VARIANCE_PX2
    dependence = max(1.0, len(points) / independent)
    return dependence * variance * np.linalg.inv(jacobian.T @ jacobian + DAMPING * np.eye(6))


# The thread that receives previews, so that the newest is at hand however seldom and slowly previews are examined.

log = logging.getLogger(__name__)

READ_S = 0.05  # between reads: a queue that is full keeps the oldest, and this one holds what a second brings
RETRY_S = 1.0  # after the connection failed
LOOK_S = 1.0  # between looks at which captures there are


class PreviewReceiver:
    """The newest preview. One thread runs `run`, another takes."""

    def __init__(self, network: Network, problems: Problems, stopping: threading.Event) -> None:
        self._network, self._problems, self._stopping = network, problems, stopping
        self._lock = threading.Lock()
        self._newest: Message[PreviewHeader] | None = None
        self._refused = 0
        self._unconnected = ""  # why none come

    def take(self) -> Message[PreviewHeader] | None:
        """The newest preview, once; None where none has come since. Never waits."""
        with self._lock:
            newest, self._newest = self._newest, None
            return newest

    def run(self) -> None:
        """Until the daemon stops. A connection that fails is made anew: the other end may have been put right."""
        while not self._stopping.is_set():
            try:
                camera_id = self._find_first()
                with Subscriber(CAPTURE_PREVIEW.select_capture(camera_id), self._network, PreviewHeader) as subscriber:
                    self._receive(subscriber, camera_id)
            except NotAllowed:  # which the keyframes' connection tells, too
                self._stopping.wait(RETRY_S)
            except Exception as error:  # a key's file, for one, may be written just now
                self._report_unconnected(error)
                self._stopping.wait(RETRY_S)

    def _find_first(self) -> str:
        """The camera id of the capture that is watched: of several the first, in the order of their ids."""
        return next(iter(find_captures(self._network)), "")

    def _receive(self, subscriber: Subscriber, camera_id: str) -> None:
        """Until another capture is to be watched. Raises NotAllowed."""
        self._unconnected = ""
        next_look_s = time.monotonic() + LOOK_S
        before = self._refused
        while not self._stopping.wait(READ_S):
            newest = subscriber.latest(0)
            self._refused = before + subscriber.refused
            self._problems.count("previews that were refused", self._refused, subscriber.why_refused)
            if newest is not None:
                with self._lock:
                    self._newest = newest
            if time.monotonic() >= next_look_s:
                next_look_s = time.monotonic() + LOOK_S
                if self._find_first() != camera_id:
                    return

    def _report_unconnected(self, error: Exception) -> None:
        """Once, however long it lasts."""
        why = f"{type(error).__name__}: {error}"
        if why == self._unconnected:
            return
        self._unconnected = why
        if is_logged(self._problems.add("failures of the previews' connection", why)):
            log.error("the connection that previews come by failed", exc_info=error)


# The thread that tracks the live camera: where it is in the finished scene, and whether it has moved.


@dataclass(frozen=True, eq=False)
class FinalScene:
    """A finished scene and the keyframes that it was made of."""

    snapshot: Snapshot
    keyframes: Sequence[Keyframe]

    @property
    def stream_lens(self) -> Intrinsics | None:
        """The lens of further images: that of the last camera, without the skew, which is of that image alone."""
        lens = self.snapshot.cameras[-1].lens
        return None if lens is None else replace(lens, skew=0.0)


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
        if self._config.interval_s <= 0:
            return
        receiving = threading.Thread(target=self._previews.run, name="previews", daemon=True)
        receiving.start()
        self._watch()
        receiving.join()

    def _watch(self) -> None:
        watched: FinalScene | None = None
        tracker = None
        while not self._stopping.wait(self._config.interval_s):
            finished = self._finished()
            if finished is not watched:
                watched, tracker, self.motion, self.tracked = finished, None, None, None
            message = self._previews.take()
            if watched is None or message is None:
                continue
            try:
                image = undistort_image(decode_preview(message), watched.stream_lens)
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


# The thread that tells clients where their images were taken, in the scene that is shown: also while it grows.
#
# It works beside the worker, and makes no keyframe wait: the landmarks of a scene are gathered when the first image of
# it comes, from the estimate that the scene was made with.

WAIT_S = 0.1  # for an image
NO_SCENE = "none"  # in place of a scene's id
NOTHING_YET = "there is no scene yet: it begins with the second or third keyframe"
UNKNOWN = "the cameras of the scene that is shown are being estimated anew; ask again in a moment"
MOST_FOLLOWED = 64  # connections whose last image is known


class LocatorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    live: bool = False  # answer clients that ask where their images were taken, as the service recon.locate


@dataclass(frozen=True, eq=False)
class LocatableScene:
    """The scene that viewers see, with what its landmarks are gathered from."""

    snapshot: Snapshot
    scene_id: str
    session: str  # of the message that shows it
    sequence: int
    revision: int  # of its world
    provisional: bool
    estimate: Reconstruction | None  # None: it is not known any more


class Locator:
    """Answers requests of `recon.locate`. `show` is for the thread that shows scenes, `run` for one of its own."""

    def __init__(self, network: Network, problems: Problems, stopping: threading.Event) -> None:
        """Raises what binding the service raises."""
        self._server = QueryServer(RECON_LOCATE, network, LocateRequest, QUERY_LIMITS)
        self._problems, self._stopping = problems, stopping
        self._shown: LocatableScene | None = None
        self._landmarks: tuple[LocatableScene, Landmarks | None] | None = None
        self._last: dict[bytes, tuple[int, Located]] = {}  # by connection: the revision, and where its last image was

    def close(self) -> None:
        self._server.close()

    def show(self, scene: LocatableScene) -> None:
        """From now on images are looked for in this scene."""
        self._shown = scene

    def run(self) -> None:
        """Until the daemon stops; on one processor, which leaves the others to the worker."""
        with apply_thread_limit(1):
            while not self._stopping.is_set():
                for identity, message in self._server.receive(WAIT_S):
                    self._server.reply(identity, self._answer(identity, message))

    def _answer(self, identity: bytes, message: Message[LocateRequest]) -> LocateAnswer:
        scene, request = self._shown, message.header
        if scene is None:
            return LocateAnswer(request.number, NO_SCENE, "0" * 32, 0, 0, True, why=NOTHING_YET)
        world = request.number, scene.scene_id, scene.session, scene.sequence, scene.revision, scene.provisional
        try:
            found = self._locate(identity, message, scene)
        except (WireError, ValueError) as error:  # of this image
            return LocateAnswer(*world, why=sanitize_text(str(error)))
        except Exception as error:
            if is_logged(self._problems.add("images that could not be located", f"{type(error).__name__}: {error}")):
                log.exception("an image could not be located")
            why = "memory or disk did not suffice" if is_shortage(error) else "the node failed; see its log"
            return LocateAnswer(*world, why=why)
        if isinstance(found, str):
            return LocateAnswer(*world, why=sanitize_text(found))
        return LocateAnswer(*world, **make_outcome_records(found))  # pyright: ignore[reportArgumentType]

    def _locate(
        self, identity: bytes, message: Message[LocateRequest], scene: LocatableScene
    ) -> Located | NotLocated | str:
        """The outcome, or why no place was looked for. Raises WireError, ValueError where the image cannot be used."""
        verdict = scene.snapshot.verdict
        if not verdict.publishable:
            return f"there is no scene: {verdict.code.value}. {verdict.message}"
        landmarks = self._gather_landmarks(scene)
        if landmarks is None:
            return UNKNOWN
        image, request = decode_query_image(message), message.header
        revision, near = self._last.pop(identity, (-1, None))
        if request.follows and near is not None and revision == scene.revision:
            found = follow(landmarks, image, near, request.intrinsics)
        else:
            found = localize_image(landmarks, image, request.intrinsics)
        if isinstance(found, Located):
            self._last[identity] = scene.revision, found
            while len(self._last) > MOST_FOLLOWED:
                del self._last[next(iter(self._last))]
        return found

    def _gather_landmarks(self, scene: LocatableScene) -> Landmarks | None:
        """The landmarks of a scene in its world and unit, gathered once."""
        if self._landmarks is None or self._landmarks[0] is not scene:
            known = scene.snapshot.landmarks or add_landmarks(scene.snapshot, scene.estimate).landmarks
            metric = scene.snapshot.scale.metric
            self._landmarks = scene, known and replace(known, metric=metric)
        return self._landmarks[1]
