"""What is known of a scene's size in metres, as it is configured."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import msgspec

from splatnode.capture.calibration.board import DICTIONARIES

_MAX_METRES = 1_000_000  # of a baseline
_LARGEST_MARKER = 100.0  # metres


class Baseline(NamedTuple):
    """A measured distance between two cameras."""

    first: str  # photograph
    second: str
    metres: float


class MetricConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    baseline: Baseline | None = None  # two photographs and the metres between their cameras
    further_baselines: tuple[Baseline, ...] = ()  # more of them: they make the scale surer, and check one another
    # Standard deviation of each measured distance, as a share of it
    baseline_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.01
    # Side of the black square of printed markers in the scene, metres; nothing: none are looked for. --marker sets it
    marker_m: Annotated[float, msgspec.Meta(gt=0, le=_LARGEST_MARKER)] | None = None
    # Standard deviation of that side as it was measured, metres: what a ruler can tell
    marker_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=_LARGEST_MARKER)] = 0.0005
    marker_dictionary: str = "4X4_50"  # of OpenCV's ArUco dictionaries, as `splatnode marker` prints, or APRILTAG_36h11
    # Standard deviation of given poses that come without: of each position in each direction, metres
    poses_sigma_m: Annotated[float, msgspec.Meta(gt=0, le=_MAX_METRES)] = 0.01
    poses_sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = 2.0  # and of each orientation about each axis
    # Standard deviation of how far given poses have drifted at the end of the way, as a share of it; 0: not at all
    poses_drift: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.02
    # Standard deviation of an error that all motions between photographs share, as a share of their length: the radius
    # of wheels is not exactly what it is taken for
    motions_shared: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.01
    # Standard deviation of a motion that comes without one: in each direction, as a share of its length
    motions_drift: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.02
    motions_sigma_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = 2.0  # and about each axis, degrees
    # Metres between the cameras of given stereo pairs; nothing: none are given
    stereo_m: Annotated[float, msgspec.Meta(gt=0, le=_MAX_METRES)] | None = None
    # Standard deviation of that distance, metres
    stereo_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=_MAX_METRES)] = 0.0003
    network: bool = False  # ask Depth Anything V2 Metric Indoor Small, where its weights are
    # Standard deviation of the network's error in a place, all views alike, as a share
    network_sigma: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.15

    @property
    def baselines(self) -> tuple[Baseline, ...]:
        return (*(() if self.baseline is None else (self.baseline,)), *self.further_baselines)

    def __post_init__(self) -> None:
        if self.marker_dictionary not in DICTIONARIES:
            raise ValueError(
                f"a marker's dictionary must be one of {', '.join(DICTIONARIES)}; got {self.marker_dictionary[:40]!a}"
            )
        if self.marker_m is not None and self.marker_sigma_m >= 0.5 * self.marker_m:
            raise ValueError(
                f"a marker's side must be known to less than half of itself, got {self.marker_m:g} m with a standard "
                f"deviation of {self.marker_sigma_m:g} m"
            )
        for baseline in self.baselines:
            if not 1 / _MAX_METRES <= baseline.metres <= _MAX_METRES or baseline.first == baseline.second:
                raise ValueError(
                    "a baseline must be two different photographs and a positive distance in metres, up to "
                    f"{_MAX_METRES}, got {', '.join(map(str, baseline))}"
                )
