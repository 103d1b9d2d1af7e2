"""Cameras that depth images place, where photographs show too little to match: multi-view ICP.

Depth images of neighbours show the same surfaces. Each pair is aligned point to plane (Chen and Medioni, "Object
modelling by registration of multiple range images", 1992), with corresponding points found by projection, from many
starts: turns of some tens of degrees about the camera and about what it sees. A pair counts where surfaces agree,
nothing stands before what the other camera saw through, brightness agrees, and no other alignment does nearly as well.
All cameras are then adjusted together. What surfaces leave open, as the way along a plain wall, stays open in the
covariance, and a camera of which too much is open is not placed.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.frame import Frame
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.geometry import cross_matrix, invert_pose
from splatnode.recon.metric.depth_fit import DepthView, fit_planes, warp_depth
from splatnode.recon.registration.known_poses import has_calibrated_lens

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

log = logging.getLogger(__name__)

# The surface that a depth image shows: points with normals.

_SIDE = 160  # of a cloud's longer side, pixels
_STEP = 3  # every so many pixels a point
_RADIUS = 3  # pixels, of the window whose plane gives a point's normal
_LEAST_KNOWN = 0.6  # share of the window that has a depth
_MOST_SHARE = 0.06  # standard deviation of a depth that is used, as a share of it
_FLAT = 0.01  # distance from a plane that counts as flat, as a share of the depth, if the noise is less
_LEAST_POINTS = 300  # of a cloud
_BLACK = 8.0  # grey levels that are added before the logarithm
# Points are of one plane where each lies in the other's, and normals differ by less, round by round, degrees
_MATES_DEG, _PLANE_SIGMAS = (25.0, 15.0, 10.0), 2.0
_DIRECTION_DEG, _DIRECTION_ROUNDS = 20.0, 5  # between normals that are one direction


@dataclass(frozen=True, eq=False)
class DepthCloud:
    """The surface that a depth image shows, as the pinhole of its photograph sees it. Maps are flat: M pixels."""

    name: str
    K: Array  # (3, 3) of the maps
    shape: tuple[int, int]  # of the maps: h, w
    surface: Array  # (M, 3) points, 0: not known
    sigma: Array  # (M,) standard deviation of z, metres
    normals: Array  # (M, 3) facing the camera, 0: not known
    directions: Array  # (M, 3) normals without what may be their noise: one for all that are about alike; 0: not known
    log_light: Array  # (M,) logarithm of the photograph's brightness
    scale_sigma: float  # of all its depths alike, as a share
    chosen: Index  # (N,) pixels that are aligned with other clouds

    @property
    def points(self) -> Array:
        """(N, 3) of the chosen pixels."""
        return self.surface[self.chosen]


def make_depth_cloud(frame: Frame) -> DepthCloud | None:
    """Makes the cloud of a frame without distortion.

    None without depth or a lens that was told, or where too little is measured.
    """
    lens = frame.intrinsics
    if frame.depth is None or lens is None or not has_calibrated_lens(frame):
        return None
    scale = _SIDE / max(frame.width, frame.height)
    width, height = max(1, round(frame.width * scale)), max(1, round(frame.height * scale))
    K = np.diag([width / frame.width, height / frame.height, 1.0]) @ lens.resized(frame.width, frame.height).K
    view = DepthView(frame.name, frame.camera_id, np.zeros((0, 3)), frame.depth, lens)
    measured = warp_depth(view, K, (height, width))
    known = (measured.z > 0) & (measured.sigma < _MOST_SHARE * measured.z)
    z, sigma = np.where(known, measured.z, 0.0), np.where(known, measured.sigma, 0.0)
    u, v = np.meshgrid((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])
    normals, flat = _fit_normals(z, sigma, known, u * K[0, 0], v * K[1, 1], K)
    surface = (np.stack([u, v, np.ones_like(u)], -1) * z[..., None]).reshape(-1, 3)
    grid = np.zeros_like(flat)
    grid[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP] = True
    chosen = np.flatnonzero(flat & grid)
    if len(chosen) < _LEAST_POINTS:
        return None
    grey = cv2.resize(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), (width, height), interpolation=cv2.INTER_AREA)
    light = np.log(cv2.GaussianBlur(grey.astype(np.float64), (0, 0), 1.0) + _BLACK)
    normals, directions = _share_normals(normals.reshape(-1, 3), chosen, surface, sigma.ravel(), (height, width))
    return DepthCloud(
        *(frame.name, K, (height, width), surface, sigma.ravel(), normals, directions, light.ravel()),
        scale_sigma=frame.depth.noise.scale_sigma,
        chosen=chosen,
    )


def _fit_normals(z: Array, sigma: Array, known: Mask, x: Array, y: Array, K: Array) -> tuple[Array, Mask]:
    """Fits (h, w, 3) normals, 0 where there is no plane, and tells where there is one.

    The plane n . X = 1 has 1 / z = n . ray, which is linear in the pixel (`x`, `y` from the principal point).
    """
    side = 2 * _RADIUS + 1
    nearness = np.where(known, 1.0 / np.maximum(z, 1e-9), 0.0)
    planes = fit_planes(nearness, known, side)
    n = np.stack(
        [planes.slope_x * K[0, 0], planes.slope_y * K[1, 1], planes.value - planes.slope_x * x - planes.slope_y * y], -1
    )
    length = np.linalg.norm(n, axis=-1)
    flat = known & (planes.count > _LEAST_KNOWN * side**2) & (planes.value > 0) & (length > 1e-9)
    flat &= planes.rms < np.maximum(3.0 * sigma * nearness**2, _FLAT * nearness)
    return np.where(flat[..., None], -n / np.maximum(length, 1e-9)[..., None], 0.0), flat


def _share_normals(
    normals: Array, chosen: Index, surface: Array, sigma: Array, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Each of the (M, 3) normals as the mean of those of all chosen points in its plane; and of all about alike.

    Noise of normals looks like a rough wall, which would tell where along the wall a camera is.
    """
    own, near = normals[chosen].astype(np.float32), surface[chosen].astype(np.float32)
    noise = sigma[chosen].astype(np.float32)
    apart = _PLANE_SIGMAS * (noise + noise[:, None])
    for degrees in _MATES_DEG:
        off = np.abs(own @ near.T - (own * near).sum(1)[:, None]) < apart
        mates = off & off.T & (own @ own.T > np.cos(np.radians(degrees)))
        own = mates.astype(np.float32) @ own
        own /= np.linalg.norm(own, axis=1, keepdims=True)
    broad = own
    for _ in range(_DIRECTION_ROUNDS):
        broad = (broad @ own.T > np.cos(np.radians(_DIRECTION_DEG))).astype(np.float32) @ own
        broad /= np.linalg.norm(broad, axis=1, keepdims=True)
    numbers = np.zeros(shape, np.float32)
    numbers.ravel()[chosen] = np.arange(1, len(chosen) + 1)
    nearest = cv2.dilate(numbers, np.ones((_STEP, _STEP))).astype(np.int64).ravel() - 1
    place = np.maximum(nearest, 0)
    theirs = own[place].astype(np.float64)
    off = np.abs(((surface - surface[chosen][place]) * theirs).sum(-1))
    alike = ((nearest >= 0) & (off < 2 * _PLANE_SIGMAS * sigma))[:, None]
    return np.where(alike, theirs, normals), np.where(alike, broad[place].astype(np.float64), 0.0)


