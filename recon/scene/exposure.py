"""The light of photographs that were exposed differently: what brings each to that of the others.

A camera that opens its iris, or takes another white for white, between two photographs makes one surface two colours.
Depth that two photographs agree on tells which pixels show one surface; the median ratio of their colours is the ratio
of their gains, per channel, and all ratios together give each photograph's gains in closed form (least squares of
their logarithms), with their standard deviations. What cameras say of their exposure is a prior: it decides where
photographs share too little, and counts for little where they share much. What is found is used only where it is more
than its own uncertainty, so that what is noise stays out; then the scene has one light, and
recon/result/view_exposure.py tells that of a novel view. A lens that dims its corners is undimmed first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from splatnode.capture.process.config import Internal
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.priors import AGREEING, LEAST_CONFIDENCE, MOST_PARTNERS, Pointmap, find_overlapping
from splatnode.recon.result.view_exposure import compute_squared_radius, relative_illumination
from splatnode.recon.scene import Exposure
from splatnode.recon.threads import map_parallel
from splatnode.recon.verification.evidence import BRIGHT, DARK

# Linear least squares that single wrong equations do not spoil.

Array = npt.NDArray[np.float64]

_ROUNDS, _HUBER = 10, 2.0  # of reweighting; in standard deviations


def solve_robust(factors: Array, values: Array, sigmas: Array, priors: Array) -> tuple[Array, Array]:
    """(K,) the unknowns for which `factors` (N, K) times them are `values` (N,), by Huber's loss; and their covariance.

    `sigmas` (N,) are of the equations, `priors` (K,) of the unknowns around 0. Equations that contradict each other by
    more than their sigmas make the covariance (K, K) larger.
    """
    result, weights, information = np.zeros(len(priors)), np.ones(len(values)), np.diag(priors**-2)
    misfit = np.zeros(len(values))
    for _ in range(_ROUNDS):
        weighted = factors * (weights / sigmas**2)[:, None]
        information = factors.T @ weighted + np.diag(priors**-2)
        result = np.linalg.solve(information, weighted.T @ values)
        misfit = np.abs(factors @ result - values) / sigmas
        weights = np.minimum(1.0, _HUBER / np.maximum(misfit, 1e-9))
    contradiction = ((weights * misfit**2).sum() + ((result / priors) ** 2).sum()) / max(len(values), 1)
    return result, np.asarray(max(contradiction, 1.0) * np.linalg.inv(information), np.float64)


# What photographs show alike: pixels of one surface in two of them, by depth that both agree on, and their colours.

Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]

STEP = 3  # pixels between those that are compared
MIN_SAMPLES = 200  # pixels that two photographs must share
INDEPENDENT = 50.0  # samples that count as one: neighbours show one surface
LEAST_SIGMA = 0.01  # of the logarithm of a ratio: surfaces shine differently in different directions


@dataclass(frozen=True, eq=False)
class SharedPixels:
    """M pixels of one surface in two photographs."""

    pair: tuple[int, int]  # the photographs' numbers
    logs: Array  # (M, 3) logarithms of the colours in the first over those in the second
    radii: Array  # (M, 2) squared, of the pixels in the first and in the second


def find_shared_pixels(pointmaps: Sequence[Pointmap], pictures: Sequence[Image]) -> list[SharedPixels]:
    """Finds pixels that each two images share; `pictures` (h, w, 3) are as large as their point maps."""
    known = [pointmap.apply_mask(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = find_overlapping(known, MOST_PARTNERS)
    seen = map_parallel(lambda view: _sample_view(*view), list(zip(known, pictures, strict=True)))
    pairs = sorted({(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others})
    found = map_parallel(lambda pair: _compare_views(pair, seen[pair[0]], seen[pair[1]]), pairs)
    return [shared for shared in found if shared is not None]


def median_log(logs: Array) -> tuple[Array, Array]:
    """Returns the median of log ratios (M, ...) and its standard deviation."""
    median = np.median(logs, axis=0)
    spread = 1.4826 * np.median(np.abs(logs - median), axis=0)
    return median, np.hypot(spread / np.sqrt(len(logs) / INDEPENDENT), LEAST_SIGMA)


def measure_log_gain(image: Image, render: Float32, used: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Measures the log gain (3,) of `image` (h, w, 3) over `render`, in grey levels too, where it is `used`; its sigma.

    Where too few pixels tell it, it is 0 and its sigma PRIOR_SIGMA.
    """
    one, other = (np.asarray(cv2.blur(np.asarray(each, np.float32), (3, 3))) for each in (image, render))
    usable = used & ((np.minimum(one, other) > DARK) & (np.maximum(one, other) < BRIGHT)).all(axis=2)
    usable = usable[::STEP, ::STEP]
    if usable.sum() < MIN_SAMPLES:
        return np.zeros(3), np.full(3, PRIOR_SIGMA)
    ratios = one[::STEP, ::STEP][usable] / other[::STEP, ::STEP][usable]
    return median_log(np.log(ratios.astype(np.float64)))


