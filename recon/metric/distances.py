"""The unit by the measured distance of two cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from splatnode.recon.metric.config import Baseline
from splatnode.recon.metric.measurement import TWO_SIDED_95, Measurement
from splatnode.recon.result.snapshot import CameraEstimate


def estimate_scale_from_distance(
    cameras: Sequence[CameraEstimate], baseline: Baseline, sigma: float
) -> Measurement | str:
    """The unit, or a sentence why these cameras do not give it.

    `sigma` is the standard deviation of the measured distance, as a share of it. To its error comes that of the
    cameras' distance in the scene, by their bounds.
    """
    known = {camera.name: camera for camera in cameras}
    missing = [name for name in baseline[:2] if name not in known]
    if missing:
        return f"the baseline's photograph {missing[0]} is not among the cameras of the scene"
    first, second = (known[name] for name in baseline[:2])
    distance = float(np.linalg.norm(first.T_world_camera[:3, 3] - second.T_world_camera[:3, 3]))
    source = f"{baseline.metres:g} m between {baseline.first} and {baseline.second}"
    bound = math.hypot(*(camera.bounds.centre if camera.bounds else 0.0 for camera in (first, second)))
    if distance <= bound:
        return f"{source} were given, but the photographs do not tell these two cameras apart"
    of_scene = bound / TWO_SIDED_95 / distance
    return Measurement(baseline.metres / distance, math.hypot(sigma, of_scene), source)