# Whether a depth image goes with its photograph: surfaces are of one brightness each, which ends where they end.

_LATEST = 4  # in the order of the frames: by so many a depth image may be late
_FITS_BETTER, _FITS = 2.0, 0.5  # unexplained share of its own photograph over that of another one, which is at most
_LEAST_LIGHT = 0.01  # standard deviation of the logarithm of brightness that surfaces leave unexplained


# Depths whose planes are straight once distances along the rays are made depths of them. Pixels of the maps
_BOW_RADIUS, _BOW_STEP, _BOW_WINDOWS = 20, 10, 20  # of a window, between two windows, and the fewest of them
_STRAIGHT, _MOST_BOW = 0.01, 0.02  # distance from a plane, rms over the nearness: of one, and the largest that counts
_BOWED, _GAIN = 0.6, 0.7  # the least power of the rays' lengths that straightens planes; the cost with over without


def are_along_rays(clouds: Sequence[DepthCloud]) -> bool:
    """Whether planes show that depth images hold distances along the ray instead of z: so simulators have them.

    The nearness 1 / z of a plane is linear in the image. That of a distance is, once it is multiplied by the length of
    the ray at depth 1.
    """
    powers, side = (0.0, 0.5, 1.0), 2 * _BOW_RADIUS + 1
    bows: list[Array] = []  # (3, W) each
    for cloud in clouds:
        z = cloud.surface[:, 2].reshape(cloud.shape)
        v, u = np.mgrid[: cloud.shape[0], : cloud.shape[1]] + 0.5
        K, known = cloud.K, z > 0
        length = np.sqrt(1.0 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)
        nearness = np.where(known, 1.0 / np.maximum(z, 1e-9), 0.0)
        planes = [fit_planes(nearness * length**power, known, side) for power in powers]
        grid = np.s_[::_BOW_STEP, ::_BOW_STEP]
        whole = planes[0].count[grid] > 0.8 * side**2
        bows.append(np.stack([(each.rms / np.maximum(each.value, 1e-9))[grid][whole] for each in planes]))
    found = np.concatenate(bows, axis=1) if bows else np.zeros((3, 0))
    found = np.minimum(found[:, found.min(0) < _STRAIGHT], _MOST_BOW)
    if found.shape[1] < _BOW_WINDOWS:
        return False
    without, half, with_all = (found**2).sum(1)
    bend = without - 2.0 * half + with_all
    best = 0.5 + 0.25 * (without - with_all) / bend if bend > 0 else float(with_all < without)
    return bool(best > _BOWED and with_all < _GAIN * without)


