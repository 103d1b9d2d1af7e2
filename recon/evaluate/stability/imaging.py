"""Rows 12, 13 and 15 to 18 and 23: what light, sensor, shutter and passers-by do to the pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from splatnode.recon.evaluate.stability import pixels
from splatnode.recon.evaluate.stability.case import Case, accepted, either, refused, row
from splatnode.recon.evaluate.stability.pixels import Image
from splatnode.recon.evaluate.stability.places import Photo, Stage
from splatnode.recon.result.verdict import Code


@row(12, "epsilon noise")
def epsilon_noise(stage: Stage) -> Case:
    rng, sigma = stage.rng, 1 + stage.seed % 3
    photos = _changed(stage.photos(4), lambda image: pixels.noisy(image, sigma, rng))
    return accepted(photos, f"{sigma} grey levels of noise")


@row(13, "texture lost in part")
def partly_flat(stage: Stage) -> Case:
    share, side = (0.2, 0.3, 0.4)[stage.seed % 3], 1 + 2 * int(stage.rng.integers(2))
    photos = _changed(stage.photos(4), lambda image: pixels.flattened(image, share, side))
    return accepted(photos, f"{share:.0%} without texture", Code.OK_PARTIAL)


@row(13, "texture mostly lost")
def mostly_flat(stage: Stage) -> Case:
    share, side = (0.5, 0.75)[stage.seed % 2], 1 + 2 * int(stage.rng.integers(2))
    photos = _changed(stage.photos(4), lambda image: pixels.flattened(image, share, side))
    fitting = (Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.PLANAR_ONLY)
    return either(photos, f"{share:.0%} without texture", *fitting)


@row(13, "white wall")
def white_wall(stage: Stage) -> Case:
    rng = stage.rng
    photos = [Photo(f"wall_{i}.png", pixels.white_wall(480, 640, rng), None) for i in range(4)]
    return refused(photos, "", Code.LOW_TEXTURE, Code.TOO_FEW_VIEWS)


@row(15, "motion blur of one frame")
def one_blurred(stage: Stage) -> Case:
    photos, length = stage.photos(5), (5, 11, 21)[stage.seed % 3]
    angle = float(stage.rng.uniform(0, 180))
    photos[2] = replace(photos[2], image=pixels.motion_blurred(photos[2].image, length, angle))
    fitting = (Code.OK_PARTIAL, Code.OUTLIER_VIEW, Code.BLUR)
    return accepted(photos, f"one smeared over {length} px", *fitting)


@row(15, "motion blur of all frames")
def all_blurred(stage: Stage) -> Case:
    length, angles = (5, 11, 21)[stage.seed % 3], iter(stage.rng.uniform(0, 180, 4))
    photos = _changed(stage.photos(4), lambda image: pixels.motion_blurred(image, length, float(next(angles))))
    fitting = (Code.BLUR, Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    return either(photos, f"4 frames smeared over {length} px", *fitting, Code.TOO_FEW_VIEWS)


@row(16, "exposure and white balance")
def exposure(stage: Stage) -> Case:
    rng = stage.rng
    photos = _changed(
        stage.photos(4),
        lambda image: pixels.exposed(
            image, float(2.0 ** rng.uniform(-1, 1)), float(rng.uniform(0.8, 1.25)), rng.uniform(0.8, 1.2, 3)
        ),
    )
    note = "gain 0.5 to 2, gamma, 20 % white balance"
    return accepted(photos, note, Code.OK_PARTIAL)


@row(17, "lens and sensor")
def degraded(stage: Stage) -> Case:
    rng = stage.rng
    name, change = (
        ("60 % vignetting", lambda image: pixels.vignetted(image, 0.6)),
        ("JPEG of quality 20", lambda image: pixels.as_jpeg(image, 20)),
        ("low light", lambda image: pixels.in_low_light(image, 400.0, rng)),
    )[stage.seed % 3]
    return accepted(_changed(stage.photos(4), change), f"{name}")


@row(18, "moving object")
def moving_object(stage: Stage) -> Case:
    """A cut-out of another place that moves by itself, of growing size."""
    share = (0.05, 0.15, 0.3)[stage.seed % 3]
    photos = _with_passer_by(stage, stage.photos(5), share)
    note, fitting = f"{share:.0%} covered", (Code.OK_PARTIAL, Code.MOVING_SCENE)
    return (either if share > 0.2 else accepted)(photos, note, *fitting)


@row(18, "own body in view")
def own_body(stage: Stage) -> Case:
    """The robot's bumper: the lowest rows of every frame are the same."""
    photos, share = stage.photos(4), (0.1, 0.2)[stage.seed % 2]
    body = stage.photos(1, photos)[0].image

    def with_body(image: Image) -> Image:
        rows, width = round(share * image.shape[0]), min(image.shape[1], body.shape[1])
        bumper = body[-rows:, :width]
        return pixels.pasted(image, bumper, np.ones((rows, width), np.float32), 0, image.shape[0] - rows)

    note = f"the lowest {share:.0%} are the robot itself"
    return accepted(_changed(photos, with_body), note, Code.OK_PARTIAL, Code.MOVING_SCENE)


@row(23, "reflection of a lamp")
def highlight(stage: Stage) -> Case:
    """It moves with the camera, and over the scene."""
    rng = stage.rng
    where = rng.uniform(0.3, 0.7, 2)
    photos = _changed(
        stage.photos(4), lambda image: pixels.with_highlight(image, *(where + rng.uniform(-0.05, 0.05, 2)), size=0.2)
    )
    return accepted(photos, "a highlight of a fifth of the width")


def _changed(photos: Sequence[Photo], change: Callable[[Image], Image]) -> list[Photo]:
    return [replace(photo, image=change(photo.image)) for photo in photos]


def _with_passer_by(stage: Stage, photos: Sequence[Photo], share: float) -> list[Photo]:
    """An ellipse of another place's photograph, covering `share` of each frame, on a way of its own."""
    rng = stage.rng
    cutout = stage.photos(1, photos)[0].image
    way = np.cumsum(rng.normal(scale=0.12, size=(len(photos), 2)), axis=0) + rng.uniform(0.3, 0.7, 2)
    result = []
    for photo, (across, down) in zip(photos, np.clip(way, 0.2, 0.8), strict=True):
        height, width = photo.image.shape[:2]
        side = np.sqrt(share * 4 / np.pi)  # of the frame's sides, so that the ellipse covers the share
        size = min(round(side * height), cutout.shape[0]), min(round(side * width), cutout.shape[1])
        left, top = round(across * width - size[1] / 2), round(down * height - size[0] / 2)
        patch = cutout[: size[0], : size[1]]
        result.append(replace(photo, image=pixels.pasted(photo.image, patch, pixels.ellipse(*size), left, top)))
    return result
