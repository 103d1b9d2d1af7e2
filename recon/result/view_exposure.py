"""The exposure of a novel view: gains interpolated from those of the training views, and its lens's vignetting.

An automatic exposure and a white balance follow where a camera is and where it looks. Log gains of the training views
are a Gaussian process over their poses, and over time where all have one: a mean, a part that changes smoothly, and a
part of each view's own. How far and how fast it changes is not known: all choices on a grid are averaged, each with its
marginal likelihood (Rasmussen and Williams 2006, chapter 5), so that few views claim no more than they can.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.snapshot import CameraEstimate

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

# Vignetting: exp(-falloff r^2) of the light in the middle, where r is 1 at the corners.


def compute_squared_radius(x: npt.ArrayLike, y: npt.ArrayLike, width: int, height: int) -> Array:
    """Returns the squared distance of pixels at x and y from an image's middle: 1 at its corners."""
    across, along = np.asarray(x) + 0.5 - width / 2.0, np.asarray(y) + 0.5 - height / 2.0
    return (across**2 + along**2) / ((width**2 + height**2) / 4.0)


def relative_illumination(falloff: float, width: int, height: int) -> Float32:
    """(h, w) the share of the middle's light that reaches each pixel."""
    across, along = np.meshgrid(np.arange(width), np.arange(height))
    return np.exp(-falloff * compute_squared_radius(across, along, width, height)).astype(np.float32)


# Gains, interpolated.

MEAN_SIGMA = 1.0  # of the prior of the views' common log gain
AMPLITUDES = (0.01, 0.03, 0.1, 0.3)  # standard deviations of the smooth part of a log gain
OWN_SHARES = (0.0, 0.3)  # of an amplitude: the standard deviation of each view's own part
REACHES = (2.0, 4.0, 8.0, np.inf)  # lengths, in spacings of the views, over which the smooth part changes
TIME_ALONE = 0.8  # probability that gains change with time alone, where it is known
MIN_SPACING = (1e-2, np.radians(0.5), 0.05)  # of positions (the scene's unit), directions and times (s)
LEAST_SIGMA = 2e-3  # of a view's log gain
MAX_VIEWS = 32  # nearest to the novel view, by which it is told


@dataclass(frozen=True, eq=False)
class ViewGains:
    """Gains of V training views: how much brighter each image is than the scene, by channel."""

    Ts_world_camera: Array  # (V, 4, 4)
    logs: Array  # (V, 3)
    sigmas: Array  # (V, 3) standard deviations of `logs`
    times_s: Array | None = None  # (V,) on one clock; None: not all are known


@dataclass(frozen=True, eq=False)
class InterpolatedGains:
    """The gains of a novel view."""

    logs: Array  # (3,)
    sigmas: Array  # (3,) standard deviations of `logs`, with the part that a view has of its own

    @property
    def gains(self) -> Array:
        """Returns red, green and blue over the scene's light."""
        return np.exp(self.logs)


def collect_view_gains(
    cameras: Sequence[CameraEstimate],
    gains: Mapping[str, Sequence[float]],
    sigmas: Mapping[str, Sequence[float]],
) -> ViewGains:
    """Collects the gains of published cameras by name; a camera without gains has the scene's light.

    `sigmas` are of log gains; a view without has LEAST_SIGMA.
    """
    logs = np.log([gains.get(camera.name, (1.0, 1.0, 1.0)) for camera in cameras]).reshape(-1, 3)
    least = (LEAST_SIGMA,) * 3
    known = np.array([sigmas.get(camera.name, least) for camera in cameras], np.float64).reshape(-1, 3)
    stamps = [camera.captured_at for camera in cameras]
    clocks = {stamp and stamp.clock for stamp in stamps}
    times = np.array([stamp.ns / 1e9 for stamp in stamps if stamp]) if len(clocks) == 1 and None not in clocks else None
    return ViewGains(np.array([camera.T_world_camera for camera in cameras]).reshape(-1, 4, 4), logs, known, times)


