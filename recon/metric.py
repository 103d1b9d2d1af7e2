"""Metres for a scene that photographs leave without a unit: from a known distance, or from a network that knows rooms.

Where neither can be had the scene stays relative, and its scale says why.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.networks.crop import Crop
from splatnode.recon.networks.depth_anything import load_metric
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.scale import Scale
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot

Map = npt.NDArray[np.float32]
_VIEWS = 6  # that the network is asked about
_OPAQUE = 0.9
_ENOUGH = 0.1  # of a view's pixels
_MAX_METRES = 1_000_000  # of a baseline
_MOST_SPREAD = 0.3  # between views: beyond, the network does not know this place


class Baseline(NamedTuple):
    """What was measured: the distance of two cameras."""

    first: str  # photograph
    second: str
    metres: float


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    # Two photographs and the metres between their cameras; it comes before the network
    baseline: Baseline | None = None
    network: bool = False  # ask Depth Anything V2 Metric Indoor Small, where its weights are

    def __post_init__(self) -> None:
        if self.baseline is None:
            return
        if not 1 / _MAX_METRES <= self.baseline.metres <= _MAX_METRES or self.baseline.first == self.baseline.second:
            raise ValueError(
                "a baseline must be two different photographs and a positive distance in metres, up to "
                f"{_MAX_METRES}, got {', '.join(map(str, self.baseline))}"
            )


@dataclass(frozen=True)
class MetricDepth:
    """A network that tells the depth of photographs in metres."""

    name: str
    depth: Callable[[npt.NDArray[np.uint8]], tuple[Map, Crop]]  # image (h, w, 3) -> metres (H, W), and their crop


def in_metres(snapshot: Snapshot, config: Config) -> Snapshot:
    """The snapshot with lengths in metres where `config` gives them a unit; as it is where nothing was asked for."""
    if not len(snapshot.cameras) or not (config.baseline or config.network):
        return snapshot
    if config.baseline is not None:
        factor, source = _by_baseline(snapshot.cameras, config.baseline)
    else:
        loaded = load_metric()
        if loaded is None:
            factor, source = None, "no weights of the metric network: splatnode weights list tells where they are had"
        else:
            factor, source = by_network(snapshot, MetricDepth(loaded.name, loaded))
    if factor is None:
        return replace(snapshot, scale=Scale(False, source))
    return replace(_scaled(snapshot, factor), scale=Scale(True, source))


def by_network(snapshot: Snapshot, network: MetricDepth) -> tuple[float | None, str]:
    """Metres for each unit of the scene, and where they come from; None where the network's views disagree."""
    step = -(-len(snapshot.cameras) // _VIEWS)
    ratios = [_ratio(snapshot, camera, network) for camera in snapshot.cameras[::step]]
    logs = np.log([ratio for ratio in ratios if ratio is not None])
    if not len(logs):
        return None, f"{network.name} was asked, and no view shows enough of the scene to compare"
    spread = float(np.exp(1.48 * np.median(np.abs(logs - np.median(logs)))) - 1.0)
    if spread > _MOST_SPREAD:
        return None, f"{network.name} was asked, and its {len(logs)} views disagree by {100 * spread:.0f} %"
    return float(np.exp(np.median(logs))), f"{network.name}, {len(logs)} views that agree to {100 * spread:.0f} %"


def _by_baseline(cameras: tuple[CameraEstimate, ...], baseline: Baseline) -> tuple[float | None, str]:
    known = {camera.name: camera for camera in cameras}
    missing = [name for name in baseline[:2] if name not in known]
    if missing:
        return None, f"the baseline's photograph {missing[0]} is not among the cameras of the scene"
    first, second = (known[name] for name in baseline[:2])
    distance = float(np.linalg.norm(first.T_world_camera[:3, 3] - second.T_world_camera[:3, 3]))
    source = f"{baseline.metres:g} m between {baseline.first} and {baseline.second}"
    of_first, of_second = (camera.bounds.centre if camera.bounds else 0.0 for camera in (first, second))
    bound = float(np.hypot(of_first, of_second))
    if distance <= bound:
        return None, f"{source} were given, but the photographs do not tell these two cameras apart"
    certainty = f", known to {100 * bound / distance:.1g} %" if bound else ""
    return baseline.metres / distance, source + certainty


def _ratio(snapshot: Snapshot, camera: CameraEstimate, network: MetricDepth) -> float | None:
    """Metres by scene unit in the median of a view's pixels; None where too few can be compared."""
    metres, crop = network.depth(snapshot.images[camera.name])
    shape = camera.T_world_camera, camera.K, camera.width, camera.height
    picture = render_arrays(snapshot.gaussians, *shape, channels=("depth", "alpha"))
    rows, columns = np.mgrid[: crop.height, : crop.width]
    there = np.floor(crop.to_photograph(np.stack([columns, rows], -1) + 0.5)).astype(np.int64)
    depth, alpha = (channel[there[..., 1], there[..., 0]] for channel in (picture.depth, picture.alpha))
    both = (alpha > _OPAQUE) & (depth > 0) & (metres > 0)
    return float(np.median(metres[both] / depth[both])) if both.mean() > _ENOUGH else None


def _scaled(snapshot: Snapshot, factor: float) -> Snapshot:
    def moved(camera: CameraEstimate) -> CameraEstimate:
        T_world_camera = camera.T_world_camera.copy()
        T_world_camera[:3, 3] *= factor
        bounds = camera.bounds and camera.bounds.scaled(factor)
        return replace(camera, T_world_camera=T_world_camera, bounds=bounds)

    gaussians = snapshot.gaussians
    larger = replace(
        gaussians,
        means=(gaussians.means * factor).astype(np.float32),
        scales=(gaussians.scales * factor).astype(np.float32),
    )
    landmarks = snapshot.landmarks and snapshot.landmarks.moved(factor, np.eye(3), np.zeros(3), metric=True)
    return replace(snapshot, cameras=tuple(map(moved, snapshot.cameras)), gaussians=larger, landmarks=landmarks)