def find_exchanged_depth(clouds: Sequence[DepthCloud]) -> dict[int, int]:
    """The clouds, in the order of their frames, whose depth fits another one's photograph much better; and which one.

    A depth camera that hangs or is late gives such, and they agree with each other wherever the camera was.
    """
    found = {}
    for k, cloud in enumerate(clouds):
        first = max(0, k - _LATEST)
        around = [each for each in clouds[first : k + _LATEST + 1] if each.shape == cloud.shape]
        own = next(place for place, each in enumerate(around) if each is cloud)
        noise, share = _explain_light(cloud, [each.log_light for each in around])
        best = int(np.argmin(share))
        if noise[own] > _LEAST_LIGHT and share[best] < _FITS and share[own] > _FITS_BETTER * share[best]:
            found[k] = next(place for place, each in enumerate(clouds) if each is around[best])
    return found


def _explain_light(cloud: DepthCloud, lights: Sequence[Array]) -> tuple[Array, Array]:
    """Returns what planes of the cloud leave unexplained of each brightness: standard deviation, share of variance."""
    near, own = cloud.points.astype(np.float32), cloud.normals[cloud.chosen].astype(np.float32)
    noise = cloud.sigma[cloud.chosen].astype(np.float32)
    off = np.abs(own @ near.T - (own * near).sum(1)[:, None]) < _PLANE_SIGMAS * (noise + noise[:, None])
    mates = (off & off.T & (own @ own.T > np.cos(np.radians(_MATES_DEG[-1])))).astype(np.float32)
    light = np.stack([each[cloud.chosen] for each in lights], 1)
    light -= light.mean(0)
    left = light - (mates @ light.astype(np.float32)) / np.maximum(mates.sum(1), 1.0)[:, None]
    unexplained = (left**2).mean(0)
    return np.sqrt(unexplained), unexplained / np.maximum((light**2).mean(0), 1e-12)


# How one cloud lies beside another one.

_FLOOR_M = 0.004  # of the distance between surfaces, beside what the noise makes
_ON_SIGMAS = 3.0  # of a point on the other's surface
_ALIKE_COS = np.cos(np.radians(35.0))  # of the normals of corresponding points
_NEAREST_M = 0.05  # of a point before a camera
_BEFORE_SIGMAS, _BEFORE_M = 4.0, 0.04  # by which a point is before what the other camera saw
_DARKER = 0.12  # difference of the logarithm of brightness, after the median
_LEAST_SHARED = 100  # points on known depth


def _look_up(target: DepthCloud, points: Array) -> tuple[Index, Mask]:
    """The pixel of `target` that each point (..., 3) in its camera's frame falls on, and whether that has a depth."""
    z = points[..., 2]
    ahead = z > _NEAREST_M
    safe = np.where(ahead, z, 1.0)
    u = target.K[0, 0] * points[..., 0] / safe + target.K[0, 2]
    v = target.K[1, 1] * points[..., 1] / safe + target.K[1, 2]
    inside = ahead & (u >= 0) & (v >= 0) & (u < target.shape[1]) & (v < target.shape[0])
    pixel = np.where(inside, v, 0.0).astype(np.int64) * target.shape[1] + np.where(inside, u, 0.0).astype(np.int64)
    return pixel, inside & (target.surface[pixel, 2] > 0)


@dataclass(frozen=True, eq=False)
class _Residuals:
    """The residuals of points (..., N) from the planes that they fall on."""

    off: Array  # signed distance, metres
    normals: Array  # (..., N, 3) of the planes
    sigma: Array  # of the distance
    counts: Mask
    pixel: Index
    known: Mask  # where the other camera measured a depth

    @property
    def is_on(self) -> Mask:
        """Whether a point lies on the other's surface."""
        return self.counts & (np.abs(self.off) < _ON_SIGMAS * self.sigma)


def _compute_residuals(
    target: DepthCloud, points: Array, normals: Array, sigmas: Array, gate_m: float = 0.0
) -> _Residuals:
    """The residuals; those count that are within `gate_m`, for a surface 2 m away, or the noise if that is more."""
    pixel, known = _look_up(target, points)
    n, q = target.normals[pixel], target.surface[pixel]
    off = ((points - q) * n).sum(-1)
    slant = np.abs((n * q).sum(-1)) / np.maximum(q[..., 2], 1e-9)
    sigma = np.sqrt((slant * target.sigma[pixel]) ** 2 + (slant * sigmas) ** 2 + _FLOOR_M**2)
    counts = known & ((n * normals).sum(-1) > _ALIKE_COS)
    counts &= np.abs(off) < np.maximum(gate_m * np.maximum(q[..., 2], 0.5) / 2.0, _ON_SIGMAS * sigma)
    return _Residuals(off, n, sigma, counts, pixel, known)


def _compare(cloud: DepthCloud, target: DepthCloud, T: Array) -> tuple[Array, _Residuals]:
    """The chosen points of the cloud in the target's frame, where its camera is at `T` (4, 4), and their residuals."""
    points, normals = cloud.points @ T[:3, :3].T + T[:3, 3], cloud.normals[cloud.chosen] @ T[:3, :3].T
    return points, _compute_residuals(target, points, normals, cloud.sigma[cloud.chosen])


