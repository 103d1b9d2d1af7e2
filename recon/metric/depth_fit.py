"""How depth images go with what the images themselves tell: the unit that they give, and what speaks against them.

Points that several images see have a depth in the scene's unit; a depth image has one in metres at the same pixel.
Their ratio is the unit. Where the depth image lies beside the image that it is told to be aligned with, ratios agree
better at another pixel: the images test it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage, describe_doubtful_unit
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lenses import project, unproject
from splatnode.capture.process.text import sanitize_name
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.snapshot import DepthCheck, DepthCode
from splatnode.recon.threads import map_parallel

# Depth images without their noise where they show planes: what many neighbours measured together is known better.

Map = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

RADII = (8, 4, 2)  # of the windows in which a plane is looked for, pixels of 640 across, the largest first
PLANE_SIGMAS = 1.5  # rms distance from a plane, over the noise
_OUTLIER_SIGMAS = 3.0  # of a pixel from the plane of its neighbours
LEAST_WINDOW = 0.35  # share of a window's pixels that have a depth
PIXELS_AS_ONE = 25.0  # neighbours are wrong alike: stereo compares windows


def smooth_depth(depth: DepthImage) -> tuple[Map, Map]:
    """(H, W) z and its standard deviation, metres: of the plane of the neighbours where there is one, else as it is.

    The nearness 1 / z of a plane is linear in the image. The largest window that is a plane within the noise counts.
    Pixels that are far from the plane of their neighbours are left out.
    """
    z = depth.metres.astype(np.float64)
    nearness, noise, known = compute_nearness(depth, z)
    best, sigma, open_yet = nearness.copy(), noise.copy(), known.copy()
    for radius in RADII:
        side = 2 * max(1, round(radius * max(z.shape) / 640)) + 1
        planes = fit_planes(nearness, known, side)
        value, rms, count = planes.value, planes.rms, planes.count
        plane = (count >= LEAST_WINDOW * side**2) & (rms < PLANE_SIGMAS * noise) & open_yet & (value > 0)
        outlier = plane & (np.abs(nearness - value) > _OUTLIER_SIGMAS * noise)
        best[plane], best[outlier] = value[plane], 0.0
        sigma[plane] = noise[plane] / np.sqrt(np.maximum(count[plane] / PIXELS_AS_ONE, 1.0))
        open_yet &= ~plane
    smooth = np.where(best > 0, 1.0 / np.maximum(best, 1e-9), 0.0)
    return smooth, sigma * smooth**2


@dataclass(frozen=True, eq=False)
class Planes:
    """The plane of the known values around each pixel, (H, W) each."""

    value: Map  # of the plane, at the pixel
    slope_x: Map  # a pixel across
    slope_y: Map  # and down
    rms: Map  # distance of the values from it; infinite where there are too few
    count: Map  # of known values


def fit_planes(values: Map, known: Mask, side: int) -> Planes:
    """Fits a plane to the known values in the window of `side` pixels around each pixel, by least squares."""
    height, width = values.shape
    x, y = np.meshgrid(np.arange(width) - width / 2.0, np.arange(height) - height / 2.0)
    weight = known.astype(np.float64)

    def total(each: Map) -> Map:
        window, kind = (side, side), cv2.CV_64F
        summed = cv2.boxFilter(each * weight, kind, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, np.float64)

    count = total(np.ones_like(values))
    many = np.maximum(count, 1.0)
    mean_x, mean_y, mean = total(x) / many, total(y) / many, total(values) / many
    xx, xy, yy = total(x * x) / many - mean_x**2, total(x * y) / many - mean_x * mean_y, total(y * y) / many - mean_y**2
    xv, yv = total(x * values) / many - mean_x * mean, total(y * values) / many - mean_y * mean
    vv = total(values**2) / many - mean**2
    determinant = xx * yy - xy**2
    sound = determinant > 1e-3
    safe = np.where(sound, determinant, 1.0)
    slope_x, slope_y = (yy * xv - xy * yv) / safe, (xx * yv - xy * xv) / safe
    value = mean + slope_x * (x - mean_x) + slope_y * (y - mean_y)
    rms = np.sqrt(np.maximum(vv - slope_x * xv - slope_y * yv, 0.0))
    return Planes(value, slope_x, slope_y, np.where(sound, rms, np.inf), count)


def compute_nearness(depth: DepthImage, z: Map) -> tuple[Map, Map, Mask]:
    """1 / z, its noise, both 0 where unknown, and where it is known."""
    known = z > 0
    nearness = np.where(known, 1.0 / np.maximum(z, 1e-9), 0.0)
    noise = np.where(known, depth.noise.compute_sigma(z) * nearness**2, 0.0)
    if depth.confidence is not None:  # what is half believed is twice as unsure
        noise *= 255.0 / np.maximum(depth.confidence, 1)
    return nearness, noise, known


# How depth images go with what the images themselves tell: the unit that they give, and what speaks against them.

Array = npt.NDArray[np.float64]

REFERENCE_PX = 640.0  # longer side of a depth image in whose pixels shifts count
LEAST_POINTS = 30  # with a depth, of all images of a camera together
_MOST_POINTS = 20_000  # that are compared; of more, an even choice
_POINTS_AS_ONE = 10.0  # neighbours are wrong alike
_CELL_PX = 17.0  # pixels at REFERENCE_PX within which they share their errors
_POINT_SIGMA = 0.005  # of a triangulated point's depth, as a share
_ROUNDS, _HUBER, _CUT = 10, 1.5, 3.0  # of the robust mean; standard deviations
_SEARCH_PX, _STEP_PX = 10, 1  # of the shift that is looked for, pixels at REFERENCE_PX
_LEAST_SHIFT_PX = 2.0  # pixels at REFERENCE_PX: what edges of depth are off by without anybody's fault
_LEAST_GAIN = 4.0  # standard deviations by which depths fit better at another pixel, where the shift is named
_LEAST_SHARE = 0.7  # of the points that have a depth somewhere: a shift must keep so many
_LEAST_AGREEING = 0.5  # share of the points whose depths agree: of fewer, the depth camera saw something else
_AGREEING_SIGMAS = 4.0
# Noise is in all images, and all over them, alike. Where few points of a part of an image agree with all others, and
# most of these with each other, or few of an image where most of other images do, something else was seen, or from
# elsewhere. That may be so of some of the points
_LEAST_PART, _FEW, _ALIKE = 15, 0.3, 0.6
_FEW_OF_IMAGE, _MOST_OF_OTHERS = 0.5, 0.8
_MOST_CONTRADICTING = 0.25
# A depth image whose unit is off from that of most others by so much of its logarithm, and by so many standard
# deviations, is none of them. Cameras that are a little wrong change units of single images by some hundredths
_LEAST_OFF, _OFF_SIGMAS = 0.04, 4.5
_MOST_NOISE = 0.12  # of a depth, in the median, that is told: beyond, nothing that is measured could contradict it
# Times the logarithm of the ray's length over its z, that depths are off by where they are distances along the ray: 1
_ALONG_RAY = 0.6, 1.4
# How much of its logarithm a depth may be off by where cameras are rough: a focal length that nothing tells bends the
# scene. Beyond, it is not the cameras: disparity in place of depth has 2
_MOST_BENDING = 0.15


@dataclass(frozen=True, eq=False)
class DepthView:
    """An image with its depth image, and the scene's points that it shows."""

    name: str
    camera_id: str
    points: Array  # (M, 3) in the camera's frame, the scene's unit
    depth: DepthImage
    lens: Intrinsics  # of the camera's image; at any size

    @cached_property
    def surface(self) -> tuple[Array, Array]:
        """(H, W) z of the depth image without its noise, and its standard deviation, metres."""
        return smooth_depth(self.depth)


