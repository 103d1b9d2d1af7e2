"""How depth images go with what the images themselves tell: the unit that they give, and what speaks against them.

Points that several images see have a depth in the scene's unit; a depth image has one in metres at the same pixel.
Their ratio is the unit. Where the depth image lies beside the image that it is told to be aligned with, ratios agree
better at another pixel: the images test it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage, describe_doubtful_unit
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics
from splatnode.capture.lenses import project
from splatnode.capture.process.text import sanitize_name
from splatnode.recon.metric.depth_smoothing import smooth_depth
from splatnode.recon.result.depth_check import DepthCheck, DepthCode
from splatnode.recon.threads import map_parallel

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
    """A fit for the depth images of each camera, in the order of their ids."""
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
    names, unit = tuple(view.name for view in views), 1.0
    step = max(1, -(-sum(len(view.points) for view in views) // _MOST_POINTS))
    scale = max(max(view.depth.values.shape) for view in views) / REFERENCE_PX
    aside = any(view.depth.T_camera_depth[3::4][:3] != (0.0, 0.0, 0.0) for view in views)
    map_parallel(lambda view: view.surface, views)
    samples = _collect_samples(views, unit, step)
    for _ in range(4 if aside else 1):  # where a depth camera stands beside, its pixels depend on the unit
        ratio, _ = samples.look((0.0, 0.0), scale)
        if np.isfinite(ratio).sum() >= LEAST_POINTS:
            unit *= float(np.exp(np.nanmedian(ratio)))
            samples = _collect_samples(views, unit, step)
    ratio, sigma = samples.look((0.0, 0.0), scale)
    known = np.isfinite(ratio)
    if known.sum() < LEAST_POINTS:
        return _explain_few(views, int(known.sum()))
    mean, mean_sigma = _average(ratio[known], sigma[known])
    agreeing = float((np.abs(ratio[known] - mean) < _AGREEING_SIGMAS * sigma[known]).mean())
    shift, gain = _find_shift(samples, scale)
    check = _judge(camera_id, len(names), int(known.sum()), agreeing, shift, gain)
    noise = max(view.depth.noise.scale_sigma for view in views)
    return DepthFit(camera_id, names, unit * float(np.exp(mean)), float(np.hypot(mean_sigma, noise)), check)


def _collect_samples(views: Sequence[DepthView], unit: float, step: int) -> _Samples:
    """Every `step`-th point of each view."""
    view_of, pixels, log_z = [], [], []
    for number, view in enumerate(views):
        T_depth_camera = np.linalg.inv(view.depth.matrix)
        points = unit * view.points[::step] @ T_depth_camera[:3, :3].T + T_depth_camera[:3, 3]
        points = points[points[:, 2] > 0]
        seen = project(points, find_depth_lens(view.depth, view.lens)) if len(points) else np.zeros((0, 2))
        kept = np.isfinite(seen).all(1) & (np.abs(seen) < 1e6).all(1)
        view_of.append(np.full(int(kept.sum()), number))
        pixels.append(seen[kept])
        log_z.append(np.log(points[kept, 2]))
    return _Samples(
        [view.surface for view in views], np.concatenate(view_of), np.concatenate(pixels), np.concatenate(log_z)
    )


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
    better = here - _compute_costs(samples, best, scale)
    better = better[np.isfinite(better)]
    spread = float(better.std()) / np.sqrt(max(samples.count_cells(scale), 1)) if len(better) else 0.0
    return best, float(better.mean()) / spread if spread > 0 else 0.0


def _compute_costs(samples: _Samples, shift: tuple[float, float], scale: float) -> Array:
    """(M,) the squared deviations of each point, at most those of _CUT sigmas; NaN where it has no depth."""
    ratio, sigma = samples.look(shift, scale)
    known = np.isfinite(ratio)
    if not known.any():
        return ratio
    return np.minimum(((ratio - np.median(ratio[known])) / sigma) ** 2, _CUT**2)


def _judge(
    camera_id: str, num_images: int, num_points: int, agreeing: float, shift: tuple[float, float], gain: float
) -> DepthCheck:
    who = f"depth images of {num_images} photographs" + (f" of {camera_id}" if camera_id else "")
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
    who = f"depth images of {len(names)} photographs" + (f" of {camera_id}" if camera_id else "")
    message = f"{who} have a depth at {count} points of the images; {LEAST_POINTS} are needed to use them"
    if (doubt := next(doubts, None)) is not None:
        message += f": {doubt}"
    return DepthFit(camera_id, names, 1.0, float("inf"), DepthCheck(DepthCode.UNTESTED, message, camera_id, count))


def group_by_name(fits: Sequence[DepthFit]) -> Mapping[str, DepthFit]:
    """The fit of each image by its name, of those that may be used."""
    return {name: fit for fit in fits if fit.is_usable for name in fit.names}


def describe_doubtful_units(frames: Iterable[Frame | DroppedFrame]) -> str:
    """Describes what speaks against the units of depth images, by the first that it is about; empty: nothing does."""
    depths = {each.name: each.depth for each in frames if isinstance(each, Frame) and each.depth is not None}
    doubts = {name: doubt for name, depth in depths.items() if (doubt := describe_doubtful_unit(depth))}
    if not doubts:
        return ""
    name, doubt = next(iter(doubts.items()))
    return f"the depth image of {sanitize_name(name)}: {doubt} ({len(doubts)} of {len(depths)} depth images)"
