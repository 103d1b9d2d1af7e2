"""A rig that is given, against what the images tell of it: which of it is believed, and how long its unit is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from splatnode.capture.rig import Rig, RigCamera
from splatnode.recon.geometry import cross_matrix
from splatnode.recon.registration.rig_poses import LEAST_PROBABILITY

Array = npt.NDArray[np.float64]
Told = Mapping[str, tuple[Array, Array, Array]]  # rotation, centre and covariance in the reference's frame, by camera

_ROUNDS = 20  # of the fit of the scale
_LEAST_BASELINE = 2.0  # sigmas by which two cameras must be apart to tell a scale


@dataclass(frozen=True)
class MountResidual:
    """How far a camera of the given rig is from where the images have it."""

    camera_id: str
    beside: str  # the camera from which both are counted
    degrees: float
    metres: float
    sigma_deg: float  # of both together, by the given sigmas and what the images leave open
    sigma_m: float


@dataclass(frozen=True, eq=False)
class GivenMounts:
    """The given mounts that are believed, in the frame of the reference, metres."""

    believed: Mapping[str, tuple[Array, Array, Array]]
    refuted: tuple[str, ...]
    metres_per_unit: float | None
    reference: str
    residuals: tuple[MountResidual, ...] = ()  # of cameras that are not believed
    is_inverse: bool = False  # the images fit the inverses of all given poses

    def hold(self, camera: str) -> tuple[Array, Array, tuple[float, float]]:
        """Rotation, centre and sigmas by which the adjustment holds a mount, in the unit of the map."""
        if self.metres_per_unit is None or camera not in self.believed:
            return np.eye(3), np.zeros(3), (np.inf, np.inf)
        rotation, centre, covariance = self.believed[camera]
        turn, shift = (float(np.sqrt(np.trace(covariance[b, b]) / 3.0)) for b in (slice(0, 3), slice(3, 6)))
        return rotation.T, centre / self.metres_per_unit, (turn, shift / self.metres_per_unit)

    def fit_scale(self, told: Told) -> tuple[float | None, float]:
        """Metres a unit of the map, and the standard deviation of its logarithm."""
        chosen = {camera: told[camera] for camera in self.believed if camera in told}
        fitted = _fit(chosen, self.believed, list(chosen)) if self.metres_per_unit is not None and chosen else None
        return (None, np.inf) if fitted is None else fitted[:2]


def fit_given_rig(rig: Rig | None, reference: str, told: Told) -> GivenMounts:
    """Which given mounts the images do not contradict: those of all cameras, or of all but the one that is wrong."""
    known = {} if rig is None else {each.camera_id: each for each in rig.cameras if each.matrix is not None}
    names = [camera for camera in (reference, *sorted(told)) if camera in known]
    if len(names) < 2:
        return GivenMounts({}, (), None, reference)
    fits = [chosen for chosen in _choices(names) if _is_consistent(known, told, chosen, reference)]
    best = [chosen for chosen in fits if len(chosen) == len(fits[0])]
    if len(best) != 1:
        residuals = [_measure_residual(known, told, camera, names[0], reference) for camera in names[1:]]
        turned = {camera: _invert(each) for camera, each in known.items()}
        is_inverse = _is_consistent(turned, told, names, reference)
        return GivenMounts({}, tuple(names), None, reference, tuple(residuals), is_inverse)
    believed = _relative_to(known, reference, best[0]) if reference in best[0] else {}
    fitted = _fit(told, believed, list(believed)) if believed else None
    refuted = tuple(camera for camera in names if camera not in best[0])
    first = reference if reference in best[0] else best[0][0]
    residuals = tuple(_measure_residual(known, told, camera, first, reference) for camera in refuted)
    return GivenMounts(believed, refuted, None if fitted is None else fitted[0], reference, residuals)


def _measure_residual(
    known: Mapping[str, RigCamera], told: Told, camera: str, first: str, reference: str
) -> MountResidual:
    """How far the given pose of a camera beside `first` is from the images', in the unit that fits all given ones."""
    given = _relative_to(known, first, list(known))
    seen = {c: told[c] if first == reference else _between(told, first, c, reference)
            for c in given if c == reference or c in told}  # fmt: skip
    lengths = [(float(np.linalg.norm(given[c][1])), float(np.linalg.norm(seen[c][1]))) for c in seen]
    unit = sum(apart for _, apart in lengths)
    scale = sum(metres for metres, _ in lengths) / unit if unit > 0.0 else 0.0
    (R, c, of_seen), (R_given, c_given, of_given) = seen[camera], given[camera]
    both = np.diag([1.0] * 3 + [scale] * 3) @ of_seen @ np.diag([1.0] * 3 + [scale] * 3) + of_given
    turn, shift = (float(np.sqrt(np.trace(both[b, b]) / 3.0)) for b in (slice(0, 3), slice(3, 6)))
    return MountResidual(
        camera,
        first,
        degrees=float(np.degrees(Rotation.from_matrix(R_given @ R.T).magnitude())),
        metres=float(np.linalg.norm(c_given - scale * c)),
        sigma_deg=float(np.degrees(turn)),
        sigma_m=shift,
    )