@dataclass(frozen=True, eq=False)
class _SampledView:
    """A photograph with its depth, and M of its points."""

    picture: Float32  # (h, w, 3) without its noise, in grey levels
    depth: Float32  # (h, w) z in the camera's frame, 0 where unknown
    world_to_pixels: Array  # (3, 4)
    points: Float32  # (M, 3) world
    colours: Float32  # (M, 3)
    radii: Array  # (M,) squared


def _sample_view(pointmap: Pointmap, picture: Image) -> _SampledView:
    height, width = pointmap.depth.shape
    own = np.zeros((height, width), bool)
    own[::STEP, ::STEP] = pointmap.depth[::STEP, ::STEP] > 0
    smooth = np.asarray(cv2.blur(picture.astype(np.float32), (3, 3)), np.float32)
    to_pixels = pointmap.K @ np.linalg.inv(pointmap.T_world_camera)[:3]
    rows, columns = np.nonzero(own)
    radii = compute_squared_radius(columns, rows, width, height)
    return _SampledView(smooth, pointmap.depth, to_pixels, pointmap.points[own], smooth[own], radii)


def _compare_views(pair: tuple[int, int], source: _SampledView, target: _SampledView) -> SharedPixels | None:
    """None where the two share too little."""
    x, y, z = target.world_to_pixels[:, :3] @ source.points.T + target.world_to_pixels[:, 3:]
    height, width = target.depth.shape
    column, row = (np.floor(np.divide(each, z, out=np.full_like(z, -1.0), where=z > 0)).astype(int) for each in (x, y))
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, z = column[inside], row[inside], z[inside]
    agree = np.abs(target.depth[row, column] - z) < AGREEING * z
    column, row = column[agree], row[agree]
    one, other = source.colours[inside][agree], target.picture[row, column]
    usable = ((np.minimum(one, other) > DARK) & (np.maximum(one, other) < BRIGHT)).all(axis=1)
    if usable.sum() < MIN_SAMPLES:
        return None
    logs = np.log(one[usable] / other[usable]).astype(np.float64)
    radii = np.column_stack([source.radii[inside][agree], compute_squared_radius(column, row, width, height)])
    return SharedPixels(pair, logs, radii[usable])


# Vignetting: a lens that brings less light to the corners of its photographs than to their middle.
#
# Two photographs that show one surface at different distances from their middles tell how the light falls off between
# them. The light at the radius r (1 at the corners) is exp(-falloff r^2) of that in the middle: one term a lens,
# solved from all pairs together with a gain for each photograph, by robust least squares of logarithms.


BINS, MIN_BIN_SAMPLES = 8, 30  # of a pair's pixels, by how far the radii differ; and in each
GAIN_SIGMA, FALLOFF_SIGMA = 1.0, 2.0  # of their priors around 0
MIN_PHOTOGRAPHS = 3  # fewer cannot contradict each other
SIGMAS = 2.0  # standard deviations that a falloff must be above the least that is taken out


