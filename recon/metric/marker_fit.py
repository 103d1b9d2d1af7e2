"""Where the corners of a printed marker are, to hundredths of a pixel: the marker as it must look is fitted to it.

All edges of all its bits are used. The fit has the corners, the blur, and how grey levels mix at an edge (a camera's
gamma and a printer's ink make black fields look smaller or larger than they are); black, white and a slope of the light
are solved for at each step.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.float32]  # (H, W)

_AS_FITTED_PX = 64.0  # longest side of a marker: larger ones are shrunk, and known well enough
_MARGIN = 0.5  # of a bit: the white around the marker that is compared
_FINE = 4  # samples a pixel, across and down
_STEPS, _HALVINGS, _SETTLED_PX = 12, 4, 2e-3
_BLURS_PX = (0.25, 2.5)  # least and most standard deviation
_LOG_SIGMA = 0.7  # of the prior of blur and mixing
_FIRST_BLUR_PX = 0.6
_NUDGES = np.full(10, 0.05)  # of the parameters, for derivatives: pixels, and logarithms
_NUM_PARAMETERS = 14  # with the light's four
_FLOOR_PX = 0.03  # standard deviation of a corner that is added: paper is not quite flat, a lens not quite known


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of a marker's black square: left upper, right upper, right lower, left lower, as it is printed."""

    pixels: Array  # (4, 2), top-left pixel centre at (0.5, 0.5)
    covariance: Array  # (8, 8) of pixels.ravel()
    correlation: float  # of the picture with the marker as it must look, -1 to 1