def has_too_few_points(check: DepthCheck) -> bool:
    """Whether depth images are untested because nothing was compared, and not because the cameras are rough."""
    return check.code is DepthCode.UNTESTED and check.num_points < LEAST_POINTS


@dataclass(frozen=True, eq=False)
class DepthFit:
    """The depth images of one camera, as the scene's points judge them."""

    camera_id: str
    names: tuple[str, ...]  # of its images
    metres_per_unit: float
    sigma: float  # standard deviation of its logarithm, without what all images know of the scene together
    check: DepthCheck

    @property
    def is_usable(self) -> bool:
        """Whether its depths may count: they were compared with the images, and nothing speaks against them."""
        return self.check.code is DepthCode.FITS


@dataclass(frozen=True, eq=False)
class _Samples:
    """The points of all views of one camera, in the frames of their depth cameras, and where they look for a depth."""

    maps: list[tuple[Array, Array]]  # (H, W) z and its standard deviation, metres, of each view
    view_of: npt.NDArray[np.int64]  # (M,)
    pixels: Array  # (M, 2) of the depth image
    log_z: Array  # (M,) logarithm of the depth that the scene tells, metres
    log_ray: Array  # (M,) logarithm of its distance over its depth
    unit: float  # metres, of the scene's unit, by which it is that

    def look(self, shift: tuple[float, float], scale: float) -> tuple[Array, Array]:
        """(M,) logarithms of measured over told depth, `shift` pixels aside, and their sigmas; NaN where none is.

        `scale` is pixels of the depth image for one at REFERENCE_PX.
        """
        ratio, sigma = np.full(len(self.log_z), np.nan), np.full(len(self.log_z), np.nan)
        for number, (depth, noise) in enumerate(self.maps):
            own = np.flatnonzero(self.view_of == number)
            column, row = np.floor(self.pixels[own] + scale * np.array(shift)).astype(np.int64).T
            inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
            own, column, row = own[inside], column[inside], row[inside]
            known = depth[row, column] > 0
            own, z, its_sigma = own[known], depth[row, column][known], noise[row, column][known]
            ratio[own] = np.log(z) - self.log_z[own]
            sigma[own] = np.hypot(its_sigma / z, _POINT_SIGMA)
        return ratio, sigma

    def count_cells(self, scale: float) -> int:
        """How many places of all images have a depth and points: those of a place are one, since they share its error.

        A place is as large as the window that depths were smoothed in.
        """
        ratio, _ = self.look((0.0, 0.0), scale)
        known = np.isfinite(ratio)
        cells = np.floor(self.pixels[known] / (_CELL_PX * scale)).astype(np.int64)
        return len(np.unique(np.column_stack([self.view_of[known], cells]), axis=0))


