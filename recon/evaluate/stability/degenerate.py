"""Rows 7, 8 and 11: photographs in which there is no depth to find, or no place at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.evaluate.stability.case import TrialCase, make_refuse_case, row
from splatnode.recon.evaluate.stability.corruptions import generate_noise, make_patchwork
from splatnode.recon.evaluate.stability.places import Sampler, TrialImage
from splatnode.recon.evaluate.stability.warps import render_poster_views, render_turned_crops
from splatnode.recon.result.verdict import Code

_NOTHING = (Code.NO_OVERLAP, Code.LOW_TEXTURE, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)


@row(7, "pure rotation")
def pure_rotation(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    count = (3, 5)[sampler.seed % 2]
    yaws, pitches = sampler.rng.uniform(-14.0, 14.0, (2, count))
    crops = render_turned_crops(photo, yaws, pitches)
    # The true centres are one point, so that no published scene is right.
    return make_refuse_case(crops, "turned crops of one photograph", Code.NO_PARALLAX)


@row(7, "recorded rotation")
def tripod_rotation(sampler: Sampler) -> TrialCase:
    """A camera on a tripod, where there is a recording of one; else turned crops of a photograph of the built-in."""
    turned = sampler.places.turned
    if not turned:
        (photo,) = sampler.load_images(1)
        crops = render_turned_crops(photo, np.linspace(-9.0, 9.0, 4), np.zeros(4))
        return make_refuse_case(crops, "crops turned to the side", Code.NO_PARALLAX)
    place = turned[sampler.seed % len(turned)]
    chosen = sorted(sampler.rng.choice(len(place.names), 4, replace=False).tolist())
    return make_refuse_case(place.load_images(chosen), "recorded", Code.NO_PARALLAX, Code.NO_OVERLAP)


@row(8, "poster")
def poster(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    count = (3, 5)[sampler.seed % 2]
    views = render_poster_views(photo, np.linspace(-25.0, 25.0, count), distance=sampler.rng.uniform(1.0, 1.3))
    return make_refuse_case(views, "views of one photograph", Code.PLANAR_ONLY)


@row(11, "every frame from elsewhere")
def one_frame_per_scene(sampler: Sampler) -> TrialCase:
    """Every frame is of a place that is not in the truth: whatever is published is wrong."""
    photos = sampler.load_one_per_scene(4)
    views = [
        replace(photo, image=np.ascontiguousarray(photo.image[:, :: (-1) ** number]), camera=None)
        for number, photo in enumerate(photos)
    ]
    return make_refuse_case(views, "one of each, every second mirrored", *_NOTHING)


@row(11, "pure noise")
def pure_noise(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    frames = [TrialImage(f"noise_{i}.png", generate_noise(480, 640, rng), None) for i in range(4)]
    return make_refuse_case(frames, "", *_NOTHING)


@row(11, "patchwork")
def patches(sampler: Sampler) -> TrialCase:
    """Pieces of real photographs without an order: features everywhere, matches here and there, and no place."""
    images = [photo.image for photo in sampler.load_one_per_scene(4)]
    rng = sampler.rng
    frames = [TrialImage(f"patchwork_{i}.png", make_patchwork(images, 600, 800, 6, rng), None) for i in range(4)]
    return make_refuse_case(frames, "36 pieces each of 4 photographs", *_NOTHING, Code.MOVING_SCENE)