def refine_corners(picture: Grey, bits: npt.NDArray[np.bool_], corners: Array) -> Corners | None:
    """The corners near `corners` (4, 2); None where the marker or the white around it is partly outside the picture.

    `bits` (B, B) are True where the marker is white, its black border included.
    """
    sides = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1)
    shrink = max(1, round(float(sides.max()) / _AS_FITTED_PX))
    window = _window(corners, float(sides.max()) * (0.5 + _MARGIN) / len(bits), shrink, picture.shape)
    if window is None:
        return None
    left, top, width, height = window
    patch = picture[top : top + height * shrink, left : left + width * shrink]
    patch = np.asarray(cv2.resize(patch, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    within = (corners - (left, top)) / shrink
    moved, covariance, correlation = _fit_corners(patch, bits, within)
    return Corners(shrink * moved + (left, top), shrink**2 * covariance, correlation)


def _window(corners: Array, around: float, shrink: int, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
    """Left, top, and width and height over `shrink`, of the pixels around the corners; None beyond the picture."""
    least, most = np.floor(corners.min(0) - around), np.ceil(corners.max(0) + around)
    size = np.ceil((most - least) / shrink).astype(int)
    if (least < 0).any() or (least + size * shrink > (shape[1], shape[0])).any():
        return None
    return int(least[0]), int(least[1]), int(size[0]), int(size[1])


def _fit_corners(patch: Grey, bits: npt.NDArray[np.bool_], start: Array) -> tuple[Array, Array, float]:
    """Corners (4, 2), their covariance (8, 8), and the correlation: Gauss-Newton with halved steps."""
    texture, per_bit = _texture(bits, start)
    used = _mask_used_pixels(start, len(bits), patch.shape)
    before: Array = np.array([*start.ravel(), np.log(_FIRST_BLUR_PX), 0.0])
    held = np.array([*[0.0] * 8, 1.0, 1.0]) / _LOG_SIGMA  # blur and mixing, by their prior

    def differences(values: Array) -> Array:
        return _differences(patch, used, texture, per_bit, values)

    def derivatives(values: Array, now: Array) -> Array:
        nudged = [differences(values + nudge) - now for nudge in np.diag(_NUDGES)]
        return np.stack(nudged, 1) / _NUDGES

    def cost(values: Array, now: Array, noise: float) -> float:
        return float((now**2).sum() / noise**2 + ((held * (values - before)) ** 2).sum())

    values, now = before, differences(before)
    for _ in range(_STEPS):
        noise = _noise(now)
        rows = np.vstack([derivatives(values, now) / noise, np.diag(held)])
        residuals = np.concatenate([now / noise, held * (values - before)])
        step = -np.asarray(np.linalg.lstsq(rows, residuals, rcond=None)[0], np.float64)
        step[:8] = np.clip(step[:8], -1.0, 1.0)
        for _ in range(_HALVINGS):
            later = values + step
            later[8] = np.clip(later[8], *np.log(_BLURS_PX))
            then = differences(later)
            if cost(later, then, noise) <= cost(values, now, noise):
                values, now = later, then
                break
            step = 0.5 * step
        if np.abs(step[:8]).max() < _SETTLED_PX:
            break
    jacobian = derivatives(values, now)
    information = jacobian.T @ jacobian / _noise(now) ** 2 + np.diag(held**2)
    covariance = np.linalg.pinv(information)[:8, :8] + _FLOOR_PX**2 * np.eye(8)
    explained = 1.0 - float((now**2).mean()) / max(float(np.var(patch[used])), 1e-9)
    return values[:8].reshape(4, 2), np.asarray(covariance, np.float64), max(0.0, explained) ** 0.5


def _noise(differences: Array) -> float:
    """Standard deviation of a pixel, grey levels; never 0."""
    return float(np.sqrt((differences**2).sum() / max(len(differences) - _NUM_PARAMETERS, 1))) + 1e-3


def _texture(bits: npt.NDArray[np.bool_], corners: Array) -> tuple[Grey, int]:
    """The marker with a white bit around it, about as fine as the samples, and its texels a bit."""
    side = np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean()
    per_bit = int(np.clip(round(side / len(bits) * _FINE), 4, 64))
    return np.kron(np.pad(bits, 1, constant_values=True), np.ones((per_bit, per_bit))).astype(np.float32), per_bit


def _mask_used_pixels(corners: Array, bits: int, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """(h, w) the pixels in the marker and in the white around it."""
    grown = corners.mean(0) + (corners - corners.mean(0)) * (1.0 + 2.0 * _MARGIN / bits)
    inside = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(grown - 0.5).astype(np.int32), 1)
    return inside > 0


def _differences(patch: Grey, used: npt.NDArray[np.bool_], texture: Grey, per_bit: int, values: Array) -> Array:
    """(M,) model less picture at the pixels that are used, black, white and the light's slope solved for."""
    corners, blur, mixing = values[:8].reshape(4, 2), float(np.exp(values[8])), float(np.exp(values[9]))
    size = texture.shape[0]
    square = np.array([[1, 1], [size // per_bit - 1, 1], [size // per_bit - 1] * 2, [1, size // per_bit - 1]]) * per_bit
    # cv2 has the centre of the top-left pixel at (0, 0)
    to_fine = cv2.getPerspectiveTransform((square - 0.5).astype(np.float32), (_FINE * corners - 0.5).astype(np.float32))
    shape = _FINE * patch.shape[1], _FINE * patch.shape[0]
    fine = cv2.warpPerspective(texture, to_fine, shape, flags=cv2.INTER_LINEAR, borderValue=1.0)
    fine = cv2.GaussianBlur(fine, (0, 0), _FINE * blur)
    white = cv2.resize(fine, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_AREA)[used]
    white = np.clip(white.astype(np.float64), 0.0, 1.0) ** mixing
    rows, columns = np.nonzero(used)
    slopes = columns / patch.shape[1] - 0.5, rows / patch.shape[0] - 0.5
    light = np.stack([np.ones_like(white), white, white * slopes[0], white * slopes[1]], 1)
    seen = patch[used].astype(np.float64)
    found, *_ = np.linalg.lstsq(light, seen, rcond=None)
    return np.asarray(light @ found - seen if found[1] > 0.0 else seen.mean() - seen, np.float64)  # never a negative