def fit_depth_images(views: Sequence[DepthView]) -> tuple[DepthFit, ...]:
    """A fit for the depth images of each camera, in the order of their ids.

    A few that contradict most others of their camera are left out of it: its `names` lack them, its check names them.
    """
    cameras: dict[str, list[DepthView]] = {}
    for view in views:
        cameras.setdefault(view.camera_id, []).append(view)
    return tuple(_fit_camera(name, cameras[name]) for name in sorted(cameras))


def merge_lens(focal: float, radial: Array, shift: Array, depth: DepthImage) -> Intrinsics:
    """The lens of a camera at the size of its aligned depth image; lengths count over the longer side."""
    height, width = depth.values.shape
    side = max(width, height)
    cx, cy = (float(size / 2.0 + side * off) for size, off in zip((width, height), shift, strict=True))
    terms = (*map(float, radial), 0.0, 0.0) if np.any(radial) else ()
    return Intrinsics(width, height, focal * side, focal * side, cx, cy, "estimated", terms)


def find_depth_lens(depth: DepthImage, lens: Intrinsics) -> Intrinsics:
    """The lens of a depth image in its own pixels; `lens` is of the camera's image, which an aligned one has."""
    height, width = depth.values.shape
    return (depth.intrinsics or lens).resized(width, height)


def _fit_camera(camera_id: str, views: Sequence[DepthView]) -> DepthFit:
    map_parallel(lambda view: view.surface, views)
    samples, scale = _collect_common_samples(views)
    odd = _find_odd_images(samples, scale)
    if not odd:
        return _fit_samples(camera_id, views, samples, scale)
    which = ", ".join(f"{sanitize_name(views[number].name)} ({why})" for number, why in odd.items())
    if 2 * len(odd) >= len(views):
        return _explain_no_common_unit(camera_id, views, which, samples, scale)
    kept = [view for number, view in enumerate(views) if number not in odd]
    fit = _fit_samples(camera_id, kept, *_collect_common_samples(kept))
    return replace(fit, check=replace(fit.check, message=f"{fit.check.message}; left out: {which}"))


def _fit_samples(camera_id: str, views: Sequence[DepthView], samples: _Samples, scale: float) -> DepthFit:
    """The fit of depth images that are all used, or none of them."""
    names = tuple(view.name for view in views)
    ratio, sigma = samples.look((0.0, 0.0), scale)
    known = np.isfinite(ratio)
    if known.sum() < LEAST_POINTS:
        return _explain_few(views, int(known.sum()))
    count, camera_noise = int(known.sum()), float(np.median(_compute_camera_noise(views, samples)[known]))
    if camera_noise > _MOST_NOISE:
        return _explain_noise(camera_id, names, count, camera_noise)
    if _is_along_ray(samples, scale):
        return _explain_rays(camera_id, names, count)
    mean, mean_sigma = _average(ratio[known], sigma[known])
    agreeing = float((np.abs(ratio[known] - mean) < _AGREEING_SIGMAS * sigma[known]).mean())
    shift, gain = _find_shift(samples, scale)
    check = _judge(camera_id, len(names), count, agreeing, shift, gain)
    parted = _test_parts(check, names, samples, ratio - mean, sigma)
    if parted.code is not DepthCode.FITS:
        bending, left = _find_bending(samples, scale)
        if bending and (check.code is not DepthCode.FITS or _test_parts(check, names, samples, left, sigma) == check):
            return _blame_cameras(check, names, bending)
    noise = max(view.depth.noise.scale_sigma for view in views)
    unit = samples.unit * float(np.exp(mean))
    return DepthFit(camera_id, names, unit, float(np.hypot(mean_sigma, noise)), parted)


