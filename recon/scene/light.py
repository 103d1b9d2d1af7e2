"""The light of photographs that were exposed differently: what brings each to that of the others.

A camera that opens its iris, or takes another white for white, between two photographs makes one surface two colours.
Depth that two photographs agree on tells which pixels show one surface; the median ratio of their colours is the ratio
of their gains, per channel, and all ratios together give each photograph's gains in closed form (least squares of
their logarithms). What they say is used only where it is more than light that differs by where it is seen from, and
more than an automatic exposure that drifts along the way: photographs that were taken near each other share it, and
new views between them have it too.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from splatnode.recon.priors import reprojection
from splatnode.recon.priors.confirmed import AGREEING, LEAST_CONFIDENCE, MOST_PARTNERS
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.scene.scene import Exposure
from splatnode.recon.verification.exposure import BRIGHT, DARK
from splatnode.recon.workers import each

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

STEP = 3  # pixels between those that are compared
SATURATED = 250  # grey level from which a pixel does not tell how bright it was
MIN_SAMPLES = 200  # pixels that two photographs must share
INDEPENDENT = 50.0  # samples that count as one: neighbours show one surface
LEAST_SIGMA = 0.01  # of the logarithm of a ratio: surfaces shine differently in different directions
PRIOR_SIGMA = 1.0  # of a logarithm of a gain: a photograph that shares nothing keeps its light
KNOWN_SIGMA = 1e-3  # likewise, of a photograph that is in the scene's light already
_ROUNDS, _HUBER = 10, 2.0  # of robust least squares; in standard deviations


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    enabled: bool = True  # bring photographs of different exposure or white balance to one light
    # Gains that differ by less, as a share, in each channel, from the median of all, or from those of the photograph
    # taken nearest, are left as they are
    least: Annotated[float, Meta(ge=0)] = 0.3
    most: Annotated[float, Meta(ge=0)] = 1.0  # share of the median above which they are not left, however they drift


def differing(pointmaps: Sequence[Pointmap], images: Mapping[str, Image], config: Config) -> dict[str, Exposure]:
    """The exposures of `images` (h, w, 3), by name; none where they do not differ by more than `config` says."""
    if not config.enabled or len(pointmaps) < 2:
        return {}
    logs = log_gains(pointmaps, [images[pointmap.name] for pointmap in pointmaps])
    sudden = logs - _nearest(logs, np.stack([pointmap.T_world_camera[:3, 3] for pointmap in pointmaps]))
    differ, differ_nearby = np.expm1(np.abs(logs).max()), np.expm1(np.abs(sudden).max())
    if differ < config.most and min(differ, differ_nearby) < config.least:
        return {}
    return {
        pointmap.name: exposed(images[pointmap.name], own)
        for pointmap, own in zip(pointmaps, np.exp(logs), strict=True)
    }


def joining(
    pointmaps: Sequence[Pointmap], images: Mapping[str, Image], further: Collection[str], lit: bool, config: Config
) -> dict[str, Exposure]:
    """The exposures of the photographs `further`, which join others that have one light already; none needs to differ.

    `lit`: the light of one of the others was changed, so that each further one's is. Otherwise it is where it differs
    by `config.least` from theirs.
    """
    if not config.enabled:
        return {}
    priors = np.array([PRIOR_SIGMA if pointmap.name in further else KNOWN_SIGMA for pointmap in pointmaps])
    logs = _logs(pointmaps, [images[pointmap.name] for pointmap in pointmaps], priors)
    differ = np.expm1(np.abs(logs).max(axis=1))
    return {
        pointmap.name: exposed(images[pointmap.name], np.exp(own))
        for pointmap, own, by in zip(pointmaps, logs, differ, strict=True)
        if pointmap.name in further and (lit or by >= config.least)
    }


def exposed(image: Image, gains: Array) -> Exposure:
    """The exposure of a photograph `image` (h, w, 3) whose `gains` (3,) are known."""
    red, green, blue = gains.tolist()
    return Exposure((red, green, blue), _saturated(image, gains))


def in_one_light(images: Mapping[str, Image], exposures: Mapping[str, Exposure]) -> dict[str, Image]:
    """The photographs, by name: those that have an exposure as gains of 1 would have them, the others as they are."""
    return {name: alike(image, exposures[name]) if name in exposures else image for name, image in images.items()}


def relit(image: Image, gains: Sequence[float] | None) -> tuple[Image, Exposure | None]:
    """The photograph `image` in the light of its scene, and the exposure taken out; as it is without gains."""
    if gains is None:
        return image, None
    exposure = exposed(image, np.array(gains))
    return alike(image, exposure), exposure


def alike(image: Image, exposure: Exposure) -> Image:
    """The photograph `image` (h, w, 3) as gains of 1 would have it."""
    return np.clip(np.rint(image / np.array(exposure.gains)), 0, 255).astype(np.uint8)


def _nearest(logs: Array, centres: Array) -> Array:
    """(V, 3) the logarithms of the photograph taken nearest to each, at `centres` (V, 3)."""
    distances = np.linalg.norm(centres[:, None] - centres, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return logs[distances.argmin(axis=1)]


def _saturated(image: Image, gains: Array) -> Mask | None:
    """(h, w, 3) where others would not be saturated, and it does not tell how bright it was; None: nowhere."""
    found = (image >= SATURATED) & (gains > 1.0)
    return found if found.any() else None


def log_gains(pointmaps: Sequence[Pointmap], pictures: Sequence[Image]) -> Array:
    """(V, 3) logarithms of the photographs' gains; the median of each channel is 0."""
    logs = _logs(pointmaps, pictures, np.full(len(pointmaps), PRIOR_SIGMA))
    return logs - np.median(logs, axis=0)