@dataclass(frozen=True)
class Agreement:
    """How the points of a cloud go with another cloud. Shares are of the points on known depth but the first."""

    overlap: float  # share of all points that fall on known depth
    on_surface: float
    before: float  # share where the other camera saw through a point: what a right pose never has
    darker: float  # share of those on the surface whose brightness differs

    @property
    def score(self) -> float:
        """How much speaks for it: at most 1."""
        hidden = 1.0 - self.on_surface - self.before
        return self.overlap * (self.on_surface - 2.0 * self.before - 0.5 * hidden - self.darker)

    @property
    def is_contradicted(self) -> bool:
        """Whether surfaces or brightness contradict the pose."""
        return self.before > _MOST_BEFORE or self.darker > _MOST_DARKER or self.on_surface < _LEAST_SEEN

    @property
    def is_sound(self) -> bool:
        """Whether the clouds overlap enough, and agree where they do."""
        return self.overlap >= _LEAST_OVERLAP and self.on_surface >= _LEAST_ON and not self.is_contradicted


_LEAST_OVERLAP, _LEAST_ON, _MOST_BEFORE, _MOST_DARKER = 0.3, 0.7, 0.05, 0.1
_LEAST_SEEN = 0.4  # as _LEAST_ON, of cameras far from each other, between which much is hidden


def compute_agreement(cloud: DepthCloud, target: DepthCloud, T: Array) -> Agreement:
    """How `cloud` goes with `target` where its camera is at `T` (4, 4) in the target's frame."""
    points, found = _compare(cloud, target, T)
    known, on = found.known, found.is_on
    shared = int(known.sum())
    if shared < _LEAST_SHARED:
        return Agreement(0.0, 0.0, 0.0, 0.0)
    margin = _BEFORE_SIGMAS * np.hypot(target.sigma[found.pixel], cloud.sigma[cloud.chosen]) + _BEFORE_M
    before = known & ~on & (points[:, 2] < target.surface[found.pixel, 2] - margin)
    difference = cloud.log_light[cloud.chosen] - target.log_light[found.pixel]
    gain = float(np.median(difference[on])) if on.any() else 0.0
    darker = on & (np.abs(difference - gain) > _DARKER)
    share = float(darker.sum()) / max(int(on.sum()), 1)
    return Agreement(shared / len(points), float(on.sum()) / shared, float(before.sum()) / shared, share)


# The alignment of two clouds.

_YAWS_DEG, _PITCHES_DEG = range(-40, 41, 10), range(-20, 21, 10)  # turns of the starts
_COARSE_POINTS = 250
_COARSE_GATES_M = (0.6, 0.45, 0.35, 0.25, 0.2, 0.15, 0.12, 0.1)  # of residuals, step by step
_FINE_GATES_M = (0.1,) * 3 + (0.0,) * 10
_KEPT = 12  # alignments that are refined
_SHIFTS_M = np.delete(np.arange(-2.4, 2.5, 0.15), 16)  # of further starts from the best, for a surface 2 m away
_SHIFTED_GATES_M = (0.15, 0.15, 0.12, 0.12, 0.1, 0.1)
_DAMPING = 1e2  # 1 / radians^2, 1 / metres^2
_LONGEST_TURN, _LONGEST_SHIFT_M = 0.3, 0.5  # of a step, radians and metres
_SAME_DEG, _SAME_M = 4.0, 0.1  # between alignments that are one
_LEAST_AHEAD = 0.04  # of the best alignment's score over that of another one
_RIVAL_OVERLAP, _RIVAL_BEFORE = 0.4, 0.01  # of an alignment that nothing contradicts, in the mean and at most
_SAME_SIGMAS = 4.0  # between alignments that differ in what surfaces leave open only
_POINTS_AS_ONE = 10.0  # neighbours are wrong alike, and each pair is seen from both sides
_DISTRUSTED = 0.03  # share of the points that count in a direction, those that tell most


@dataclass(frozen=True, eq=False)
class Alignment:
    """The place of one cloud's camera in another one's frame, by their surfaces."""

    T_target_cloud: Array  # (4, 4)
    forward: Agreement
    backward: Agreement

    @property
    def score(self) -> float:
        """The score of the worse direction."""
        return min(self.forward.score, self.backward.score)

    @property
    def is_possible(self) -> bool:
        """Whether nothing contradicts it, however much better another one overlaps, as where surfaces repeat."""
        both = self.forward, self.backward
        return sum(each.overlap for each in both) >= 2 * _RIVAL_OVERLAP and all(
            each.on_surface >= _LEAST_ON and each.before <= _RIVAL_BEFORE and each.darker <= _MOST_DARKER
            for each in both
        )


def align_clouds(cloud: DepthCloud, target: DepthCloud) -> list[Alignment]:
    """The distinct alignments of two clouds, the best first.

    Of surfaces that repeat themselves, as doors along a corridor, those are among them that a start beside the best
    one leads to.
    """
    generator = np.random.default_rng(0)
    few = np.sort(generator.choice(len(cloud.chosen), min(_COARSE_POINTS, len(cloud.chosen)), replace=False))
    Ts = _descend(cloud, target, _make_starts(cloud), cloud.chosen[few], _COARSE_GATES_M)
    found = _refine(cloud, target, Ts)
    beside = _shift_starts(cloud, target, found[0].T_target_cloud)
    found += _refine(cloud, target, _descend(cloud, target, beside, cloud.chosen[few], _SHIFTED_GATES_M))
    found.sort(key=lambda each: -each.score)
    return [found[k] for k in _find_distinct(np.stack([each.T_target_cloud for each in found]))]


