"""What is known of a scene's size in metres, as it is configured."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import msgspec

_MAX_METRES = 1_000_000  # of a baseline


class Baseline(NamedTuple):
    """What was measured: the distance of two cameras."""

    first: str  # photograph
    second: str
    metres: float


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    baseline: Baseline | None = None  # two photographs and the metres between their cameras
    further_baselines: tuple[Baseline, ...] = ()  # more of them: they make the scale surer, and check one another
    # Standard deviation of each measured distance, as a share of it
    baseline_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.01
    network: bool = False  # ask Depth Anything V2 Metric Indoor Small, where its weights are
    # Standard deviation of the network's error in a place, all views alike, as a share
    network_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.15

    @property
    def baselines(self) -> tuple[Baseline, ...]:
        return (*(() if self.baseline is None else (self.baseline,)), *self.further_baselines)

    def __post_init__(self) -> None:
        for baseline in self.baselines:
            if not 1 / _MAX_METRES <= baseline.metres <= _MAX_METRES or baseline.first == baseline.second:
                raise ValueError(
                    "a baseline must be two different photographs and a positive distance in metres, up to "
                    f"{_MAX_METRES}, got {', '.join(map(str, baseline))}"
                )