def _compute_camera_noise(views: Sequence[DepthView], samples: _Samples) -> Array:
    """(M,) the standard deviation of each depth by its camera's noise, as a share of the depth that the scene tells."""
    z = np.exp(samples.log_z)
    noises = np.stack([view.depth.noise.compute_sigma(z) for view in views])
    return noises[samples.view_of, np.arange(len(z))] / z


def _explain_noise(camera_id: str, names: tuple[str, ...], count: int, noise: float) -> DepthFit:
    """The fit of depth images that by their own noise tell next to nothing."""
    message = (
        f"{name_depth_images(len(names), camera_id)} were left out: by their noise a depth is known to "
        f"{100 * noise:.0f} % only, so that the images can test none. Check their unit, or tell their noise"
    )
    return _leave_out(DepthCode.UNTESTED, message, camera_id, names, count)


def _leave_out(code: DepthCode, message: str, camera_id: str, names: tuple[str, ...], num_points: int) -> DepthFit:
    """The fit of depth images that count for nothing, for the reason that the message tells."""
    return DepthFit(camera_id, names, 1.0, float("inf"), DepthCheck(code, message, camera_id, num_points))


def _is_along_ray(samples: _Samples, scale: float) -> bool:
    """Whether the points show that depths are distances along the ray instead of z: so simulators have them."""
    ratio, sigma = samples.look((0.0, 0.0), scale)
    known = np.isfinite(ratio)
    factors = np.column_stack([np.ones(int(known.sum())), samples.log_ray[known]])
    along = float(_fit_robustly(factors, ratio[known], sigma[known])[1])
    if not _ALONG_RAY[0] <= along <= _ALONG_RAY[1]:
        return False
    turned = replace(samples, log_z=samples.log_z + samples.log_ray)
    better = _compute_costs(samples, (0.0, 0.0), scale) - _compute_costs(turned, (0.0, 0.0), scale)
    return _compute_gain(better, samples, scale) > _LEAST_GAIN


def _explain_rays(camera_id: str, names: tuple[str, ...], count: int) -> DepthFit:
    """The fit of depth images that hold distances along the ray."""
    message = (
        f"{name_depth_images(len(names), camera_id)} are distances along the rays, not depths along the camera's "
        "axis, so they were left out. Divide each by the length of its ray at depth 1"
    )
    return _leave_out(DepthCode.CONTRADICTS, message, camera_id, names, count)


def _fit_robustly(factors: Array, values: Array, sigmas: Array) -> Array:
    """(N,) the coefficients of the columns of `factors` (M, N) that fit `values` (M,), by Huber's weights."""
    found, weights = np.zeros(factors.shape[1]), np.ones(len(factors))
    for _ in range(_ROUNDS):
        weighted = factors * (weights / sigmas**2)[:, None]
        found = np.linalg.lstsq(factors.T @ weighted, weighted.T @ values, rcond=None)[0]
        off = np.abs(values - factors @ found) / sigmas
        weights = np.where(off > _CUT, 0.0, np.clip(_HUBER / np.maximum(off, 1e-12), 0.0, 1.0))
    return found