def _refine(cloud: DepthCloud, target: DepthCloud, Ts: Array) -> list[Alignment]:
    """The best few of the poses (S, 4, 4), refined, the best first."""
    scores = [compute_agreement(cloud, target, T).score for T in Ts]
    Ts = Ts[np.argsort(np.negative(scores), kind="stable")]
    Ts = _descend(cloud, target, Ts[_find_distinct(Ts)[:_KEPT]], cloud.chosen, _FINE_GATES_M)
    found = [
        Alignment(T, compute_agreement(cloud, target, T), compute_agreement(target, cloud, invert_pose(T))) for T in Ts
    ]
    return sorted(found, key=lambda each: -each.score)


def _shift_starts(cloud: DepthCloud, target: DepthCloud, T: Array) -> Array:
    """(S, 4, 4) poses beside `T`, shifted the two ways of which surfaces tell least."""
    sure = _compute_information(cloud, target, T).sure
    turns = sure[:3, :3] + _DAMPING * np.eye(3)
    _, ways = np.linalg.eigh(sure[3:, 3:] - sure[3:, :3] @ np.linalg.solve(turns, sure[:3, 3:]))
    far = float(np.median(cloud.points[:, 2])) / 2.0
    Ts = np.tile(T, (2 * len(_SHIFTS_M), 1, 1))
    Ts[:, :3, 3] += (far * _SHIFTS_M[:, None] * ways.T[:2, None]).reshape(-1, 3)
    return Ts


def choose_alignment(alignments: Sequence[Alignment], cloud: DepthCloud, target: DepthCloud) -> Array | None:
    """T_target_cloud (4, 4) of the alignment that is beyond doubt; None where there is none."""
    best = alignments[0]
    if not (best.forward.is_sound and best.backward.is_sound):
        return None
    known = _compute_information(cloud, target, best.T_target_cloud).sure
    for other in alignments[1:]:
        is_rival = other.is_possible or other.score >= best.score - _LEAST_AHEAD
        if is_rival and _count_sigmas(best.T_target_cloud, other.T_target_cloud, known) > _SAME_SIGMAS:
            return None
    return best.T_target_cloud


def _make_starts(cloud: DepthCloud) -> Array:
    """(S, 4, 4) poses from which alignments begin: turned about the camera, and about the middle of what it sees."""
    middle, found = np.median(cloud.points, axis=0), []
    for yaw in _YAWS_DEG:
        for pitch in _PITCHES_DEG:
            R = Rotation.from_euler("yx", [yaw, pitch], degrees=True).as_matrix()
            for pivot in (np.zeros(3), middle):
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = R, pivot - R @ pivot
                found.append(T)
    return np.stack(found)


def _descend(cloud: DepthCloud, target: DepthCloud, Ts: Array, chosen: Index, gates_m: Sequence[float]) -> Array:
    """The poses (S, 4, 4) after one robust Gauss-Newton step a gate."""
    points, normals, sigmas = cloud.surface[chosen], cloud.normals[chosen], cloud.sigma[chosen]
    for gate in gates_m:
        turns = np.swapaxes(Ts[:, :3, :3], 1, 2)
        moved = points @ turns + Ts[:, None, :3, 3]
        found = _compute_residuals(target, moved, normals @ turns, sigmas, gate)
        spread = np.maximum(found.sigma, gate / 3.0)
        weight = np.where(found.counts, 1.0 / (1.0 + (found.off / spread) ** 2) / found.sigma**2, 0.0)
        J = np.concatenate([np.cross(moved, found.normals), found.normals], -1)  # of n . (w x p + t)
        A = np.swapaxes(J * weight[..., None], 1, 2) @ J + _DAMPING * np.eye(6)
        step = -np.linalg.solve(A, np.einsum("snk,sn->sk", J, weight * found.off)[..., None])[..., 0]
        turn = Rotation.from_rotvec(step[:, :3].clip(-_LONGEST_TURN, _LONGEST_TURN)).as_matrix()
        shift = step[:, 3:].clip(-_LONGEST_SHIFT_M, _LONGEST_SHIFT_M)
        Ts = Ts.copy()
        Ts[:, :3, 3] = (turn @ Ts[:, :3, 3, None])[..., 0] + shift
        Ts[:, :3, :3] = turn @ Ts[:, :3, :3]
    return Ts


def _find_distinct(Ts: Array) -> list[int]:
    """The numbers of the poses (S, 4, 4) that are not near an earlier one."""
    kept: list[int] = []
    for k, T in enumerate(Ts):
        turns = Rotation.from_matrix(T[:3, :3] @ np.swapaxes(Ts[kept, :3, :3], 1, 2)).magnitude() if kept else []
        near = np.linalg.norm(T[:3, 3] - Ts[kept, :3, 3], axis=1) < _SAME_M
        if not (near & (np.degrees(turns) < _SAME_DEG)).any():
            kept.append(k)
    return kept


