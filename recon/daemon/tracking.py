"""Has the camera moved? Previews are placed in the finished scene and compared with where the camera stood.

A preview's features are matched with those of the keyframes, whose points the scene's depth makes known; the camera
follows from these points (P3P in RANSAC, then least squares). Features do not depend on the light, and both positions
rest on the same points, so that errors of the scene, which are the same in both, cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt
import poselib
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.geometry import MIN_DEPTH, project, to_camera
from splatnode.recon.matching import features, nearest_neighbours
from splatnode.recon.result.picture import take_picture
from splatnode.recon.result.snapshot import Snapshot

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    every_s: float = 1.0  # between previews that are looked at; 0: the camera is not watched
    num_features: int = 2000  # of a preview
    longer_side: int = 800  # pixels at which they are found
    keyframes: int = 3  # that a preview is compared with: those that know it best
    min_alpha: float = 0.8  # of the Gaussians at a keyframe's point
    min_inliers: int = 20  # points on which a position rests
    min_share: float = 0.3  # of the matches that it explains; of matches with another place it explains up to 0.2
    max_error_px: float = 3.0  # of such a point, at `longer_side`
    independent: int = 50  # points share errors of the scene: more of them are no more certain than so many
    certainty: float = 0.999
    shift_px: float = 3.0  # at `longer_side`: a shorter shift of the picture is no motion
    confirmations: int = 2  # previews in a row


@dataclass(frozen=True, eq=False)
class Landmarks:
    """What one keyframe knows."""

    name: str
    points: Array  # (M, 3) world
    descriptors: npt.NDArray[np.uint8]  # (M, 128)


@dataclass(frozen=True, eq=False)
class Position:
    """Where a preview was taken, and how well that is known."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of a small motion in the camera's frame: translation, then rotation vector
    K: Array  # (3, 3) of the preview
    points: Array  # (N, 3) on which it rests
    keyframes: tuple[str, ...]  # that know the preview best, the best first


@dataclass(frozen=True)
class Motion:
    """Between two positions. Lengths are relative to the median depth of the points, as scenes have no scale."""

    moved: bool
    rotation_deg: float
    translation_rel: float
    shift_px: float  # median shift of the points in the picture, at the configured size
    certainty: float  # that the camera is not where it was, in [0, 1]

    def __str__(self) -> str:
        return (
            f"turned by {self.rotation_deg:.1f}°, moved by {100 * self.translation_rel:.1f} % of the distance to the "
            f"scene, {self.shift_px:.0f} px in the picture, certain to {100 * self.certainty:.1f} %"
        )


def landmarks(snapshot: Snapshot, keyframes: Sequence[Keyframe], config: Config) -> list[Landmarks]:
    """The features of the snapshot's keyframes, where the Gaussians are dense enough to tell their depth."""
    cameras = {camera.name: camera for camera in snapshot.cameras}
    known = []
    for keyframe in (keyframe for keyframe in keyframes if keyframe.name in cameras):
        camera, found = cameras[keyframe.name], keyframe.features
        picture = take_picture(
            snapshot.gaussians, camera.T_world_camera, camera.K, camera.width, camera.height, channels=("depth",)
        )
        plain = found.tilt == 1.0
        pixels = found.points[found.point_of[plain]] * keyframe.scale
        column, row = np.clip(pixels.astype(int), 0, [camera.width - 1, camera.height - 1]).T
        depth = picture.depth[row, column].astype(np.float64)
        good = (depth > 0) & (picture.alpha[row, column] >= config.min_alpha)
        rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(camera.K).T
        T_world_camera = camera.T_world_camera
        points = (rays * depth[:, None])[good] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        known.append(Landmarks(keyframe.name, points, found.descriptors[plain][good]))
    return known


def locate(
    image: npt.NDArray[np.uint8], K: Array, known: Sequence[Landmarks], config: Config, likely: Sequence[str] = ()
) -> Position | None:
    """Where `image` (H, W, 3) with intrinsics `K` was taken; None where the scene does not know it.

    `likely` names the keyframes to compare it with; without them it is compared with all.
    """
    found = features.extract(image, _feature_config(config))
    chosen = [place for place in known if place.name in likely] if likely else list(known)
    ratio_test = nearest_neighbours.Config()
    matches = [nearest_neighbours.match(found.descriptors, place.descriptors, ratio_test) for place in chosen]
    best = sorted(range(len(chosen)), key=lambda i: -len(matches[i]))[: config.keyframes]
    if not best or sum(len(matches[i]) for i in best) < config.min_inliers:
        return None
    pixels = np.concatenate([found.points[matches[i][:, 0]] for i in best])
    points = np.concatenate([chosen[i].points[matches[i][:, 1]] for i in best])
    scale = max(image.shape[:2]) / config.longer_side
    T_world_camera, inside = _resect(pixels, points, K, config.max_error_px * scale)
    if inside.sum() < max(config.min_inliers, config.min_share * len(inside)):
        return None
    covariance = _covariance(T_world_camera, pixels[inside], points[inside], K, config.independent)
    return Position(T_world_camera, covariance, K, points[inside], tuple(chosen[i].name for i in best))


