"""The unit by a network that knows rooms: it tells the depth of photographs in metres."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.metric.measurement import Measurement
from splatnode.recon.networks.crop import Crop
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot

Map = npt.NDArray[np.float32]
_VIEWS = 6  # that the network is asked about
_OPAQUE = 0.9
_ENOUGH = 0.1  # of a view's pixels
_MOST_SPREAD = 0.3  # between views: beyond, the network does not know this place


@dataclass(frozen=True)
class MetricDepth:
    """A network that tells the depth of photographs in metres."""

    name: str
    depth: Callable[[npt.NDArray[np.uint8]], tuple[Map, Crop]]  # image (h, w, 3) -> metres (H, W), and their crop


def estimate_scale_from_network(snapshot: Snapshot, network: MetricDepth, sigma: float) -> Measurement | str:
    """The unit, or a sentence why the network does not give it: its views disagree, or show too little.

    `sigma` is the standard deviation, as a share, of an error that all views of a place have alike.
    """
    step = -(-len(snapshot.cameras) // _VIEWS)
    ratios = [_measure_ratio(snapshot, camera, network) for camera in snapshot.cameras[::step]]
    logs = np.log([ratio for ratio in ratios if ratio is not None])
    if not len(logs):
        return f"{network.name} was asked, and no view shows enough of the scene to compare"
    spread = float(np.exp(1.48 * np.median(np.abs(logs - np.median(logs)))) - 1.0)
    if spread > _MOST_SPREAD:
        return f"{network.name} was asked, and its {len(logs)} views disagree by {100 * spread:.0f} %"
    source = f"{network.name}, {len(logs)} views that agree to {100 * spread:.0f} %"
    return Measurement(float(np.exp(np.median(logs))), math.hypot(sigma, spread / math.sqrt(len(logs))), source)


def _measure_ratio(snapshot: Snapshot, camera: CameraEstimate, network: MetricDepth) -> float | None:
    """Metres by scene unit in the median of a view's pixels; None where too few can be compared."""
    metres, crop = network.depth(snapshot.images[camera.name])
    shape = camera.T_world_camera, camera.K, camera.width, camera.height
    picture = render_arrays(snapshot.gaussians, *shape, channels=("depth", "alpha"))
    rows, columns = np.mgrid[: crop.height, : crop.width]
    there = np.floor(crop.map_to_image(np.stack([columns, rows], -1) + 0.5)).astype(np.int64)
    depth, alpha = (channel[there[..., 1], there[..., 0]] for channel in (picture.depth, picture.alpha))
    both = (alpha > _OPAQUE) & (depth > 0) & (metres > 0)
    return float(np.median(metres[both] / depth[both])) if both.mean() > _ENOUGH else None