def _count_sigmas(T: Array, other: Array, information: Array) -> float:
    """How many standard deviations one pose is from another one of the same camera."""
    turn = Rotation.from_matrix(other[:3, :3] @ T[:3, :3].T)
    error = np.concatenate([turn.as_rotvec(), other[:3, 3] - turn.apply(T[:3, 3])])
    return float(np.sqrt(max(error @ information @ error, 0.0)))


@dataclass(frozen=True, eq=False)
class _Information:
    """The information of surfaces on the turn and the shift (6) that move a cloud in the target's frame."""

    matrix: Array  # (6, 6)
    gradient: Array  # (6,)
    sure: Array  # (6, 6) by directions instead of normals, and without those few points that tell most


def _compute_information(cloud: DepthCloud, target: DepthCloud, T: Array) -> _Information:
    points, found = _compare(cloud, target, T)
    weight = np.where(found.counts, 1.0 / (1.0 + (found.off / (2.0 * found.sigma)) ** 2) / found.sigma**2, 0.0)
    weight /= _POINTS_AS_ONE
    J, broad = (
        np.concatenate([np.cross(points, n), n], -1).astype(np.float64)
        for n in (found.normals, target.directions[found.pixel])
    )
    return _Information((J * weight[:, None]).T @ J, J.T @ (weight * found.off), _trim_information(broad, weight))


def _trim_information(J: Array, weight: Array) -> Array:
    """(6, 6) information of the points without those few that tell most, direction by direction.

    A pattern that lies in the depth images themselves, as at their borders, stands still in all of them: few points
    must not tell what all others leave open.
    """
    _, directions = np.linalg.eigh((J * weight[:, None]).T @ J)
    contributions = weight[:, None] * (J @ directions) ** 2
    few = max(1, round(_DISTRUSTED * int((weight > 0).sum())))
    contributions.partition(len(contributions) - few, axis=0)
    return (directions * contributions[:-few].sum(0)) @ directions.T


# All cameras together.

_ROUNDS = 12  # of the joint adjustment
_OPEN_M, _OPEN_RAD = 10.0, np.pi  # standard deviations of what surfaces leave open
_LEAST_SIGMA_M, _LEAST_SIGMA_DEG = 0.002, 0.05  # of a placed camera
_FARTHEST_KNOWN = 2  # in the order of the frames, of a known camera beside which another one is placed
_MOST_SIGMA, _MOST_SIGMA_DEG = 0.03, 1.0  # of a camera that is placed: share of the distance, degrees


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """The place that depth images give a camera, in the frame of the first one that they place."""

    name: str
    T_world_camera: Array  # (4, 4) metres
    sigma_m: float  # standard deviation in the direction in which the position is least known
    sigma_deg: float  # and about the axis about which the orientation is
    scale_sigma: float  # of the logarithm of all lengths alike: what the depth camera's calibration leaves open


def place_by_depth(frames: Sequence[Frame], pause: Callable[[], None] = lambda: None) -> tuple[PlacedCamera, ...]:
    """The cameras that depth images place together, in the order in which their frames were taken.

    Empty where fewer than two are placed, or surfaces contradict each other. Frames are without distortion; only those
    with depth and a lens that was told count. Neighbours in time look at the same place, from at most some tens of
    degrees apart. `pause` is called between steps and may raise.
    """
    clouds = _collect_clouds(frames)
    # Of frames that are farther from each other a corner may be taken for the next one, where rooms are alike
    aligned = []
    for target, cloud in itertools.pairwise(clouds):
        pause()
        aligned.append(choose_alignment(align_clouds(cloud, target), cloud, target))
    poses = _join(aligned)
    if len(poses) < 2:
        return ()
    placed = _place(clouds, poses, pause)
    return () if placed is None else _make_cameras(clouds, *placed)


def _collect_clouds(frames: Sequence[Frame]) -> list[DepthCloud]:
    """The clouds of frames, in the order in which these were taken; a depth image of another photograph gives none."""
    ordered = sorted(frames, key=lambda frame: (frame.stamp_ns, frame.frame_id, frame.name))
    clouds = [cloud for frame in ordered if (cloud := make_depth_cloud(frame)) is not None]
    if are_along_rays(clouds):
        log.warning("depth images are distances along the rays, not depths along the camera's axis, and are not used")
        return []
    exchanged = find_exchanged_depth(clouds)
    for k, other in exchanged.items():
        names = sanitize_text(clouds[k].name), sanitize_text(clouds[other].name)
        log.warning("the depth image of %s fits the photograph %s much better, and is not used", *names)
    return [cloud for k, cloud in enumerate(clouds) if k not in exchanged]