def _collect_common_samples(views: Sequence[DepthView]) -> tuple[_Samples, float]:
    """The samples in the unit that their median tells, and pixels of the depth image for one at REFERENCE_PX."""
    step = max(1, -(-sum(len(view.points) for view in views) // _MOST_POINTS))
    scale = max(max(view.depth.values.shape) for view in views) / REFERENCE_PX
    aside = any(view.depth.T_camera_depth[3::4][:3] != (0.0, 0.0, 0.0) for view in views)
    samples = _collect_samples(views, 1.0, step)
    for _ in range(4 if aside else 1):  # where a depth camera stands beside, its pixels depend on the unit
        ratio, _ = samples.look((0.0, 0.0), scale)
        if np.isfinite(ratio).sum() >= LEAST_POINTS:
            samples = _collect_samples(views, samples.unit * float(np.exp(np.nanmedian(ratio))), step)
    return samples, scale


def _find_odd_images(samples: _Samples, scale: float) -> dict[int, str]:
    """The numbers of the views that contradict most others, and each time why; empty where no majority agrees.

    Such a view measures all depths larger or smaller than the others do, or shows something else.
    """
    ratio, sigma = samples.look((0.0, 0.0), scale)
    known = np.isfinite(ratio)
    numbers = [i for i in range(len(samples.maps)) if (known & (samples.view_of == i)).sum() >= _LEAST_PART]
    if len(numbers) < 2:
        return {}
    parts = [known & (samples.view_of == number) for number in numbers]
    averages = np.array([_average(ratio[part], sigma[part]) for part in parts])
    apart = np.abs(averages[:, None, 0] - averages[None, :, 0])
    alike = apart <= np.maximum(_LEAST_OFF, _OFF_SIGMAS * np.hypot(averages[:, None, 1], averages[None, :, 1]))
    most = int(np.argmax(alike.sum(1)))
    common = float(np.median(averages[alike[most], 0]))
    own = [
        float((np.abs(ratio[part] - mean) < _AGREEING_SIGMAS * sigma[part]).mean())
        for part, (mean, _) in zip(parts, averages, strict=True)
    ]
    if float(np.median(np.array(own)[alike[most]])) <= _MOST_OF_OTHERS:
        return {}
    found = {}
    for number, mean, share, is_alike in zip(numbers, averages[:, 0], own, alike[most], strict=True):
        off = float(np.expm1(mean - common))
        if share < _FEW_OF_IMAGE:
            found[number] = f"contradicts its photograph at {100 * (1 - share):.0f} % of the points"
        elif not is_alike:
            found[number] = f"its depths are {100 * abs(off):.0f} % {'larger' if off > 0 else 'smaller'} than others"
    return found


def _explain_no_common_unit(
    camera_id: str, views: Sequence[DepthView], which: str, samples: _Samples, scale: float
) -> DepthFit:
    """The fit of depth images of which no majority has one unit."""
    names, count = tuple(view.name for view in views), int(np.isfinite(samples.look((0.0, 0.0), scale)[0]).sum())
    message = (
        f"{name_depth_images(len(names), camera_id)} were left out: they have no common unit: {which}. Check "
        "that each depth image goes with its photograph, and that all have the same unit"
    )
    return _leave_out(DepthCode.UNTESTED, message, camera_id, names, count)


def _test_parts(check: DepthCheck, names: Sequence[str], samples: _Samples, off: Array, sigma: Array) -> DepthCheck:
    """The check; untested if it fits and a part of the points contradicts the rest, instead of being noisy as all are.

    `off` (M,) are the logarithms by which measured depths are too large, NaN where there is none.
    """
    if check.code is not DepthCode.FITS:
        return check
    known = np.isfinite(off)
    agrees = known & (np.abs(off) < _AGREEING_SIGMAS * sigma)
    middle = np.array([[depth.shape[1], depth.shape[0]] for depth, _ in samples.maps])[samples.view_of] / 2.0
    quarter = (samples.pixels > middle) @ np.array([1, 2])
    images = [known & (samples.view_of == number) for number in range(len(samples.maps))]
    contradicts = np.zeros(len(off), bool)
    for image in images:
        for part in (image & (quarter == place) for place in range(4)):
            if part.sum() >= _LEAST_PART and agrees[part].mean() < _FEW:
                alike = np.abs(off[part] - np.median(off[part])) < _AGREEING_SIGMAS * sigma[part]
                contradicts |= part & (alike.mean() >= _ALIKE)
    if contradicts.sum() <= _MOST_CONTRADICTING * known.sum():
        return check
    where = [name for name, image in zip(names, images, strict=True) if 2 * (contradicts & image).sum() > image.sum()]
    which = f", those of {', '.join(map(sanitize_name, where))}" if where else ""
    share = f"{100 * contradicts.sum() / known.sum():.0f} % of {check.num_points} points of the images"
    message = (
        f"{name_depth_images(len(names), check.camera_id)} were left out: {share} contradict them where the others "
        f"fit{which}. Check that each depth image goes with its photograph; or the estimated cameras of these are wrong"
    )
    return replace(check, code=DepthCode.UNTESTED, message=message)


def _find_bending(samples: _Samples, scale: float) -> tuple[float, Array]:
    """Finds by how much of its logarithm a depth is off, if depth images fit but for that; 0 where they do not.

    Beside it the logarithms (M,) by which measured depths are too large then, NaN where there is none. A wrong
    focal length has far things too near, or too far, for all images alike.
    """
    ratio, sigma = samples.look((0.0, 0.0), scale)
    known = np.isfinite(ratio)
    log_z = samples.log_z - float(np.median(samples.log_z[known]))
    factors = np.column_stack([np.ones(int(known.sum())), log_z[known]])
    found = _fit_robustly(factors, ratio[known], sigma[known])
    off = np.abs(ratio[known] - factors @ found) / sigma[known]
    bending = float(found[1])
    if (off > _CUT).all() or abs(bending) > _MOST_BENDING:
        return 0.0, ratio
    straight = replace(samples, log_z=samples.log_z + bending * log_z)
    shift, gain = _find_shift(straight, scale)
    agreeing = float((off < _AGREEING_SIGMAS).mean())
    fits = agreeing >= _LEAST_AGREEING and (gain <= _LEAST_GAIN or float(np.hypot(*shift)) < _LEAST_SHIFT_PX)
    left = np.full(len(ratio), np.nan)
    left[known] = ratio[known] - factors @ found
    return (bending if fits else 0.0), left


def _blame_cameras(check: DepthCheck, names: tuple[str, ...], bending: float) -> DepthFit:
    """The fit of depth images that the cameras, which are rough, cannot be compared with."""
    who = name_depth_images(len(names), check.camera_id)
    message = (
        f"{who} were left out: they fit the images only if the estimated cameras, not the depths, have things twice as "
        f"far {100 * abs(np.expm1(-bending * np.log(2.0))):.0f} % too {'far' if bending < 0 else 'near'}, as a wrong "
        "focal length makes it. Give the lens (--intrinsics FILE; Python: intrinsics=)"
    )
    return _leave_out(DepthCode.UNTESTED, message, check.camera_id, names, check.num_points)


def _collect_samples(views: Sequence[DepthView], unit: float, step: int) -> _Samples:
    """Every `step`-th point of each view."""
    view_of, pixels, log_z, log_ray = [], [], [], []
    for number, view in enumerate(views):
        T_depth_camera = np.linalg.inv(view.depth.matrix)
        points = unit * view.points[::step] @ T_depth_camera[:3, :3].T + T_depth_camera[:3, 3]
        points = points[points[:, 2] > 0]
        seen = project(points, find_depth_lens(view.depth, view.lens)) if len(points) else np.zeros((0, 2))
        kept = np.isfinite(seen).all(1) & (np.abs(seen) < 1e6).all(1)
        view_of.append(np.full(int(kept.sum()), number))
        pixels.append(seen[kept])
        log_z.append(np.log(points[kept, 2]))
        log_ray.append(np.log(np.linalg.norm(points[kept], axis=1)) - log_z[-1])
    surfaces = [view.surface for view in views]
    joined = np.concatenate(view_of), np.concatenate(pixels), np.concatenate(log_z), np.concatenate(log_ray)
    return _Samples(surfaces, *joined, unit)


def _average(values: Array, sigmas: Array) -> tuple[float, float]:
    """The robust mean (Huber's weights), and its standard deviation: of the scatter, or of the sigmas if larger."""
    mean, spread, weights = float(np.median(values)), 1.0, sigmas**-2.0
    for _ in range(_ROUNDS):
        off = np.abs(values - mean) / sigmas
        spread = max(1.0, 1.48 * float(np.median(off)))
        weights = np.clip(_HUBER * spread / np.maximum(off, 1e-12), 0.0, 1.0) / sigmas**2
        weights[off > _CUT * spread] = 0.0
        mean = float((weights * values).sum() / weights.sum())
    return mean, float(spread * np.sqrt(_POINTS_AS_ONE / max(weights.sum(), 1e-12)))


def _find_shift(samples: _Samples, scale: float) -> tuple[tuple[float, float], float]:
    """The shift, pixels at REFERENCE_PX, that fits the points best, and by how many standard deviations it fits better.

    Depths at another pixel have other errors, so that the best of many shifts is a little better by chance. How sure
    the difference is, the points themselves tell by their scatter.
    """
    steps = np.arange(-_SEARCH_PX, _SEARCH_PX + 1, _STEP_PX)
    here = _compute_costs(samples, (0.0, 0.0), scale)
    best, best_cost, most = (0.0, 0.0), float(np.nanmean(here)), int(np.isfinite(here).sum())
    for down in steps:
        for across in steps:
            costs = _compute_costs(samples, (float(across), float(down)), scale)
            if np.isfinite(costs).sum() >= max(LEAST_POINTS, _LEAST_SHARE * most) and np.nanmean(costs) < best_cost:
                best, best_cost = (float(across), float(down)), float(np.nanmean(costs))
    return best, _compute_gain(here - _compute_costs(samples, best, scale), samples, scale)


def _compute_gain(better: Array, samples: _Samples, scale: float) -> float:
    """Computes how many standard deviations costs are lower in the mean, by `better` (M,); NaN: not compared."""
    better = better[np.isfinite(better)]
    spread = float(better.std()) / np.sqrt(max(samples.count_cells(scale), 1)) if len(better) else 0.0
    return float(better.mean()) / spread if spread > 0 else 0.0


def _compute_costs(samples: _Samples, shift: tuple[float, float], scale: float) -> Array:
    """(M,) the squared deviations of each point, at most those of _CUT sigmas; NaN where it has no depth."""
    ratio, sigma = samples.look(shift, scale)
    known = np.isfinite(ratio)
    if not known.any():
        return ratio
    return np.minimum(((ratio - np.median(ratio[known])) / sigma) ** 2, _CUT**2)


def name_depth_images(count: int, camera_id: str) -> str:
    """Names so many depth images of one camera in a message; without an id there is one camera."""
    return f"depth images of {count} photographs" + (f" of {camera_id}" if camera_id else "")


def _judge(
    camera_id: str, num_images: int, num_points: int, agreeing: float, shift: tuple[float, float], gain: float
) -> DepthCheck:
    who = name_depth_images(num_images, camera_id)
    size = float(np.hypot(*shift))
    made = DepthCheck(DepthCode.FITS, f"{who} fit {num_points} points of the images", camera_id, num_points)
    if gain > _LEAST_GAIN and size >= _LEAST_SHIFT_PX:
        is_least = max(map(abs, shift)) >= _SEARCH_PX  # where the search ends
        best = f"{shift[0]:+.0f} pixels across and {shift[1]:+.0f} down"
        where = f"by at least {_SEARCH_PX} pixels, where the search ends ({best}" if is_least else f"{best} ("
        also = ". Disparity in place of depth, or a wrong lens, looks the same: check these, too" if is_least else ""
        return replace(
            made,
            code=DepthCode.SHIFTED,
            shift_px=shift,
            shift_is_least=is_least,
            message=f"{who} are not aligned with the images: they fit best {where}{', ' if is_least else ''}of "
            f"{REFERENCE_PX:.0f} across), so they were left out. Align depth to colour, or give the depth camera's "
            f"intrinsics and T_camera_depth{also}",
        )
    if agreeing < _LEAST_AGREEING:
        return replace(
            made,
            code=DepthCode.CONTRADICTS,
            message=f"{who} contradict the images at {100 * (1 - agreeing):.0f} % of {num_points} points, so they were "
            "left out. Check that each goes with its photograph, that it is depth and no disparity, its unit and its "
            "noise",
        )
    return made


def _explain_few(views: Sequence[DepthView], count: int) -> DepthFit:
    camera_id, names = views[0].camera_id, tuple(view.name for view in views)
    doubts = (doubt for view in views if (doubt := describe_doubtful_unit(view.depth)))
    who = name_depth_images(len(names), camera_id)
    message = f"{who} have a depth at {count} points of the images; {LEAST_POINTS} are needed to use them"
    if (doubt := next(doubts, None)) is not None:
        message += f": {doubt}"
    return _leave_out(DepthCode.UNTESTED, message, camera_id, names, count)


def describe_doubtful_units(frames: Iterable[Frame | DroppedFrame]) -> str:
    """Describes what speaks against the units of depth images, by the first that it is about; empty: nothing does."""
    depths = {each.name: each.depth for each in frames if isinstance(each, Frame) and each.depth is not None}
    doubts = {name: doubt for name, depth in depths.items() if (doubt := describe_doubtful_unit(depth))}
    if not doubts:
        return ""
    name, doubt = next(iter(doubts.items()))
    return f"the depth image of {sanitize_name(name)}: {doubt} ({len(doubts)} of {len(depths)} depth images)"


# Depth images as the camera of their photograph sees them.

_JUMP = 0.03  # relative step of depth across which nothing is interpolated


@dataclass(frozen=True, eq=False)
class MeasuredDepth:
    """z and its standard deviation at each pixel of an image, metres or the scene's unit; 0 where none was measured."""

    z: Map  # (h, w)
    sigma: Map  # (h, w)


def make_depth_views(graph: ViewGraph, registration: Registration) -> list[DepthView]:
    """The depth images of all registered cameras that have one, in the order of these."""
    cameras = [(graph.keyframes[camera.index], camera) for camera in registration.cameras]
    return [make_depth_view(key, registration, camera) for key, camera in cameras if key.frame.depth is not None]


def make_depth_view(keyframe: Keyframe, registration: Registration, camera: RegisteredCamera) -> DepthView:
    """The keyframe's depth image, with the registered points that its camera observes."""
    frame = keyframe.frame
    if frame.depth is None:
        raise ValueError(f"{keyframe.name} has no depth image")
    mine = registration.observed_point[registration.observed_by == camera.index]
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    points = registration.points[mine] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    (fx, fy), (cx, cy) = camera.focals.tolist(), camera.principal.tolist()
    terms = (*camera.radial.tolist(), 0.0, 0.0) if camera.radial.any() else ()
    lens = Intrinsics(frame.width, frame.height, fx, fy, cx, cy, "estimated", terms, skew=camera.skew)
    return DepthView(keyframe.name, frame.camera_id, points, frame.depth, lens)


def warp_depth(
    view: DepthView, K: Map, shape: tuple[int, int], surface: tuple[Map, Map] | None = None
) -> MeasuredDepth:
    """The depth image, or the `surface` that was made of it, as the pinhole K (3, 3) of its camera sees it.

    `shape` is (h, w).
    """
    z, sigma = surface or view.surface
    own = find_depth_lens(view.depth, view.lens)
    T_camera_depth = view.depth.matrix
    height, width = shape
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1], np.ones_like(across)], -1)
    if np.array_equal(T_camera_depth, np.eye(4)):
        pixels = project(rays.reshape(-1, 3).astype(np.float64), own).reshape(height, width, 2)
        return MeasuredDepth(*_sample(z, sigma, pixels))
    return _splat(z, sigma, own, T_camera_depth, K, shape)


