"""Rows 7, 8 and 11: photographs in which there is no depth to find, or no place at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.evaluate.stability.case import Case, refused, row
from splatnode.recon.evaluate.stability.corruptions import patchwork, static_noise
from splatnode.recon.evaluate.stability.places import Photo, Sampler
from splatnode.recon.evaluate.stability.warps import poster_views, turned_crops
from splatnode.recon.result.verdict import Code

_NOTHING = (Code.NO_OVERLAP, Code.LOW_TEXTURE, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)


@row(7, "pure rotation")
def pure_rotation(sampler: Sampler) -> Case:
    (photo,) = sampler.photos(1)
    count = (3, 5)[sampler.seed % 2]
    yaws, pitches = sampler.rng.uniform(-14.0, 14.0, (2, count))
    crops = turned_crops(photo, yaws, pitches)
    # The true centres are one point, so that no published scene is right.
    return refused(crops, "turned crops of one photograph", Code.NO_PARALLAX)


@row(7, "recorded rotation")
def recorded_rotation(sampler: Sampler) -> Case:
    """A camera on a tripod, where there is a recording of one; else turned crops of a photograph of the built-in."""
    turned = sampler.places.turned
    if not turned:
        (photo,) = sampler.photos(1)
        crops = turned_crops(photo, np.linspace(-9.0, 9.0, 4), np.zeros(4))
        return refused(crops, "crops turned to the side", Code.NO_PARALLAX)
    place = turned[sampler.seed % len(turned)]
    chosen = sorted(sampler.rng.choice(len(place.names), 4, replace=False).tolist())
    return refused(place.photos(chosen), "recorded", Code.NO_PARALLAX, Code.NO_OVERLAP)


@row(8, "poster")
def poster(sampler: Sampler) -> Case:
    (photo,) = sampler.photos(1)
    count = (3, 5)[sampler.seed % 2]
    views = poster_views(photo, np.linspace(-25.0, 25.0, count), distance=sampler.rng.uniform(1.0, 1.3))
    return refused(views, "views of one photograph", Code.PLANAR_ONLY)


@row(11, "every frame from elsewhere")
def from_elsewhere(sampler: Sampler) -> Case:
    """Every frame is of a place that is not in the truth: whatever is published is wrong."""
    photos = sampler.one_of_each(4)
    views = [
        replace(photo, image=np.ascontiguousarray(photo.image[:, :: (-1) ** number]), camera=None)
        for number, photo in enumerate(photos)
    ]
    return refused(views, "one of each, every second mirrored", *_NOTHING)


@row(11, "pure noise")
def pure_noise(sampler: Sampler) -> Case:
    rng = sampler.rng
    frames = [Photo(f"noise_{i}.png", static_noise(480, 640, rng), None) for i in range(4)]
    return refused(frames, "", *_NOTHING)


@row(11, "patchwork")
def patches(sampler: Sampler) -> Case:
    """Pieces of real photographs without an order: features everywhere, matches here and there, and no place."""
    images = [photo.image for photo in sampler.one_of_each(4)]
    rng = sampler.rng
    frames = [Photo(f"patchwork_{i}.png", patchwork(images, 600, 800, 6, rng), None) for i in range(4)]
    return refused(frames, "36 pieces each of 4 photographs", *_NOTHING, Code.MOVING_SCENE)