def _logs(pointmaps: Sequence[Pointmap], pictures: Sequence[Image], priors: Array) -> Array:
    """(V, 3) logarithms of the photographs' gains, each with its standard deviation around 0 in `priors` (V,)."""
    known = [pointmap.masked(pointmap.confidence >= LEAST_CONFIDENCE) for pointmap in pointmaps]
    partners = reprojection.overlapping(known, MOST_PARTNERS)
    seen = each(lambda view: _seen(*view), list(zip(known, pictures, strict=True)))
    pairs = sorted({(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others})
    found = each(lambda pair: _log_ratio(seen[pair[0]], seen[pair[1]]), pairs)
    compared = [(pair, *ratio) for pair, ratio in zip(pairs, found, strict=True) if ratio is not None]
    return _solved(priors, compared)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A photograph with its depth, and M of its points."""

    picture: Float32  # (h, w, 3) without its noise, in grey levels
    depth: Float32  # (h, w) z in the camera's frame, 0 where unknown
    world_to_pixels: Array  # (3, 4)
    points: Float32  # (M, 3) world
    colours: Float32  # (M, 3)


def _seen(pointmap: Pointmap, picture: Image) -> _Seen:
    own = np.zeros(pointmap.depth.shape, bool)
    own[::STEP, ::STEP] = pointmap.depth[::STEP, ::STEP] > 0
    smooth = np.asarray(cv2.blur(picture.astype(np.float32), (3, 3)), np.float32)
    to_pixels = pointmap.K @ np.linalg.inv(pointmap.T_world_camera)[:3]
    return _Seen(smooth, pointmap.depth, to_pixels, pointmap.points[own], smooth[own])


def _log_ratio(source: _Seen, target: _Seen) -> tuple[Array, Array] | None:
    """(3,) logarithms of the source's gains over the target's, and their sigmas; None where they share too little."""
    x, y, z = target.world_to_pixels[:, :3] @ source.points.T + target.world_to_pixels[:, 3:]
    height, width = target.depth.shape
    column, row = (np.floor(np.divide(each, z, out=np.full_like(z, -1.0), where=z > 0)).astype(int) for each in (x, y))
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, z = column[inside], row[inside], z[inside]
    agree = np.abs(target.depth[row, column] - z) < AGREEING * z
    one, other = source.colours[inside][agree], target.picture[row[agree], column[agree]]
    usable = ((np.minimum(one, other) > DARK) & (np.maximum(one, other) < BRIGHT)).all(axis=1)
    if usable.sum() < MIN_SAMPLES:
        return None
    logs = np.log(one[usable] / other[usable]).astype(np.float64)
    median = np.median(logs, axis=0)
    spread = 1.4826 * np.median(np.abs(logs - median), axis=0)
    return median, np.hypot(spread / np.sqrt(len(logs) / INDEPENDENT), LEAST_SIGMA)


def _solved(priors: Array, compared: Sequence[tuple[tuple[int, int], Array, Array]]) -> Array:
    """(V, 3) logarithms whose differences are the compared ones, by robust least squares under the `priors` (V,)."""
    result = np.zeros((len(priors), 3))
    for channel in range(3):
        weights = np.ones(len(compared))
        for _ in range(_ROUNDS):
            information, gradient = np.diag(priors**-2), np.zeros(len(priors))
            for weight, ((i, j), ratio, sigma) in zip(weights, compared, strict=True):
                share = weight / sigma[channel] ** 2
                information[[i, j], [i, j]] += share
                information[[i, j], [j, i]] -= share
                gradient[i] += share * ratio[channel]
                gradient[j] -= share * ratio[channel]
            logs = np.linalg.solve(information, gradient)
            misfit = np.array([abs(logs[i] - logs[j] - ratio[channel]) / s[channel] for (i, j), ratio, s in compared])
            weights = np.minimum(1.0, _HUBER / np.maximum(misfit, 1e-9))
        result[:, channel] = logs
    return result