def estimate_falloffs(shared: Sequence[SharedPixels], lens_of: Sequence[int], least: float) -> tuple[Array, Array]:
    """(V,) of each photograph's lens, which `lens_of` numbers: what is to be taken out, and what was measured.

    The first is 0 where it may be less than `least`. Small ones of the second may be noise, but no gain explains them.
    """
    sure, measured = np.zeros((2, len(lens_of)))
    for lens in sorted(set(lens_of)):
        members = [view for view, own in enumerate(lens_of) if own == lens]
        if len(members) < MIN_PHOTOGRAPHS:
            continue
        bins = [each for pair in shared if set(pair.pair) <= set(members) for each in _bins(pair)]
        found = _estimate_falloff(bins, members)
        measured[members] = max(found, 0.0)
        if found < least:
            continue
        without = [_estimate_falloff([each for each in bins if view not in each.pair], members) for view in members]
        sigma = np.sqrt((len(members) - 1) * np.var(without))  # the jackknife's
        if found - SIGMAS * sigma >= least:
            sure[members] = found
    return sure, measured


def remove_falloff(shared: Sequence[SharedPixels], falloff: Array) -> Sequence[SharedPixels]:
    """The ratios of colours as lenses would give them that dim nothing; `falloff` (V,) is of the photographs'."""
    if not falloff.any():
        return shared
    return [
        replace(each, logs=each.logs + (each.radii @ (falloff[list(each.pair)] * (1.0, -1.0)))[:, None])
        for each in shared
    ]


@dataclass(frozen=True)
class _Bin:
    """Pixels of a pair whose radii differ alike."""

    pair: tuple[int, int]
    log: float  # median ratio of the colours, mean over the channels
    farther: float  # the squared radius in the first less that in the second
    sigma: float  # of `log`


def _bins(shared: SharedPixels) -> list[_Bin]:
    farther, logs = shared.radii[:, 0] - shared.radii[:, 1], shared.logs.mean(axis=1)
    found = []
    for own in np.array_split(np.argsort(farther, kind="stable"), BINS):
        if len(own) < MIN_BIN_SAMPLES:
            continue
        log, sigma = median_log(logs[own])
        found.append(_Bin(shared.pair, float(log), float(farther[own].mean()), float(sigma)))
    return found


def _estimate_falloff(bins: Collection[_Bin], members: Sequence[int]) -> float:
    """Estimates the falloff of the lens of the images `members`, with their gains; 0 without data."""
    column = {view: index for index, view in enumerate(members)}
    factors = np.zeros((len(bins), len(members) + 1))
    for row, each in zip(factors, bins, strict=True):
        row[column[each.pair[0]]], row[column[each.pair[1]]], row[-1] = 1.0, -1.0, -each.farther
    values, sigmas = (np.array([getattr(each, name) for each in bins]) for name in ("log", "sigma"))
    priors = np.array([GAIN_SIGMA] * len(members) + [FALLOFF_SIGMA])
    return float(solve_robust(factors, values, sigmas, priors)[0][-1])


SATURATED = 250  # grey level from which a pixel does not tell how bright it was
PRIOR_SIGMA = 1.0  # of a logarithm of a gain: a photograph that shares nothing keeps its light
KNOWN_SIGMA = 1e-3  # likewise, of a photograph that is in the scene's light already
METADATA_SIGMA = 0.15  # likewise, of what a photograph's metadata states: the curves of cameras differ
MOST_METADATA_LOG = 2.0  # of its size, from the median of all; what is more is not believed: 8 bits could not bear it
OFFSET_SIGMA = 10.0  # of what all cameras tell, together: they only tell how photographs differ
MOST_CLIPPED = 0.01  # share of the pixels of a photograph that may be told and not kept
MOST_HEADROOM = 2.0  # beyond, dark things would have too few grey levels
_NOTHING: Mapping[str, float] = MappingProxyType({})


class ExposureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Exposure compensation: a gain for each image, so that all have the brightness of the others."""

    enabled: bool = True  # bring photographs of different exposure or white balance to one light
    # Gains that all differ by less from their median, as a share, are left as they are
    least: Internal[Annotated[float, Meta(ge=0)]] = 0.02
    # Likewise, in standard deviations of their logarithms
    min_sigmas: Internal[Annotated[float, Meta(ge=0)]] = 4.0
    # Share from which on they are not left, however unsure they are
    most: Internal[Annotated[float, Meta(ge=0)]] = 0.3
    # A lens whose corners get more than exp(-least_falloff) of the light in the middle keeps its vignetting
    least_falloff: Internal[Annotated[float, Meta(ge=0)]] = 0.1


def estimate_exposures(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    config: ExposureConfig,
    metadata_exposures: Mapping[str, float] = _NOTHING,
) -> dict[str, Exposure]:
    """The exposures of `images` (h, w, 3), by name; none where they do not differ by more than `config` says.

    `metadata_exposures` has the log exposures that cameras state, as `compute_exposure_priors` gives them, by name.
    """
    if not config.enabled or len(pointmaps) < 2:
        return {}
    shared = find_shared_pixels(pointmaps, [images[pointmap.name] for pointmap in pointmaps])
    falloff, measured = estimate_falloffs(shared, _lens_of(pointmaps), config.least_falloff)
    priors = np.full(len(pointmaps), PRIOR_SIGMA)
    solved = _solve_log_gains(
        remove_falloff(shared, measured), priors, _select_metadata_logs(pointmaps, metadata_exposures)
    )
    found = solved.subtract_median()
    if not found.exceed(config).any():
        found = replace(found, logs=np.zeros_like(found.logs))
    if not found.logs.any() and not falloff.any():
        return {}
    return {
        pointmap.name: make_exposure(images[pointmap.name], np.exp(own), of_lens, sigmas)
        for pointmap, own, of_lens, sigmas in zip(pointmaps, found.logs, falloff.tolist(), found.sigmas, strict=True)
    }


def estimate_further_exposures(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    further: Mapping[str, float],
    known: Mapping[str, Exposure],
    config: ExposureConfig,
    metadata_exposures: Mapping[str, float] = _NOTHING,
) -> dict[str, Exposure]:
    """The exposures of the photographs `further`, which join others that have one light already; none needs to differ.

    `further` has the falloff of each one's lens, by name, and `known` what was taken out of the others: if that of any
    was changed, each further one's light is. Otherwise it is where it differs from theirs by more than `config` says.
    `metadata_exposures` is as for `estimate_exposures`, of the photographs as they were taken.
    """
    if not config.enabled:
        return {}
    falloff = np.array([further.get(pointmap.name, 0.0) for pointmap in pointmaps])
    priors = np.array([PRIOR_SIGMA if pointmap.name in further else KNOWN_SIGMA for pointmap in pointmaps])
    shared = find_shared_pixels(pointmaps, [images[pointmap.name] for pointmap in pointmaps])
    taken_out = {name: np.log(exposure.gains) for name, exposure in known.items()}
    found = _solve_log_gains(
        remove_falloff(shared, falloff), priors, _select_metadata_logs(pointmaps, metadata_exposures, taken_out)
    )
    each = zip(pointmaps, found.logs, found.sigmas, found.exceed(config), falloff.tolist(), strict=True)
    return {
        pointmap.name: make_exposure(images[pointmap.name], np.exp(own), of_lens, sigmas)
        for pointmap, own, sigmas, differs, of_lens in each
        if pointmap.name in further and (known or differs)
    }


def make_exposure(image: Image, gains: Array, falloff: float = 0.0, sigmas: Array | None = None) -> Exposure:
    """The exposure of a photograph `image` (h, w, 3) whose `gains` (3,), and its lens's `falloff`, are known.

    `sigmas` (3,) are of the logarithms of the gains; None: they are not known.
    """
    red, green, blue = gains.tolist()
    saturated = (image >= SATURATED) & (_relative_light(image, gains, falloff) > 1.0)
    known = None if sigmas is None else (float(sigmas[0]), float(sigmas[1]), float(sigmas[2]))
    return Exposure((red, green, blue), falloff, saturated if saturated.any() else None, known)


def apply_headroom(images: Mapping[str, Image], exposures: Mapping[str, Exposure]) -> tuple[dict[str, Exposure], float]:
    """Exposures by which what photographs tell stays below white, and how much darker these leave the photographs.

    A dark photograph tells how bright things are that are brighter than white in the light of the median. Of the
    pixels that are not saturated, all but MOST_CLIPPED of each photograph are kept. `images` (h, w, 3) are as they were
    taken.
    """
    headroom = 1.0
    for name, exposure in exposures.items():
        is_unsaturated = (images[name] < SATURATED).all(axis=2)
        if is_unsaturated.any():
            share = _relative_light(images[name], np.array(exposure.gains), exposure.falloff)
            brightest = np.quantile((images[name] / share)[is_unsaturated].max(axis=1), 1.0 - MOST_CLIPPED)
            headroom = max(headroom, float(brightest) / SATURATED)
    headroom = min(headroom, MOST_HEADROOM)
    if headroom == 1.0:
        return dict(exposures), 1.0
    darker = {
        name: replace(
            make_exposure(images[name], headroom * np.array(exposure.gains), exposure.falloff), sigmas=exposure.sigmas
        )
        for name, exposure in exposures.items()
    }
    return darker, headroom


def compensate_images(images: Mapping[str, Image], exposures: Mapping[str, Exposure]) -> dict[str, Image]:
    """The photographs, by name: those that have an exposure as gains of 1 would have them, the others as they are."""
    return {
        name: apply_exposure(image, exposures[name]) if name in exposures else image for name, image in images.items()
    }


def compensate_image(
    image: Image, gains: Sequence[float] | None, falloff: float = 0.0, sigmas: Sequence[float] | None = None
) -> tuple[Image, Exposure | None]:
    """The photograph `image` in the light of its scene, and the exposure taken out; as it is without gains."""
    if gains is None:
        return image, None
    exposure = make_exposure(image, np.array(gains), falloff, None if sigmas is None else np.array(sigmas))
    return apply_exposure(image, exposure), exposure


def apply_exposure(image: Image, exposure: Exposure) -> Image:
    """The photograph `image` (h, w, 3) as gains of 1 and a lens without falloff would have it."""
    share = _relative_light(image, np.array(exposure.gains), exposure.falloff)
    return np.clip(np.rint(image / share), 0, 255).astype(np.uint8)


def _relative_light(image: Image, gains: Array, falloff: float) -> Array:
    """(h, w, 3), or one that broadcasts to it: the photograph's light over that of the scene."""
    return relative_illumination(falloff, image.shape[1], image.shape[0])[..., None] * gains if falloff else gains


