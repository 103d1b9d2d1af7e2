"""How differently the frames are exposed: the brightness of the same points in all of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from splatnode.recon.registration.register import Registration

DARK, BRIGHT = 12.0, 243.0  # grey levels of 255; what is near black or white says nothing about a gain
ROUNDS = 3  # each compares a frame with the mean of the others as it is known so far


def estimate_gains(
    greys: Mapping[int, npt.NDArray[np.float32]], registration: Registration, scales: Mapping[int, tuple[float, float]]
) -> dict[int, float]:
    """Each frame's gain: its points' grey levels over those of the same points in the other frames, 1 on average.

    `greys` are the pictures at modelled size by frame, `scales` their size over the frame's.
    """
    values = np.full(len(registration.observed_by), np.nan)
    for index, grey in greys.items():
        mine = registration.observed_by == index
        at = (registration.observed_pixels[mine] * scales[index]).astype(int)
        values[mine] = grey[np.clip(at[:, 1], 0, grey.shape[0] - 1), np.clip(at[:, 0], 0, grey.shape[1] - 1)]
    logs = np.where((values > DARK) & (values < BRIGHT), np.log(np.maximum(values, 1.0)), np.nan)
    found = dict.fromkeys(greys, 0.0)
    for _ in range(ROUNDS):
        corrected = logs - np.array([found.get(int(index), 0.0) for index in registration.observed_by])
        known = np.isfinite(corrected)
        total = np.bincount(registration.observed_point[known], corrected[known], minlength=len(registration.points))
        count = np.bincount(registration.observed_point[known], minlength=len(registration.points))
        mean = (total / np.maximum(count, 1))[registration.observed_point]
        found = {
            index: found[index] + _median((corrected - mean)[known & (registration.observed_by == index)])
            for index in greys
        }
    middle = _median(np.array(list(found.values())))
    return {index: float(np.exp(value - middle)) for index, value in found.items()}


def _median(values: npt.NDArray[np.float64]) -> float:
    return float(np.median(values)) if len(values) else 0.0
