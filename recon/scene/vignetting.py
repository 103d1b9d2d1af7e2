"""Vignetting: a lens that brings less light to the corners of its photographs than to their middle.

Two photographs that show one surface at different distances from their middles tell how the light falls off between
them. The light at the radius r (1 at the corners) is exp(-falloff r^2) of that in the middle: one term a lens, solved
from all pairs together with a gain for each photograph, by robust least squares of logarithms.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.recon.scene.robust import solve_robust
from splatnode.recon.scene.shared_pixels import SharedPixels, compute_squared_radius, median_log

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

BINS, MIN_SAMPLES = 8, 30  # of a pair's pixels, by how far the radii differ; and in each
GAIN_SIGMA, FALLOFF_SIGMA = 1.0, 2.0  # of their priors around 0
MIN_PHOTOGRAPHS = 3  # fewer cannot contradict each other
SIGMAS = 2.0  # standard deviations that a falloff must be above the least that is taken out


def relative_illumination(falloff: float, width: int, height: int) -> Float32:
    """(h, w) the share of the middle's light that reaches each pixel."""
    across, along = np.meshgrid(np.arange(width), np.arange(height))
    return np.exp(-falloff * compute_squared_radius(across, along, width, height)).astype(np.float32)


def estimate_falloffs(shared: Sequence[SharedPixels], lens_of: Sequence[int], least: float) -> Array:
    """(V,) of each photograph's lens, which `lens_of` numbers; 0 where it may be less than `least`."""
    result = np.zeros(len(lens_of))
    for lens in sorted(set(lens_of)):
        members = [view for view, own in enumerate(lens_of) if own == lens]
        if len(members) < MIN_PHOTOGRAPHS:
            continue
        bins = [each for pair in shared if set(pair.pair) <= set(members) for each in _bins(pair)]
        found = _estimate_falloff(bins, members)
        if found < least:
            continue
        without = [_estimate_falloff([each for each in bins if view not in each.pair], members) for view in members]
        sigma = np.sqrt((len(members) - 1) * np.var(without))  # the jackknife's
        if found - SIGMAS * sigma >= least:
            result[members] = found
    return result


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
        if len(own) < MIN_SAMPLES:
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
    return float(solve_robust(factors, values, sigmas, priors)[-1])