def place_beside(
    frames: Sequence[Frame], known: Mapping[str, Array], pause: Callable[[], None] = lambda: None
) -> tuple[PlacedCamera, ...]:
    """The cameras of frames of which `known`, T_world_camera (4, 4) in metres by name, tells none.

    Each is aligned with two known neighbours in time by itself, which must agree, and no known camera may contradict
    it. Empty where nothing can be placed, or the depth images contradict the known cameras. Frames are as those of
    `place_by_depth`.
    """
    clouds = _collect_clouds(frames)
    poses = {k: known[cloud.name] for k, cloud in enumerate(clouds) if cloud.name in known}
    anchors = sorted(poses)
    if len(anchors) < 2 or any(_is_contradicted(clouds, poses, i, anchors) for i in anchors):
        return ()
    for k in range(len(clouds)):
        pause()
        if k not in poses and (T := _place_between(clouds, {i: poses[i] for i in anchors}, k)) is not None:
            poses[k] = T
    for _ in range(_ROUNDS if len(poses) > len(anchors) else 0):
        pause()
        poses, _ = _adjust(clouds, poses, [*anchors, *(k for k in sorted(poses) if k not in anchors)], len(anchors))
    found = []
    for k in sorted(set(poses) - set(anchors)):
        pause()
        _, covariance = _adjust(clouds, poses, [*anchors, k], len(anchors))
        ((sigma_m, sigma_deg),) = _compute_sigmas(covariance[-6:, -6:])
        is_open = sigma_m > _MOST_SIGMA * np.median(clouds[k].points[:, 2]) or sigma_deg > _MOST_SIGMA_DEG
        if is_open or _is_contradicted(clouds, poses, k, anchors):
            continue
        sigma_m, sigma_deg = float(np.hypot(sigma_m, _LEAST_SIGMA_M)), float(np.hypot(sigma_deg, _LEAST_SIGMA_DEG))
        found.append(PlacedCamera(clouds[k].name, poses[k], sigma_m, sigma_deg, clouds[k].scale_sigma))
    return tuple(found)


def _place_between(clouds: Sequence[DepthCloud], known: Mapping[int, Array], k: int) -> Array | None:
    """The pose (4, 4) of cloud `k` by the two nearest known ones that it aligns with; None where they tell no one pose.

    One alignment is no proof: along a plain wall another one looks as good, and better where it overlaps more.
    """
    found: list[Array] = []
    for i in sorted(known, key=lambda i: (abs(i - k), i)):
        if abs(i - k) > _FARTHEST_KNOWN or len(found) == 2:
            break
        if (T := choose_alignment(align_clouds(clouds[k], clouds[i]), clouds[k], clouds[i])) is not None:
            found.append(known[i] @ T)
    if len(found) < 2:
        return None
    turn = Rotation.from_matrix(found[0][:3, :3].T @ found[1][:3, :3]).magnitude()
    apart = np.linalg.norm(found[0][:3, 3] - found[1][:3, 3])
    return found[0] if np.degrees(turn) < _SAME_DEG and apart < _SAME_M else None


def _is_contradicted(clouds: Sequence[DepthCloud], poses: Mapping[int, Array], k: int, others: Sequence[int]) -> bool:
    """Whether cloud `k` and one of the others contradict each other where they overlap."""
    for i in others:
        for one, other in ((k, i), (i, k)) if i != k else ():
            agreement = compute_agreement(clouds[one], clouds[other], invert_pose(poses[other]) @ poses[one])
            if agreement.overlap >= _LEAST_OVERLAP and agreement.is_contradicted:
                return True
    return False


def _join(aligned: Sequence[Array | None]) -> dict[int, Array]:
    """Poses of the longest run of clouds each of which is `aligned` with the next one, in the frame of its first."""
    best = poses = {0: np.eye(4)}
    for i, T in enumerate(aligned, 1):
        poses = {i: np.eye(4)} if T is None else {**poses, i: poses[i - 1] @ T}
        best = poses if len(poses) > len(best) else best
    return best


def _place(
    clouds: Sequence[DepthCloud], poses: Mapping[int, Array], pause: Callable[[], None]
) -> tuple[dict[int, Array], list[tuple[float, float]]] | None:
    """Poses of the cameras of which little is open, with sigmas, metres and degrees; None where clouds contradict."""
    views = _list_surest_first(clouds, poses)
    for _ in range(_ROUNDS):
        pause()
        poses, _ = _adjust(clouds, poses, views)
    # First beside the surest one, for all others are open beside one that is, then beside the first, as they are told
    for order in (list, sorted):
        pause()
        views = order(views)
        poses, sigmas, views = _leave_out_open(clouds, poses, views, pause)
        if len(views) < 2:
            return None
    if any(_is_contradicted(clouds, poses, i, views) for i in views):
        return None
    return {i: poses[i] for i in views}, sigmas


def _list_surest_first(clouds: Sequence[DepthCloud], poses: Mapping[int, Array]) -> list[int]:
    """Lists the numbers of the poses: first the one of whose least known direction the others tell most."""
    least = []
    for i in sorted(poses):
        found = [
            _compute_information(clouds[i], clouds[j], invert_pose(poses[j]) @ poses[i]).sure
            for j in sorted(poses)
            if abs(i - j) == 1
        ]
        least.append(float(np.linalg.eigvalsh(np.sum(found, axis=0))[0]) if found else 0.0)
    first = sorted(poses)[int(np.argmax(least))]
    return [first, *(i for i in sorted(poses) if i != first)]