def _invert(camera: RigCamera) -> RigCamera:
    """The camera with the inverse of its given pose."""
    return replace(camera, T_rig_camera=tuple(np.linalg.inv(_matrix(camera)).ravel().tolist()))


def _choices(names: Sequence[str]) -> list[tuple[str, ...]]:
    """All cameras, then all but one."""
    few = list(combinations(names, len(names) - 1)) if len(names) > 2 else []
    return [tuple(names), *few]


def _is_consistent(known: Mapping[str, RigCamera], told: Told, chosen: Sequence[str], reference: str) -> bool:
    first = reference if reference in chosen else chosen[0]
    given = _relative_to(known, first, chosen)
    seen = told if first == reference else {c: _between(told, first, c, reference) for c in chosen if c != first}
    fitted = _fit(seen, given, list(given))
    if fitted is None:
        # Cameras in one place tell no scale: only how they are turned can be compared.
        return all(_turn_probability(seen[c], given[c]) >= LEAST_PROBABILITY for c in given)
    return fitted[2] >= LEAST_PROBABILITY


def _relative_to(
    known: Mapping[str, RigCamera], first: str, chosen: Sequence[str]
) -> dict[str, tuple[Array, Array, Array]]:
    """The given poses of the other cameras in the frame of `first`, with what both sigmas amount to."""
    found = {}
    base = _matrix(known[first])
    for camera in chosen:
        if camera == first:
            continue
        T = np.linalg.inv(base) @ _matrix(known[camera])
        u, _, vt = np.linalg.svd(T[:3, :3])
        covariance = np.zeros((6, 6))
        turn_of_first = np.radians(known[first].sigma_deg) ** 2
        covariance[:3, :3] = (turn_of_first + np.radians(known[camera].sigma_deg) ** 2) * np.eye(3)
        lever = cross_matrix(T[None, :3, 3])[0]
        covariance[3:, 3:] = (known[first].sigma_m ** 2 + known[camera].sigma_m ** 2) * np.eye(3)
        covariance[3:, 3:] += turn_of_first * lever @ lever.T
        found[camera] = u @ vt, T[:3, 3], covariance
    return found


def _matrix(camera: RigCamera) -> Array:
    if camera.matrix is None:
        raise AssertionError("these cameras have a pose on their rig")
    return camera.matrix


def _between(told: Told, first: str, camera: str, reference: str) -> tuple[Array, Array, Array]:
    """The pose of a camera in the frame of `first`, both told in that of the reference."""
    R, c, covariance = told[first]
    if camera == reference:
        other, centre, of_other = np.eye(3), np.zeros(3), np.zeros((6, 6))
    else:
        other, centre, of_other = told[camera]
    away = centre - c
    by = np.eye(6)
    by[3:, :3] = cross_matrix(away[None])[0]
    turn = np.kron(np.eye(2), R.T)
    return R.T @ other, R.T @ away, turn @ (by @ covariance @ by.T + of_other) @ turn.T


def _turn_probability(seen: tuple[Array, Array, Array], given: tuple[Array, Array, Array]) -> float:
    turn = Rotation.from_matrix(seen[0] @ given[0].T).as_rotvec()
    return float(chi2.sf(turn @ np.linalg.solve((seen[2] + given[2])[:3, :3], turn), 3))


def _fit(seen: Told, given: Told, names: Sequence[str]) -> tuple[float, float, float] | None:
    """Metres a unit, the standard deviation of its logarithm, and the probability of what is left; None: no scale."""
    cameras = [camera for camera in names if camera in seen]
    if not cameras:
        return None
    lengths = [(float(np.linalg.norm(given[c][1])), float(np.linalg.norm(seen[c][1]))) for c in cameras]
    apart = [metres for c, (metres, _) in zip(cameras, lengths, strict=True)
             if metres > _LEAST_BASELINE * float(np.sqrt(np.trace(given[c][2][3:, 3:]) / 3.0))]  # fmt: skip
    unit = sum(unit for _, unit in lengths)
    if not apart or unit <= 0.0:
        return None
    scale = sum(metres for metres, _ in lengths) / unit
    information, squared = 0.0, 0.0
    for _ in range(_ROUNDS):
        top, information, squared = 0.0, 0.0, 0.0
        for camera in cameras:
            (R, c, of_seen), (R_given, c_given, of_given) = seen[camera], given[camera]
            units = np.diag([1.0] * 3 + [scale] * 3)
            inverse = np.linalg.inv(units @ of_seen @ units + of_given)
            error = np.concatenate([Rotation.from_matrix(R_given @ R.T).as_rotvec(), c_given - scale * c])
            by_log = np.concatenate([np.zeros(3), scale * c])
            top += by_log @ inverse @ error
            information += by_log @ inverse @ by_log
            squared += error @ inverse @ error
        if information <= 0.0:
            return None
        step = float(np.clip(top / information, -1.0, 1.0))
        scale *= float(np.exp(step))
        if abs(step) < 1e-9:
            break
    left = max(1, 6 * len(cameras) - 1)
    return scale, float(information**-0.5), float(chi2.sf(squared, left))
