"""Procedural textures of materials: albedo as 8-bit sRGB, from a random generator, a size in metres and a density.

All are built on fractal noise over several octaves, so that there is detail at every scale and nothing repeats.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]  # (h, w, 3) RGB
Field = npt.NDArray[np.floating]  # (h, w)
Colour = tuple[float, float, float]  # sRGB, 0 to 255
Painter = Callable[[np.random.Generator, float, float, float], Image]  # rng, width_m, height_m, texels per metre


def noise(rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: int = 5, stretch: float = 1) -> Field:
    """(h, w) fractal value noise of mean 0 and standard deviation 1; the coarsest cells are `cell` texels high and
    `stretch` times as wide."""
    height, width = shape
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        size = cell / 2**octave
        if size < 1:
            break
        grid = rng.normal(size=(int(height / size) + 4, int(width / (size * stretch)) + 4)).astype(np.float32)
        scale = np.array([[1 / (size * stretch), 0, 1], [0, 1 / size, 1]], np.float64)
        total += 0.62**octave * cv2.warpAffine(
            grid, scale, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
        )
    return (total - total.mean()) / (total.std() + 1e-6)


def quantize_colours(colours: Field) -> Image:
    """(h, w, 3) rounded to bytes; what is out of range is clipped."""
    return np.clip(np.rint(colours), 0, 255).astype(np.uint8)


def shade_colour(colour: Colour, shade: Field) -> Image:
    """One colour, as bright as `shade` (h, w) says, of mean 1."""
    return quantize_colours(shade[..., None] * _f32(colour))


def _f32(colour: Colour) -> npt.NDArray[np.float32]:
    return np.array(colour, np.float32)


def blank(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
    """For a face that no camera can see: it is neither painted nor lit."""
    return np.zeros((1, 1, 3), np.uint8)


def plain(colour: Colour, contrast: float = 0.03, cell_m: float = 0.12) -> Painter:
    """One colour with a little mottling."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        shade = 1 + contrast * noise(rng, shape, cell_m * density)
        return shade_colour(colour, shade)

    return paint


def plaster(colour: Colour) -> Painter:
    """A painted wall: large faint stains, trowel marks and specks; little to hold on to, as on a real one."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        shade = 1 + 0.030 * noise(rng, shape, 0.9 * density, 3) + 0.022 * noise(rng, shape, 0.05 * density, 5, 2.2)
        specks = noise(rng, shape, 0.022 * density, 2) > 3.0
        return quantize_colours((shade - 0.10 * cv2.blur(specks.astype(np.float32), (3, 3)))[..., None] * _f32(colour))

    return paint


def bricks(colour: Colour, mortar: Colour) -> Painter:
    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / density
        x += 0.004 * noise(rng, shape, 0.07 * density, 3)
        y += 0.003 * noise(rng, shape, 0.07 * density, 3)
        row = np.floor(y / 0.086).astype(int)
        offset = (0.5 * (row % 2) + rng.uniform(-0.04, 0.04, row.max() + 2)[row]).astype(np.float32)
        across = x / 0.25 + offset
        column = np.floor(across).astype(int)
        edge = np.minimum.reduce(
            [(across - column) * 0.25, (column + 1 - across) * 0.25, y - row * 0.086, (row + 1) * 0.086 - y]
        )
        tint = rng.normal(size=(row.max() + 2, column.max() + 3, 3)).astype(np.float32)[row, column + 1]
        shade = 1 + 0.08 * noise(rng, shape, 0.10 * density, 5) + 0.06 * noise(rng, shape, 0.012 * density, 2)
        face = (_f32(colour) * (1 + 0.12 * tint[..., :1]) + 4 * tint) * shade[..., None]
        joint = _f32(mortar) * (1 + 0.10 * noise(rng, shape, 0.03 * density, 4))[..., None]
        filled = np.clip((edge - 0.0055) / 0.004, 0, 1)[..., None]
        bevel = 1 - 0.25 * np.exp(-(((edge - 0.008) / 0.004) ** 2))[..., None]
        return quantize_colours((joint * 0.86 * (1 - filled) + face * filled) * bevel)

    return paint


def planks(colour: Colour, width: float = 0.14, length: float = 1.3) -> Painter:
    """Floorboards along x: a tint, a grain and a few knots by board."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / density
        row = np.floor(y / width).astype(int)
        along = x / length + rng.uniform(0, 1, row.max() + 1).astype(np.float32)[row]
        column = np.floor(along).astype(int)
        board = rng.normal(size=(row.max() + 1, column.max() + 1, 3)).astype(np.float32)[row, column]
        wave = noise(rng, shape, 0.10 * density, 4, 7)
        rings = np.sin(2 * np.pi * (y / 0.021 + 0.9 * wave + 3 * board[..., 2]))
        grain = 0.055 * rings + 0.075 * wave + 0.07 * noise(rng, shape, 0.016 * density, 3, 12)
        knots = np.clip(noise(rng, shape, 0.05 * density, 2, 1.6) - 2.7, 0, 1)
        shade = 1 + 0.12 * board[..., 0] + grain - 0.55 * knots
        gap = np.minimum((y - row * width), (along - column) * length)
        shade *= 1 - 0.62 * np.exp(-((gap / 0.0035) ** 2))
        return quantize_colours(shade[..., None] * (_f32(colour) + board[..., 1:2] * _f32((5.0, 1.0, -5.0))))

    return paint