def _leave_out_open(
    clouds: Sequence[DepthCloud], poses: Mapping[int, Array], views: list[int], pause: Callable[[], None]
) -> tuple[dict[int, Array], list[tuple[float, float]], list[int]]:
    """Poses, sigmas and numbers of the cameras of which little is open beside the first one, which stays."""
    while True:
        pause()
        moved, covariance = _adjust(clouds, poses, views)
        sigmas = _compute_sigmas(covariance)
        shares = [sigma / float(np.median(clouds[i].points[:, 2])) for i, (sigma, _) in zip(views, sigmas, strict=True)]
        worst = max(range(len(views)), key=lambda k: max(shares[k] / _MOST_SIGMA, sigmas[k][1] / _MOST_SIGMA_DEG))
        if len(views) < 2 or (shares[worst] <= _MOST_SIGMA and sigmas[worst][1] <= _MOST_SIGMA_DEG):
            return moved, sigmas, views
        views = [i for k, i in enumerate(views) if k != worst]


def _make_cameras(
    clouds: Sequence[DepthCloud], poses: Mapping[int, Array], sigmas: Sequence[tuple[float, float]]
) -> tuple[PlacedCamera, ...]:
    first, found = invert_pose(poses[min(poses)]), []
    for (sigma_m, sigma_deg), i in zip(sigmas, sorted(poses), strict=True):
        T, scale_sigma = first @ poses[i], clouds[i].scale_sigma
        sigma_m = float(np.linalg.norm([sigma_m, _LEAST_SIGMA_M, scale_sigma * np.linalg.norm(T[:3, 3])]))
        found.append(
            PlacedCamera(clouds[i].name, T, sigma_m, float(np.hypot(sigma_deg, _LEAST_SIGMA_DEG)), scale_sigma)
        )
    return tuple(found)


def _adjust(
    clouds: Sequence[DepthCloud], poses: Mapping[int, Array], views: Sequence[int], held: int = 1
) -> tuple[dict[int, Array], Array]:
    """One Gauss-Newton step of all poses but those `held` first, and their (6 V, 6 V) covariance: turns, centres."""
    count = len(views)
    A, sure, b = np.zeros((6 * count,) * 2), np.zeros((6 * count,) * 2), np.zeros(6 * count)
    for k, i in enumerate(views):
        for m, j in enumerate(views):
            T_ji = invert_pose(poses[j]) @ poses[i]
            if (
                i == j
                or max(k, m) < held
                or not (found := _compute_information(clouds[i], clouds[j], T_ji)).matrix.any()
            ):
                continue
            # A turn and a shift of the world that move camera i do so in the frame of camera j, and the other way round
            to_j, own, his = _adjoint(invert_pose(poses[j])), slice(6 * k, 6 * k + 6), slice(6 * m, 6 * m + 6)
            for matrix, known in ((A, found.matrix), (sure, found.sure)):
                world = to_j.T @ known @ to_j
                matrix[own, own] += world
                matrix[his, his] += world
                matrix[own, his] -= world
                matrix[his, own] -= world
            b[own] -= to_j.T @ found.gradient
            b[his] += to_j.T @ found.gradient
    free = slice(6 * held, 6 * count)
    least = np.diag(np.tile(np.repeat([_OPEN_RAD**-2, _OPEN_M**-2], 3), count - held))
    step, covariance = np.zeros_like(b), np.zeros_like(A)
    step[free] = np.linalg.solve(A[free, free] + least, b[free])
    covariance[free, free] = np.linalg.inv(sure[free, free] + least)
    moved, by_centre = dict(poses), np.eye(6 * count)
    for k, i in enumerate(views):
        turn, T = Rotation.from_rotvec(step[6 * k : 6 * k + 3]).as_matrix(), poses[i].copy()
        T[:3, :3], T[:3, 3] = turn @ T[:3, :3], turn @ T[:3, 3] + step[6 * k + 3 : 6 * k + 6]
        moved[i] = T
        by_centre[6 * k + 3 : 6 * k + 6, 6 * k : 6 * k + 3] = -cross_matrix(T[None, :3, 3])[0]
    return moved, by_centre @ covariance @ by_centre.T


def _adjoint(T: Array) -> Array:
    """(6, 6) that takes a turn and a shift of the world to those of the frame that `T` leads to."""
    found = np.zeros((6, 6))
    found[:3, :3] = found[3:, 3:] = T[:3, :3]
    found[3:, :3] = cross_matrix(T[None, :3, 3])[0] @ T[:3, :3]
    return found


def _compute_sigmas(covariance: Array) -> list[tuple[float, float]]:
    """Standard deviations of each centre, metres, and orientation, degrees, in the direction that is least known."""
    blocks = [(slice(k + 3, k + 6), slice(k, k + 3)) for k in range(0, len(covariance), 6)]
    roots = [[float(np.sqrt(max(np.linalg.eigvalsh(covariance[b, b])[-1], 0.0))) for b in both] for both in blocks]
    return [(centre, float(np.degrees(turn))) for centre, turn in roots]