def motion(before: Position, now: Position, config: Config) -> Motion:
    """How the camera moved between two positions, and how certain that is."""
    T_before_now = np.linalg.inv(before.T_world_camera) @ now.T_world_camera
    turn = Rotation.from_matrix(T_before_now[:3, :3]).as_rotvec()
    step = np.concatenate([T_before_now[:3, 3], turn])
    distance = float(step @ np.linalg.solve(before.covariance + now.covariance, step))
    (u, v, depth), (u_now, v_now, _) = (_project(place.T_world_camera, now.K, now.points).T for place in (before, now))
    longer_side = 2 * max(now.K[0, 2], now.K[1, 2])
    shift = float(np.median(np.hypot(u - u_now, v - v_now))) * config.longer_side / longer_side
    certainty = float(chi2.cdf(distance, df=6))
    return Motion(
        moved=certainty >= config.certainty and shift >= config.shift_px,
        rotation_deg=float(np.degrees(np.linalg.norm(turn))),
        translation_rel=float(np.linalg.norm(step[:3]) / max(np.median(depth), 1e-9)),
        shift_px=shift,
        certainty=certainty,
    )


class Watch:
    """Remembers where the camera stood and says when it no longer does."""

    def __init__(self, known: Sequence[Landmarks], config: Config) -> None:
        self._known, self._config = known, config
        self._stood: Position | None = None
        self._in_a_row = 0
        self._likely: tuple[str, ...] = ()

    def look(self, image: npt.NDArray[np.uint8], K: Array) -> tuple[Position | None, Motion | None]:
        """Where the camera is, and how it moved since it was first seen standing; None for what is not known.

        `moved` is set once as many previews in a row as configured say so.
        """
        position = locate(image, K, self._known, self._config, self._likely)
        self._likely = position.keyframes if position else ()
        if position is None:
            return None, None
        if self._stood is None:
            self._stood = position
        found = motion(self._stood, position, self._config)
        self._in_a_row = self._in_a_row + 1 if found.moved else 0
        confirmed = self._in_a_row >= self._config.confirmations
        return position, Motion(confirmed, found.rotation_deg, found.translation_rel, found.shift_px, found.certainty)


def _feature_config(config: Config) -> features.Config:
    side = config.longer_side
    return features.Config(num_features=config.num_features, max_longer_side=side, min_longer_side=side)


def _resect(pixels: Array, points: Array, K: Array, max_error_px: float) -> tuple[Array, npt.NDArray[np.bool_]]:
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
    in_camera = to_camera(points, T_world_camera)
    return np.c_[project(in_camera, K), np.maximum(in_camera[:, 2], MIN_DEPTH)]


def _covariance(T_world_camera: Array, pixels: Array, points: Array, K: Array, independent: int) -> Array:
    """(6, 6) of a motion of the camera in its own frame, from the residuals of the points that it rests on."""
    projected = _project(T_world_camera, K, points)
    x, y = (projected[:, 0] - K[0, 2]) / K[0, 0], (projected[:, 1] - K[1, 2]) / K[1, 1]
    inverse, zero = 1 / projected[:, 2], np.zeros(len(points))
    # Of a point X in the camera: moving the camera by (t, r) moves X by -t - r x X.
    row_u = K[0, 0] * np.stack([-inverse, zero, x * inverse, x * y, -(1 + x * x), y], 1)
    row_v = K[1, 1] * np.stack([zero, -inverse, y * inverse, 1 + y * y, -x * y, -x], 1)
    jacobian = np.concatenate([row_u, row_v])
    residuals = np.linalg.norm(pixels - projected[:, :2], axis=1)
    # Of one coordinate: the residuals' lengths have Rayleigh's distribution, whose median is 1.1774 sigma.
    variance = (float(np.median(residuals)) / 1.1774) ** 2 + 1e-4
    share = max(1.0, len(points) / independent)
    return share * variance * np.linalg.inv(jacobian.T @ jacobian + 1e-9 * np.eye(6))
