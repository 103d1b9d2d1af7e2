"""The light of photographs that were exposed differently: what brings each to that of the others.

A camera that opens its iris, or takes another white for white, between two photographs makes one surface two colours.
Depth that two photographs agree on tells which pixels show one surface; the median ratio of their colours is the ratio
of their gains, per channel, and all ratios together give each photograph's gains in closed form (least squares of
their logarithms). What cameras say of their exposure (told_light.py) is a prior: it decides where photographs share
too little, and counts for little where they share much. What is found is used only where it is more than light that
differs by where it is seen from, and more than an automatic exposure that drifts along the way: photographs that were
taken near each other share it, and new views between them have it too. A lens that dims its corners much is undimmed
first (vignetting.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.robust import solve_robust
from splatnode.recon.scene.scene import Exposure
from splatnode.recon.scene.shared_pixels import SharedPixels, find_shared_pixels, median_log
from splatnode.recon.scene.vignetting import estimate_falloffs, relative_illumination, remove_falloff

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

SATURATED = 250  # grey level from which a pixel does not tell how bright it was
PRIOR_SIGMA = 1.0  # of a logarithm of a gain: a photograph that shares nothing keeps its light
KNOWN_SIGMA = 1e-3  # likewise, of a photograph that is in the scene's light already
TOLD_SIGMA = 0.15  # likewise, of what a photograph's camera tells of it: the curves of cameras differ
MOST_TOLD = 2.0  # of its size, from the median of all; what tells more is not believed: 8 bits could not bear it
OFFSET_SIGMA = 10.0  # of what all cameras tell, together: they only tell how photographs differ
MOST_CLIPPED = 0.01  # share of the pixels of a photograph that may be told and not kept
MOST_HEADROOM = 2.0  # beyond, dark things would have too few grey levels
_NOTHING: Mapping[str, float] = MappingProxyType({})


class ExposureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    enabled: bool = True  # bring photographs of different exposure or white balance to one light
    # Gains that differ by less, as a share, in each channel, from the median of all, or from those of the photograph
    # taken nearest, are left as they are
    least: Annotated[float, Meta(ge=0)] = 0.3
    most: Annotated[float, Meta(ge=0)] = 1.0  # share of the median above which they are not left, however they drift
    # A lens whose corners get more than exp(-least_falloff) of the light in the middle keeps its vignetting
    least_falloff: Annotated[float, Meta(ge=0)] = 0.5


def estimate_exposures(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    config: ExposureConfig,
    told: Mapping[str, float] = _NOTHING,
) -> dict[str, Exposure]:
    """The exposures of `images` (h, w, 3), by name; none where they do not differ by more than `config` says.

    `told` has the logarithms of what cameras say of them, as `compute_exposure_priors` gives them, by name.
    """
    if not config.enabled or len(pointmaps) < 2:
        return {}
    shared = find_shared_pixels(pointmaps, [images[pointmap.name] for pointmap in pointmaps])
    falloff = estimate_falloffs(shared, _lens_of(pointmaps), config.least_falloff)
    priors = np.full(len(pointmaps), PRIOR_SIGMA)
    logs = _subtract_median(
        _solve_log_gains(remove_falloff(shared, falloff), priors, _select_metadata_logs(pointmaps, told))
    )
    sudden = logs - _nearest(logs, np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps]))
    differ, differ_nearby = np.expm1(np.abs(logs).max()), np.expm1(np.abs(sudden).max())
    if differ < config.most and min(differ, differ_nearby) < config.least:
        logs = np.zeros_like(logs)
    if not logs.any() and not falloff.any():
        return {}
    return {
        pointmap.name: make_exposure(images[pointmap.name], gains, of_lens)
        for pointmap, gains, of_lens in zip(pointmaps, np.exp(logs), falloff.tolist(), strict=True)
    }


def estimate_further_exposures(
    pointmaps: Sequence[Pointmap],
    images: Mapping[str, Image],
    further: Mapping[str, float],
    known: Mapping[str, Exposure],
    config: ExposureConfig,
    told: Mapping[str, float] = _NOTHING,
) -> dict[str, Exposure]:
    """The exposures of the photographs `further`, which join others that have one light already; none needs to differ.

    `further` has the falloff of each one's lens, by name, and `known` what was taken out of the others: if that of any
    was changed, each further one's light is. Otherwise it is where it differs by `config.least` from theirs. `told` is
    as for `estimate_exposures`, of the photographs as they were taken.
    """
    if not config.enabled:
        return {}
    falloff = np.array([further.get(pointmap.name, 0.0) for pointmap in pointmaps])
    priors = np.array([PRIOR_SIGMA if pointmap.name in further else KNOWN_SIGMA for pointmap in pointmaps])
    shared = find_shared_pixels(pointmaps, [images[pointmap.name] for pointmap in pointmaps])
    taken_out = {name: np.log(exposure.gains) for name, exposure in known.items()}
    logs = _solve_log_gains(remove_falloff(shared, falloff), priors, _select_metadata_logs(pointmaps, told, taken_out))
    differ = np.expm1(np.abs(logs).max(axis=1))
    return {
        pointmap.name: make_exposure(images[pointmap.name], np.exp(own), of_lens)
        for pointmap, own, by, of_lens in zip(pointmaps, logs, differ, falloff.tolist(), strict=True)
        if pointmap.name in further and (known or by >= config.least)
    }


def make_exposure(image: Image, gains: Array, falloff: float = 0.0) -> Exposure:
    """The exposure of a photograph `image` (h, w, 3) whose `gains` (3,), and its lens's `falloff`, are known."""
    red, green, blue = gains.tolist()
    saturated = (image >= SATURATED) & (_relative_light(image, gains, falloff) > 1.0)
    return Exposure((red, green, blue), falloff, saturated if saturated.any() else None)


