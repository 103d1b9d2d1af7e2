"""What single sources say of a scene's unit, and what they say together.

An error of a length is a factor, so that sources are compared and averaged by the logarithms of what they say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from splatnode.recon.result.scale import TWO_SIDED_95

MAX_DEVIATION = 3.0  # standard deviations by which two sources may differ


@dataclass(frozen=True)
class Measurement:
    """The unit by one source."""

    metres_per_unit: float
    sigma: float  # standard deviation of its logarithm
    source: str

    @property
    def interval_95(self) -> tuple[float, float]:
        """The 95 % interval of the factor from a stated length in metres to the true one."""
        return math.exp(-TWO_SIDED_95 * self.sigma), math.exp(TWO_SIDED_95 * self.sigma)


def combine_measurements(measurements: Sequence[Measurement]) -> Measurement | str:
    """The mean of logarithms, each weighed by the inverse of its variance; of one source, that source.

    Where two sources contradict each other there is no mean, but a sentence that names the two that do most. Which of
    them is wrong cannot be known. Raises ValueError for no source.
    """
    if not measurements:
        raise ValueError("the unit must have a source, got none")
    if len(measurements) == 1:
        return measurements[0]
    first, second = max(combinations(measurements, 2), key=lambda pair: _compute_deviation(*pair))
    if _compute_deviation(first, second) > MAX_DEVIATION:
        ratio = max(first.metres_per_unit, second.metres_per_unit) / min(first.metres_per_unit, second.metres_per_unit)
        return (
            f"{first.source}, contradicts {second.source}: the scales differ by {100 * (ratio - 1):.2g} %, which is "
            f"{_compute_deviation(first, second):.2g} standard deviations; measure both again"
        )
    weights = [each.sigma**-2 for each in measurements]
    logs = [math.log(each.metres_per_unit) for each in measurements]
    mean = sum(weight * log for weight, log in zip(weights, logs, strict=True)) / sum(weights)
    return Measurement(math.exp(mean), sum(weights) ** -0.5, "; ".join(each.source for each in measurements))


def _compute_deviation(first: Measurement, second: Measurement) -> float:
    """How many standard deviations of their difference two sources are apart."""
    difference = math.log(first.metres_per_unit) - math.log(second.metres_per_unit)
    return abs(difference) / math.hypot(first.sigma, second.sigma)