def _sample(z: Map, sigma: Map, pixels: Map) -> tuple[Map, Map]:
    """z and sigma at pixels (h, w, 2): between its neighbours where these are one surface, else of the nearest."""
    columns, rows = np.moveaxis(np.nan_to_num(pixels - 0.5, nan=-9.0), -1, 0).astype(np.float32)
    near = [
        np.asarray(cv2.remap(each.astype(np.float32), columns, rows, cv2.INTER_NEAREST), np.float64)
        for each in (z, sigma)
    ]
    nearness = np.where(z > 0, 1.0 / np.maximum(z, 1e-9), 0.0).astype(np.float32)
    between = cv2.remap(nearness, columns, rows, cv2.INTER_LINEAR).astype(np.float64)
    fine = np.where(between > 0, 1.0 / np.maximum(between, 1e-9), 0.0)
    smooth = (near[0] > 0) & (np.abs(fine - near[0]) < _JUMP * near[0])
    return np.where(smooth, fine, near[0]), near[1]


def _splat(z: Map, sigma: Map, own: Intrinsics, T_camera_depth: Map, K: Map, shape: tuple[int, int]) -> MeasuredDepth:
    """Each measured point where the camera sees it, the nearest first; on a grid so coarse that it has no gaps."""
    rows, columns = np.nonzero(z > 0)
    rays = unproject(np.column_stack([columns, rows]).astype(np.float64) + 0.5, own)
    points = rays / rays[:, 2:] * z[rows, columns][:, None] @ T_camera_depth[:3, :3].T + T_camera_depth[:3, 3]
    size = max(1.0, 1.5 * K[0, 0] / own.fx)  # pixels of the image for one of the depth image
    height, width = (int(np.ceil(side / size)) for side in shape)
    nearest, its_sigma = np.full(height * width, np.inf), np.zeros(height * width)
    u, v = (K[i, i] * points[:, i] / np.maximum(points[:, 2], 1e-9) + K[i, 2] for i in (0, 1))
    inside = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    cell = (v[inside] / size).astype(np.int64) * width + (u[inside] / size).astype(np.int64)
    order = np.argsort(-points[inside, 2], kind="stable")
    nearest[cell[order]] = points[inside, 2][order]
    its_sigma[cell[order]] = sigma[rows, columns][inside][order]
    grid = np.where(np.isfinite(nearest), nearest, 0.0).reshape(height, width)
    at = [
        np.minimum((np.arange(side) / size).astype(np.int64), most - 1)
        for side, most in zip(shape, (height, width), strict=True)
    ]
    return MeasuredDepth(grid[np.ix_(*at)], its_sigma.reshape(height, width)[np.ix_(*at)])
