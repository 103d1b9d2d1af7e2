"""Textures of printed things: posters, cartons, books. Painted like the materials of `textures.py`."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from splatnode.capture.diorama.textures import Colour, Image, Painter, noise, quantize_colours, shade_colour, texels

_VOCABULARY = (
    "light field view scene depth north river orbit lens sun paper garden stone harbour window signal atlas motion "
    "colour cloud summer granite forest echo violet copper meadow comet lantern island marble winter valley prism"
)


def words(rng: np.random.Generator, count: int) -> str:
    """`count` different words."""
    return " ".join(str(word) for word in rng.choice(_VOCABULARY.split(), count, replace=False))


def write(image: Image, text: str, left: float, baseline: float, width: float, colour: Colour, bold: float = 2) -> None:
    """Draws `text`, `width` texels wide, in place; returns nothing."""
    (unit, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 1)
    scale = width / max(unit, 1)
    origin = round(left), round(baseline)
    thickness = max(1, round(bold * scale))
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_DUPLEX, scale, colour, thickness, cv2.LINE_AA)


def poster(paper: Colour, inks: Sequence[Colour]) -> Painter:
    """A printed poster: a landscape of layered hills under a disc, a title and lines of small print."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = texels(width_m, height_m, density)
        image = np.full((height, width, 3), np.array(paper), np.uint8)
        margin = round(0.07 * width)
        top, bottom = margin, round(0.66 * height)
        picture = image[top:bottom, margin : width - margin]
        rows, columns = picture.shape[:2]
        fade = np.linspace(0, 1, rows)[:, None, None]
        picture[:] = quantize_colours(
            np.broadcast_to((1 - fade) * np.array(inks[0]) + fade * np.array(paper), picture.shape)
        )
        centre = round(rng.uniform(0.25, 0.75) * columns), round(rng.uniform(0.22, 0.4) * rows)
        cv2.circle(picture, centre, round(rng.uniform(0.13, 0.2) * columns), inks[1], -1, cv2.LINE_AA)
        for layer, ink in enumerate(inks[2:]):
            crest = noise(rng, (1, columns), 0.5 * columns)
            line = (0.45 + 0.17 * layer) * rows + 0.07 * rows * crest[0]
            below = np.arange(rows)[:, None] > line
            shade = 1 + 0.10 * noise(rng, (rows, columns), 0.06 * density, 4)
            picture[below] = quantize_colours(shade[..., None] * np.array(ink))[below]
        write(image, words(rng, 2).upper(), margin, 0.775 * height, width - 2 * margin, inks[-1], 3)
        for line in range(5):
            share = rng.uniform(0.72, 1.0) if line < 4 else 0.45
            baseline = (0.835 + 0.033 * line) * height
            write(image, words(rng, 6), margin, baseline, share * (width - 2 * margin), inks[-1], 1.5)
        return quantize_colours(image * (1 + 0.02 * noise(rng, (height, width), 0.2 * density))[..., None])

    return paint


def carton(colour: Colour, ink: Colour) -> Painter:
    """Cardboard: faint ribs, a strip of tape, a stamp and a label with a bar code."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        height, width = shape = texels(width_m, height_m, density)
        ribs = 0.02 * np.sin(2 * np.pi * np.arange(width) / (0.008 * density))
        image = shade_colour(colour, 1 + ribs + 0.05 * noise(rng, shape, 0.09 * density, 5))
        tape = slice(round(0.45 * width), round(0.55 * width))
        image[: round(0.22 * height), tape] = quantize_colours(image[: round(0.22 * height), tape] * 0.80 + 26.0)
        write(image, words(rng, 1).upper(), 0.08 * width, 0.50 * height, 0.52 * width, ink, 3)
        write(image, words(rng, 3), 0.08 * width, 0.62 * height, 0.6 * width, ink, 1.5)
        for arrow in (0.78, 0.88):
            tip = np.array([arrow * width, 0.30 * height])
            size = 0.035 * width
            points = tip + size * np.array([[0, 0], [1, 1.2], [0.4, 1.2], [0.4, 3], [-0.4, 3], [-0.4, 1.2], [-1, 1.2]])
            cv2.fillPoly(image, [np.rint(points).astype(np.int32)], ink, cv2.LINE_AA)
        label = image[round(0.68 * height) : round(0.93 * height), round(0.08 * width) : round(0.62 * width)]
        label[:] = (236, 233, 224)
        bars = np.repeat(rng.random(60) < 0.5, -(-label.shape[1] // 60))[: label.shape[1]]
        rows = slice(round(0.12 * label.shape[0]), round(0.58 * label.shape[0]))
        label[rows][:, bars] = (40, 38, 38)
        write(label, words(rng, 3), 0.06 * label.shape[1], 0.86 * label.shape[0], 0.85 * label.shape[1], (50, 48, 48))
        return image

    return paint


def book(colour: Colour, ink: Colour) -> Painter:
    """A cloth cover with a title; on a narrow face, the title runs along the spine."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
        if height_m > 2 * width_m:
            return np.ascontiguousarray(np.rot90(paint(rng, height_m, width_m, density), -1))
        height, width = shape = texels(width_m, height_m, density)
        image = shade_colour(colour, 1 + 0.06 * noise(rng, shape, 0.03 * density, 4))
        for edge in (0.05, 0.93):
            image[:, round(edge * width) : round((edge + 0.02) * width) + 1] = np.array(ink, np.uint8)
        write(image, words(rng, 2).upper(), 0.14 * width, 0.62 * height, 0.7 * width, ink, 2)
        if height > 0.5 * width:
            write(image, words(rng, 2), 0.14 * width, 0.85 * height, 0.45 * width, ink, 1.5)
        return image

    return paint


def pages(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Image:
    """The cut edge of a book."""
    height, width = texels(width_m, height_m, density)
    lines = rng.normal(size=(height, 1)) if width > height else rng.normal(size=(1, width))
    return quantize_colours(np.array([226, 216, 192]) * (1 + 0.05 * np.broadcast_to(lines, (height, width)))[..., None])
