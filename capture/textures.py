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


# Textures of printed things: posters, cartons, books. Painted like the materials of `textures.py`.

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


# Textures that fill a wall or a front: wall paper, upholstery, a row of books, a door's panels, tiles.


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
