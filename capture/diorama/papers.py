"""Textures that fill a wall or a front: wall paper, upholstery, a row of books, a door's panels, tiles."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from splatnode.capture.diorama.prints import book, words, write
from splatnode.capture.diorama.textures import Colour, Image, Painter, noise, quantize_colours, shade_colour, texels


def wallpaper(colour: Colour, inks: Sequence[Colour]) -> Painter:
    """Leaves and berries strewn over paper, of all sizes and in all directions, on faint stripes."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        stripes = 0.02 * np.sign(np.sin(2 * np.pi * np.arange(width) / (0.23 * density)))
        image = shade_colour(colour, 1 + stripes + 0.03 * noise(rng, shape, 0.2 * density, 4))
        for _ in range(round(34 * width_m * height_m)):
            at = round(rng.uniform(0, width)), round(rng.uniform(0, height))
            ink = np.array(inks[int(rng.integers(len(inks)))]) * rng.uniform(0.8, 1.15)
            tint = tuple(float(value) for value in np.clip(0.55 * ink + 0.45 * np.array(colour), 0, 255))
            length, turn = rng.uniform(0.02, 0.07) * density, rng.uniform(0, 180)
            axes = max(1, round(length)), max(1, round(length * rng.uniform(0.25, 0.6)))
            cv2.ellipse(image, at, axes, turn, 0, 360, tint, -1, cv2.LINE_AA)
        return image

    return paint


def upholstery(colour: Colour, inks: Sequence[Colour]) -> Painter:
    """Woven cloth: a weave, worn patches, and strokes of other yarns."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        worn = 0.08 * noise(rng, shape, 0.15 * density, 4) + 0.07 * noise(rng, shape, 0.02 * density, 2)
        image = shade_colour(colour, 1 + worn)
        for _ in range(round(12 + 60 * width_m * height_m)):
            start = rng.uniform((0, 0), (width, height))
            end = start + rng.normal(scale=0.06 * density, size=2)
            ink = tuple(float(value) for value in inks[int(rng.integers(len(inks)))])
            points = [tuple(int(value) for value in np.rint(point)) for point in (start, end)]
            cv2.line(image, points[0], points[1], ink, max(1, round(0.008 * density)), cv2.LINE_AA)
        return image

    return paint


def book_row(colours: Sequence[Colour], inks: Sequence[Colour]) -> Painter:
    """Spines of books side by side, some lower than others, dark above them."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = texels(width_m, height_m, density)
        image = np.full((height, width, 3), (38, 32, 30), np.uint8)
        left = 0
        while left < width:
            thickness = max(4, round(rng.uniform(0.025, 0.07) * density))
            tall = round(rng.uniform(0.68, 0.98) * height)
            colour = np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.7, 1.15)
            ink = inks[int(rng.integers(len(inks)))]
            spine = book((float(colour[0]), float(colour[1]), float(colour[2])), ink)
            drawn = spine(rng, thickness / density, tall / density, density)
            right = min(left + thickness, width)
            drawn = cv2.resize(drawn, (thickness, tall), interpolation=cv2.INTER_AREA)
            image[height - tall :, left:right] = drawn[:, : right - left]
            left = right + (round(0.05 * density) if rng.random() < 0.08 else 1)
        return image

    return paint


def drawers(colour: Colour, rows: int, columns: int) -> Painter:
    """A wooden front of panels, each with a grain, a knob and a shadow around it."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        wave = noise(rng, shape, 0.10 * density, 4, 6)
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
        row, column = (y * rows / height).astype(int), (x * columns / width).astype(int)
        tint = rng.normal(size=(rows + 1, columns + 1)).astype(np.float32)[row, column]
        grain = 0.06 * np.sin(2 * np.pi * (y / density / 0.03 + 1.3 * wave + 3 * tint))
        image = shade_colour(colour, 1 + grain + 0.07 * wave + 0.08 * tint)
        for i in range(rows):
            for j in range(columns):
                corner = round(j * width / columns), round(i * height / rows)
                end = round((j + 1) * width / columns) - 1, round((i + 1) * height / rows) - 1
                cv2.rectangle(image, corner, end, (40, 30, 24), max(1, round(0.012 * density)))
                knob = (corner[0] + end[0]) // 2, (corner[1] + end[1]) // 2
                cv2.circle(image, knob, max(1, round(0.018 * density)), (214, 190, 120), -1, cv2.LINE_AA)
        return image

    return paint


def tiles(colours: Sequence[Colour], size: float = 0.3) -> Painter:
    """Stone tiles, each of its own tint and veins, with joints."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        shape = texels(width_m, height_m, density)
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / density / size
        row, column = y.astype(int), x.astype(int)
        chosen = rng.integers(0, len(colours), (row.max() + 1, column.max() + 1))[row, column]
        tint = rng.normal(size=(row.max() + 1, column.max() + 1)).astype(np.float32)[row, column]
        veins = 0.3 * np.exp(-((noise(rng, shape, 0.12 * density, 5) / 0.1) ** 2))
        shade = 1 + 0.07 * tint - veins + 0.04 * noise(rng, shape, 0.02 * density, 3)
        joint = np.minimum.reduce([x - column, column + 1 - x, y - row, row + 1 - y]) < 0.02
        return quantize_colours(np.array(colours, np.float32)[chosen] * np.where(joint, 0.62, shade)[..., None])

    return paint


def screen(ink: Colour) -> Painter:
    """A monitor that shows windows with text."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        image = shade_colour((52, 84, 112), 1 + 0.25 * noise(rng, shape, 0.15 * density, 4))
        for _ in range(3):
            left, top = rng.uniform((0.03, 0.05), (0.5, 0.5)) * (width, height)
            right, bottom = left + 0.45 * width, top + 0.45 * height
            cv2.rectangle(image, (round(left), round(top)), (round(right), round(bottom)), (236, 236, 230), -1)
            for line in range(4):
                write(image, words(rng, 3), left + 3, top + (line + 1) * 0.1 * height, 0.36 * width, ink, 1.5)
        return image

    return paint


def abstract(paper: Colour, inks: Sequence[Colour]) -> Painter:
    """A print of discs, bars and brush strokes, no two alike."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        image = shade_colour(paper, 1 + 0.03 * noise(rng, shape, 0.1 * density, 4))
        for _ in range(int(rng.integers(9, 16))):
            x, y = (round(value) for value in rng.uniform((0, 0), (width, height)))
            ink = tuple(float(value) for value in inks[int(rng.integers(len(inks)))])
            size = rng.uniform(0.06, 0.24) * min(width, height)
            kind = int(rng.integers(4))
            if kind == 0:
                cv2.circle(image, (x, y), round(size), ink, -1, cv2.LINE_AA)
            elif kind == 1:
                cv2.circle(image, (x, y), round(size), ink, max(1, round(size / 4)), cv2.LINE_AA)
            else:
                turn, long = rng.uniform(0, np.pi), size * rng.uniform(1, 3)
                end = round(x + long * np.cos(turn)), round(y + long * np.sin(turn))
                cv2.line(image, (x, y), end, ink, max(1, round(size / (2 if kind == 2 else 7))), cv2.LINE_AA)
        return quantize_colours(image * (1 + 0.05 * noise(rng, shape, 0.03 * density, 3))[..., None])

    return paint