def wood(colour: Colour) -> Painter:
    """One piece of wood, its grain along the longer side."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        if height_m > width_m:
            return np.ascontiguousarray(np.rot90(paint(rng, height_m, width_m, density)))
        shape = texels(width_m, height_m, density)
        wave = noise(rng, shape, 0.12 * density, 4, 6)
        y = np.arange(shape[0], dtype=np.float32)[:, None] / density
        grain = 0.06 * np.sin(2 * np.pi * (y / 0.03 + 1.2 * wave)) + 0.07 * noise(rng, shape, 0.012 * density, 3, 10)
        return shade_colour(colour, 1 + grain + 0.06 * wave)

    return paint


def rug(colours: Sequence[Colour]) -> Painter:
    """A woven rug: bordered, with rows of motifs of which no two are alike."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        rows, columns = texels(width_m, height_m, 60)
        pattern = np.zeros((rows, columns), np.uint8)
        top = 5
        while top < rows - 5:
            band = int(rng.integers(5, 13))
            pattern[top : top + band] = rng.integers(0, len(colours))
            left = 5
            while left < columns - 5:
                half = int(rng.integers(2, 7))
                y, x = np.mgrid[: min(band, rows - top), : min(2 * half, columns - left)]
                motif = (np.abs(x - half) / half + np.abs(y - band / 2) / (band / 2)) < rng.uniform(0.5, 1.2)
                pattern[top : top + band, left : left + 2 * half][motif] = rng.integers(0, len(colours))
                left += 2 * half + int(rng.integers(0, 3))
            top += band
        for inset, index in ((4, 1), (2, 0)):
            for line in (pattern[:inset], pattern[-inset:], pattern[:, :inset], pattern[:, -inset:]):
                line[:] = index
        shape = texels(width_m, height_m, density)
        woven = cv2.resize(np.array(colours, np.float32)[pattern], shape[::-1], interpolation=cv2.INTER_NEAREST)
        y, x = np.mgrid[: shape[0], : shape[1]] / density
        threads = 0.07 * np.sin(2 * np.pi * x / 0.009) * np.sin(2 * np.pi * y / 0.009)
        return quantize_colours(woven * (1 + threads + 0.09 * noise(rng, shape, 0.05 * density, 5))[..., None])

    return paint


def globe(water: Colour, land: Colour, snow: Colour) -> Painter:
    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        relief = noise(rng, shape, 0.30 * height, 6, 1.4)
        latitude = np.abs(np.linspace(-1, 1, height))[:, None]
        image = np.where((relief > 0.2)[..., None], np.array(land), np.array(water)) * (1 + 0.13 * relief[..., None])
        image = np.where((relief + 5 * (latitude - 0.8) > 1.2)[..., None], np.array(snow), image)
        shore = np.exp(-(((relief - 0.2) / 0.06) ** 2))[..., None]
        image = quantize_colours(image * (1 - 0.35 * shore))
        for meridian in np.linspace(0, width, 13)[1:-1]:
            cv2.line(image, (round(meridian), 0), (round(meridian), height), (70, 70, 80), 1, cv2.LINE_AA)
        for parallel in np.linspace(0, height, 7)[1:-1]:
            cv2.line(image, (0, round(parallel)), (width, round(parallel)), (70, 70, 80), 1, cv2.LINE_AA)
        return image

    return paint


def ball(colours: Sequence[Colour]) -> Painter:
    """Coloured wedges from pole to pole, scuffed, with spots."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        wedge = np.arange(width) * len(colours) * 2 // width % len(colours)
        image = np.repeat(np.array(colours, np.float64)[wedge][None], height, 0)
        image[: round(0.12 * height)] = image[-round(0.12 * height) :] = (238, 234, 226)
        image = quantize_colours(image * (1 + 0.07 * noise(rng, shape, 0.05 * density, 5))[..., None])
        for _ in range(30):
            at = int(rng.integers(0, width)), round(rng.uniform(0.2, 0.8) * height)
            tint = tuple(int(value) for value in np.array(colours[int(rng.integers(len(colours)))]) * 0.8)
            cv2.circle(image, at, int(rng.integers(2, max(3, height // 25))), tint, -1, cv2.LINE_AA)
        return image

    return paint


def glaze(colour: Colour, band: Colour) -> Painter:
    """Pottery: a glaze with crackle, and a painted band of strokes."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        field = noise(rng, shape, 0.06 * density, 5)
        shade = 1 + 0.07 * field - 0.18 * np.exp(-((noise(rng, shape, 0.03 * density, 3) / 0.05) ** 2))
        image = shade_colour(colour, shade)
        for _ in range(round(6 + 40 * width_m)):
            x, y = rng.uniform(0, width), rng.uniform(0.25, 0.6) * height
            dx, dy = rng.uniform(-0.03, 0.03) * width, rng.uniform(0.03, 0.2) * height
            cv2.line(image, (round(x), round(y)), (round(x + dx), round(y + dy)), band, 2, cv2.LINE_AA)
        return image

    return paint


def marble(colour: Colour, vein: Colour) -> Painter:
    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        veins = np.exp(-((noise(rng, shape, 0.22 * density, 6) / 0.16) ** 2)) * 0.6
        veins += np.exp(-((noise(rng, shape, 0.10 * density, 5) / 0.07) ** 2)) * 0.35
        mixed = _f32(colour) + (_f32(vein) - _f32(colour)) * np.clip(veins, 0, 1)[..., None]
        return quantize_colours(mixed * (1 + 0.025 * noise(rng, shape, 0.03 * density))[..., None])

    return paint


def leaf(colour: Colour) -> Painter:
    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        across = np.linspace(0, 14 * np.pi, shape[1])[None] + np.abs(np.linspace(-4, 4, shape[0]))[:, None]
        shade = 1 + 0.10 * np.sin(across) + 0.12 * noise(rng, shape, 0.03 * density, 4)
        return shade_colour(colour, shade)

    return paint


def texels(width_m: float, height_m: float, density: float) -> tuple[int, int]:
    """(h, w) of a texture."""
    return max(8, round(height_m * density)), max(8, round(width_m * density))