def estimate_log_gains(
    pointmaps: Sequence[Pointmap], pictures: Sequence[Image], metadata_exposures: Mapping[str, float] = _NOTHING
) -> Array:
    """(V, 3) logarithms of the photographs' gains; the median of each channel is 0.

    `metadata_exposures` is as for `estimate_exposures`.
    """
    priors = np.full(len(pointmaps), PRIOR_SIGMA)
    shared = find_shared_pixels(pointmaps, pictures)
    return _solve_log_gains(shared, priors, _select_metadata_logs(pointmaps, metadata_exposures)).subtract_median().logs


def _select_metadata_logs(
    pointmaps: Sequence[Pointmap],
    metadata_exposures: Mapping[str, float],
    taken_out: Mapping[str, Array] = MappingProxyType({}),
) -> Array:
    """(V, 3) the logarithms in `metadata_exposures`, without those of gains that were taken out, about their median.

    NaN where a camera states none, or where it is not to be believed.
    """
    nothing = np.zeros(3)
    logs = np.array(
        [metadata_exposures.get(each.name, np.nan) - taken_out.get(each.name, nothing) for each in pointmaps]
    )
    known = np.isfinite(logs[:, 0])
    if known.any():
        logs -= np.median(logs[known], axis=0)
        logs[np.abs(logs).max(axis=1) > MOST_METADATA_LOG] = np.nan
    return logs