def interpolate_gains(known: ViewGains, T_world_camera: Array, time_s: float | None = None) -> InterpolatedGains:
    """Interpolates the gains of a view at `T_world_camera` (4, 4), taken at `time_s` on the views' clock.

    Where no view differs from the scene, neither does this one; far from all views it has their mean, and the sigma of
    what it may be. Raises ValueError without views.
    """
    if not len(known.logs):
        raise ValueError("gains of at least one view must be known to interpolate them")
    distances = _measure_distances(known, T_world_camera, time_s)
    nearest = np.sort(np.argsort(sum(each[-1, :-1] ** 2 for each in distances), kind="stable")[:MAX_VIEWS])
    rows = np.append(nearest, -1)
    distances = [each[np.ix_(rows, rows)] for each in distances]
    logs = known.logs[nearest]
    sigma = np.maximum(np.sqrt((known.sigmas[nearest] ** 2).mean(axis=1)), LEAST_SIGMA)
    means, variances, evidence = _predict_all(distances, logs, sigma)
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = weights @ means
    spread = weights @ (variances[:, None] + (means - mean) ** 2)
    return InterpolatedGains(mean, np.sqrt(spread))


def _measure_distances(known: ViewGains, T_world_camera: Array, time_s: float | None) -> list[Array]:
    """Measures distances (V + 1, V + 1) of positions, directions and times, in spacings; the novel view is last."""
    Ts = np.concatenate([known.Ts_world_camera, np.asarray(T_world_camera, np.float64)[None]])
    apart = np.linalg.norm(Ts[:, None, :3, 3] - Ts[:, :3, 3], axis=-1)
    turned = Ts[:, None, :3, :3] - Ts[:, :3, :3]  # of norm sqrt(8) sin(angle / 2): a kernel of angles may be none
    found = [apart, np.linalg.norm(turned, axis=(-2, -1)) / np.sqrt(2.0)]
    if known.times_s is not None and time_s is not None:
        times = np.append(known.times_s, time_s)
        found.append(np.abs(times[:, None] - times))
    return [each / _find_spacing(each[:-1, :-1], least) for each, least in zip(found, MIN_SPACING, strict=False)]


def _find_spacing(distances: Array, least: float) -> float:
    """Finds the median distance (V, V) of a view from its nearest."""
    if len(distances) < 2:
        return least
    return max(float(np.median((distances + np.diag(np.full(len(distances), np.inf))).min(axis=1))), least)


def _predict_all(distances: Sequence[Array], logs: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Predicts the novel view by each of H choices: means (H, 3), variances (H,), and log posterior weights (H,).

    The likelihood is the mean over the channels: what they do is much alike.
    """
    kernels, priors = [], []
    for reaches in itertools.product(REACHES, repeat=len(distances)):
        if not np.isfinite(reaches).any():
            continue
        by_time = len(distances) > 2 and not np.isfinite(reaches[:2]).any()
        priors.append(TIME_ALONE / (len(REACHES) - 1) if by_time else (1.0 - TIME_ALONE) / len(REACHES) ** 3)
        squared = sum((each / reach) ** 2 for each, reach in zip(distances, reaches, strict=True))
        scaled = np.sqrt(3.0 * squared)
        kernels.append((1.0 + scaled) * np.exp(-scaled))  # Matern, 3/2
    choices = list(itertools.product(AMPLITUDES, OWN_SHARES))
    smooth = np.concatenate([MEAN_SIGMA**2 + amplitude**2 * np.array(kernels) for amplitude, _ in choices])
    own = np.repeat([(share * amplitude) ** 2 for amplitude, share in choices], len(kernels))
    noise = own[:, None] + sigma**2
    inner = smooth[:, :-1, :-1] + noise[:, :, None] * np.eye(len(sigma))
    lower = np.linalg.cholesky(inner)
    solved = np.linalg.solve(inner, np.concatenate([np.broadcast_to(logs, (len(inner), *logs.shape)),
                                                    smooth[:, :-1, -1:]], axis=2))  # fmt: skip
    beside = smooth[:, -1, :-1]
    means = np.einsum("hv,hvc->hc", beside, solved[:, :, :3])
    variances = smooth[:, -1, -1] - np.einsum("hv,hv->h", beside, solved[:, :, 3]) + own
    fit = np.einsum("vc,hvc->h", logs, solved[:, :, :3]) / logs.shape[1]
    evidence = -0.5 * fit - np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    return means, np.maximum(variances, 0.0), evidence + np.tile(np.log(priors), len(choices))