def apply_headroom(images: Mapping[str, Image], exposures: Mapping[str, Exposure]) -> tuple[dict[str, Exposure], float]:
    """Exposures by which what photographs tell stays below white, and how much darker these leave the photographs.

    A dark photograph tells how bright things are that are brighter than white in the light of the median. Of the
    pixels that are not saturated, all but MOST_CLIPPED of each photograph are kept. `images` (h, w, 3) are as they were
    taken.
    """
    headroom = 1.0
    for name, exposure in exposures.items():
        told = (images[name] < SATURATED).all(axis=2)
        if told.any():
            share = _relative_light(images[name], np.array(exposure.gains), exposure.falloff)
            brightest = np.quantile((images[name] / share)[told].max(axis=1), 1.0 - MOST_CLIPPED)
            headroom = max(headroom, float(brightest) / SATURATED)
    headroom = min(headroom, MOST_HEADROOM)
    if headroom == 1.0:
        return dict(exposures), 1.0
    darker = {
        name: make_exposure(images[name], headroom * np.array(exposure.gains), exposure.falloff)
        for name, exposure in exposures.items()
    }
    return darker, headroom


def compensate_images(images: Mapping[str, Image], exposures: Mapping[str, Exposure]) -> dict[str, Image]:
    """The photographs, by name: those that have an exposure as gains of 1 would have them, the others as they are."""
    return {
        name: apply_exposure(image, exposures[name]) if name in exposures else image for name, image in images.items()
    }


def compensate_image(
    image: Image, gains: Sequence[float] | None, falloff: float = 0.0
) -> tuple[Image, Exposure | None]:
    """The photograph `image` in the light of its scene, and the exposure taken out; as it is without gains."""
    if gains is None:
        return image, None
    exposure = make_exposure(image, np.array(gains), falloff)
    return apply_exposure(image, exposure), exposure


def apply_exposure(image: Image, exposure: Exposure) -> Image:
    """The photograph `image` (h, w, 3) as gains of 1 and a lens without falloff would have it."""
    share = _relative_light(image, np.array(exposure.gains), exposure.falloff)
    return np.clip(np.rint(image / share), 0, 255).astype(np.uint8)


def _relative_light(image: Image, gains: Array, falloff: float) -> Array:
    """(h, w, 3), or one that broadcasts to it: the photograph's light over that of the scene."""
    return relative_illumination(falloff, image.shape[1], image.shape[0])[..., None] * gains if falloff else gains


def _nearest(logs: Array, centres: Array) -> Array:
    """(V, 3) the logarithms of the photograph taken nearest to each, at `centres` (V, 3)."""
    distances = np.linalg.norm(centres[:, None] - centres, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return logs[distances.argmin(axis=1)]


def estimate_log_gains(
    pointmaps: Sequence[Pointmap], pictures: Sequence[Image], told: Mapping[str, float] = _NOTHING
) -> Array:
    """(V, 3) logarithms of the photographs' gains; the median of each channel is 0. `told` is as for `estimate_exposures`."""
    priors = np.full(len(pointmaps), PRIOR_SIGMA)
    return _subtract_median(
        _solve_log_gains(find_shared_pixels(pointmaps, pictures), priors, _select_metadata_logs(pointmaps, told))
    )


def _subtract_median(logs: Array) -> Array:
    return logs - np.median(logs, axis=0)


def _select_metadata_logs(
    pointmaps: Sequence[Pointmap], told: Mapping[str, float], taken_out: Mapping[str, Array] = MappingProxyType({})
) -> Array:
    """(V, 3) the logarithms in `told`, without those of the gains that were taken out, about their median.

    NaN where nothing is told, or where it is not to be believed.
    """
    nothing = np.zeros(3)
    logs = np.array([told.get(each.name, np.nan) - taken_out.get(each.name, nothing) for each in pointmaps])
    known = np.isfinite(logs[:, 0])
    if known.any():
        logs -= np.median(logs[known], axis=0)
        logs[np.abs(logs).max(axis=1) > MOST_TOLD] = np.nan
    return logs


def _solve_log_gains(shared: Sequence[SharedPixels], priors: Array, told: Array) -> Array:
    """(V, 3) logarithms of the photographs' gains, each with its standard deviation around 0 in `priors` (V,).

    `told` (V, 3) is what cameras say of them, up to one offset; NaN: nothing. What is far from all the rest counts for
    little more than what is a few sigmas away.
    """
    count, tellers = len(priors), np.flatnonzero(np.isfinite(told[:, 0]))
    factors = np.zeros((len(shared) + len(tellers), count + bool(len(tellers))))
    values, sigmas = np.zeros((2, len(factors), 3))
    for index, each in enumerate(shared):
        factors[index, list(each.pair)] = 1.0, -1.0
        values[index], sigmas[index] = median_log(each.logs)
    for index, view in enumerate(tellers, start=len(shared)):
        factors[index, [view, -1]] = 1.0, 1.0
        values[index], sigmas[index] = told[view], TOLD_SIGMA
    if len(tellers):
        priors = np.append(priors, OFFSET_SIGMA)
    found = [solve_robust(factors, *channel, priors) for channel in zip(values.T, sigmas.T, strict=True)]
    return np.column_stack(found)[:count]


def _lens_of(pointmaps: Sequence[Pointmap]) -> list[int]:
    """A number for each photograph's lens: those of one lens have the same intrinsics."""
    found = {pointmap.K.tobytes(): index for index, pointmap in enumerate(pointmaps)}
    return [found[pointmap.K.tobytes()] for pointmap in pointmaps]
