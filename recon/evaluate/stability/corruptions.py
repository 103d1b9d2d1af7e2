"""Corruptions of an image (H, W, 3) uint8 RGB: what light, sensor, shutter and file do. The camera stays as it was."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Grey = npt.NDArray[np.float32]


def add_noise(image: Image, sigma: float, rng: np.random.Generator) -> Image:
    """Independent noise of standard deviation `sigma` grey levels."""
    return _quantize(image + rng.normal(scale=sigma, size=image.shape))


def apply_motion_blur(image: Image, length_px: int, angle_deg: float) -> Image:
    """A linear smear of `length_px` pixels."""
    kernel = np.zeros((length_px, length_px), np.float32)
    kernel[length_px // 2] = 1.0
    middle = (length_px - 1) / 2.0
    kernel = cv2.warpAffine(
        kernel, cv2.getRotationMatrix2D((middle, middle), angle_deg, 1.0), (length_px, length_px)
    ).astype(np.float32)
    return _quantize(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT))


def change_exposure(image: Image, gain: float, gamma: float, white_balance: npt.NDArray[np.float64]) -> Image:
    """As another exposure, tone curve and white balance (3,) would have shown it; highlights clip."""
    return _quantize(255.0 * np.clip(gain * white_balance * (image / 255.0), 0.0, 1.0) ** gamma)


def apply_vignetting(image: Image, loss: float) -> Image:
    """Darker towards the corners, where the share `loss` of the light is missing."""
    return _quantize(image * (1.0 - loss * _compute_radius(image) ** 2)[..., None])


def compress_jpeg(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def simulate_low_light(image: Image, photons: float, rng: np.random.Generator) -> Image:
    """A quarter of the brightness, with the shot noise of `photons` at white and 2 grey levels of read noise."""
    light = rng.poisson(image / 255.0 * photons) / photons
    return _quantize(0.25 * 255.0 * light + rng.normal(scale=2.0, size=image.shape))


def remove_texture(image: Image, share: float, from_side: int) -> Image:
    """The `share` of the image next to its side (0 left, 1 top, 2 right, 3 bottom) without its texture."""
    turned = np.rot90(image, from_side)
    columns = round(share * turned.shape[1])
    plain = cv2.GaussianBlur(turned[:, :columns], (0, 0), max(turned.shape) / 20.0)
    whole = np.concatenate([plain, turned[:, columns:]], axis=1).astype(np.uint8)
    return np.ascontiguousarray(np.rot90(whole, -from_side))


def render_white_wall(height: int, width: int, rng: np.random.Generator) -> Image:
    """A plain wall under uneven light, with sensor noise."""
    slope = rng.uniform(-15.0, 15.0, 2)
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    light = 200.0 + slope[0] * down + slope[1] * across
    return _quantize(light[..., None] + rng.normal(scale=1.5, size=(height, width, 3)))


def generate_noise(height: int, width: int, rng: np.random.Generator) -> Image:
    return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_patchwork(images: list[Image], height: int, width: int, cells: int, rng: np.random.Generator) -> Image:
    """`cells` x `cells` pieces from random places of random `images`."""
    result = np.zeros((height, width, 3), np.uint8)
    edges = [np.linspace(0, side, cells + 1).astype(int) for side in (height, width)]
    for top, bottom in zip(edges[0][:-1], edges[0][1:], strict=True):
        for left, right in zip(edges[1][:-1], edges[1][1:], strict=True):
            source = images[rng.integers(len(images))]
            y = rng.integers(source.shape[0] - (bottom - top))
            x = rng.integers(source.shape[1] - (right - left))
            result[top:bottom, left:right] = source[y : y + bottom - top, x : x + right - left]
    return result


def paste_patch(image: Image, patch: Image, mask: Grey, left: int, top: int) -> Image:
    """`patch` (h, w, 3) blended in by `mask` (h, w) in [0, 1], its corner at (left, top), which may lie outside."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + patch.shape[1], width), min(top + patch.shape[0], height)
    if x0 >= x1 or y0 >= y1:
        return image
    inside = np.s_[y0 - top : y1 - top, x0 - left : x1 - left]
    weight = mask[inside][..., None]
    result = image.copy()
    result[y0:y1, x0:x1] = _quantize(weight * patch[inside] + (1.0 - weight) * image[y0:y1, x0:x1])
    return result


def make_ellipse_mask(height: int, width: int) -> Grey:
    """(height, width) 1 inside the largest ellipse, with a soft edge of two pixels."""
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.clip((1.0 - np.hypot(down, across)) * min(height, width) / 4.0, 0.0, 1.0).astype(np.float32)


def add_highlight(image: Image, across: float, down: float, size: float) -> Image:
    """A lamp's reflection of `size` times the width, its middle at the shares (across, down) of the image."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    distance = ((x - across * width) ** 2 + (y - down * height) ** 2) / (size * width) ** 2
    return _quantize(image + 400.0 * np.exp(-2.0 * distance)[..., None])


def repeat_left_half(image: Image) -> Image:
    """The left half twice, side by side: every structure has a double."""
    half = image[:, : image.shape[1] // 2]
    return np.concatenate([half, half], axis=1)


def _compute_radius(image: Image) -> npt.NDArray[np.float64]:
    """(H, W) distance from the middle, 1 in the corners."""
    height, width = image.shape[:2]
    down, across = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.hypot(down, across) / np.sqrt(2.0)


def _quantize(values: npt.NDArray) -> Image:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