@dataclass(frozen=True, eq=False)
class _LogGains:
    """Logarithms of the gains of V photographs."""

    logs: Array  # (V, 3)
    covariances: Array  # (3, V, V), a channel each

    @property
    def sigmas(self) -> Array:
        """Returns the standard deviations (V, 3)."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2).T)

    def subtract_median(self) -> _LogGains:
        """Returns the same about the median of each channel: what all have in common is not known, and no matter."""
        about_mean = np.eye(len(self.logs)) - 1.0 / len(self.logs)
        return _LogGains(self.logs - np.median(self.logs, axis=0), about_mean @ self.covariances @ about_mean)

    def exceed(self, config: ExposureConfig) -> Flags:
        """(V,) which of them are no noise, and large enough to matter."""
        sure = (np.abs(self.logs) > config.min_sigmas * self.sigmas).any(axis=1)
        share = np.expm1(np.abs(self.logs).max(axis=1))
        return (share >= config.most) | (sure & (share >= config.least))


def _solve_log_gains(shared: Sequence[SharedPixels], priors: Array, prior_log_gains: Array) -> _LogGains:
    """The logarithms of V photographs' gains, each with its standard deviation around 0 in `priors` (V,).

    `prior_log_gains` (V, 3) is what cameras say of them, up to one offset; NaN: nothing. What is far from all the rest
    counts for little more than what is a few sigmas away.
    """
    count, tellers = len(priors), np.flatnonzero(np.isfinite(prior_log_gains[:, 0]))
    factors = np.zeros((len(shared) + len(tellers), count + bool(len(tellers))))
    values, sigmas = np.zeros((2, len(factors), 3))
    for index, each in enumerate(shared):
        factors[index, list(each.pair)] = 1.0, -1.0
        values[index], sigmas[index] = median_log(each.logs)
    for index, view in enumerate(tellers, start=len(shared)):
        factors[index, [view, -1]] = 1.0, 1.0
        values[index], sigmas[index] = prior_log_gains[view], METADATA_SIGMA
    if len(tellers):
        priors = np.append(priors, OFFSET_SIGMA)
    found = [solve_robust(factors, *channel, priors) for channel in zip(values.T, sigmas.T, strict=True)]
    logs, covariances = (np.array(each) for each in zip(*found, strict=True))
    return _LogGains(logs.T[:count], covariances[:, :count, :count])


def _lens_of(pointmaps: Sequence[Pointmap]) -> list[int]:
    """A number for each photograph's lens: those of one lens have the same intrinsics."""
    found = {pointmap.K.tobytes(): index for index, pointmap in enumerate(pointmaps)}
    return [found[pointmap.K.tobytes()] for pointmap in pointmaps]


# What cameras say of the light of their photographs: how much brighter one should be than another.
#
# Time, sensitivity and aperture tell how much light of a surface was recorded. Pixels answer with a power of it, and
# each camera's own processing differs from that; so this is a hint with a wide sigma, which shared pixels overrule.

RESPONSE = 1.0 / 2.2  # exponent by which pixels answer to light, as sRGB's do


def compute_exposure_priors(keyframes: Iterable[Keyframe]) -> dict[str, float]:
    """Returns the log exposures that image metadata states, by name; only differences mean anything.

    An exposure with an f-number and one without cannot be compared: those of the kind that is rarer are left out.
    """
    exposures = {each.name: each.frame.exposure for each in keyframes if each.frame.exposure is not None}
    whole = {name for name, exposure in exposures.items() if exposure.f_number is not None}
    chosen = whole if 2 * len(whole) >= len(exposures) else exposures.keys() - whole
    return {name: RESPONSE * exposure.log_exposure for name, exposure in exposures.items() if name in chosen}
