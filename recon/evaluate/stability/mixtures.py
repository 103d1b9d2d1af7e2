"""Rows 10 and 14: frames of other places, and places that look like each other. Here wrong scenes look right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from splatnode.recon.evaluate.stability import corruptions, warps
from splatnode.recon.evaluate.stability.case import Case, accepted, either, refused, row, world
from splatnode.recon.evaluate.stability.places import Photo, Sampler, far_apart, renamed
from splatnode.recon.result.verdict import Code

_AMBIGUOUS = (
    Code.AMBIGUOUS,
    Code.SPLIT,
    Code.OUTLIER_VIEW,
    Code.NO_OVERLAP,
    Code.BASELINE_TOO_SMALL,
    Code.MIXED_CAMERAS,  # places are often photographed by cameras of their own
)


@row(10, "one outlier")
def outlier(sampler: Sampler) -> Case:
    here = sampler.photos(4)
    elsewhere = renamed(sampler.photos(1, here), "elsewhere")
    photos = here + elsewhere
    order = [photos[i] for i in sampler.rng.permutation(len(photos))]
    case = accepted(order, "one of the second place", Code.OUTLIER_VIEW, Code.OK_PARTIAL)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(world(here),))


@row(10, "two places")
def two_places(sampler: Sampler) -> Case:
    here = renamed(sampler.photos(4), "here")
    there = renamed(sampler.photos(3, here), "there")
    case = either(here + there, "4 and 3", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(world(here), world(there)))


@row(14, "some frames mirrored")
def some_mirrored(sampler: Sampler) -> Case:
    """What is symmetric matches itself mirrored; the rest of such frames belongs to a world that there is not."""
    photos = sampler.photos(5)
    flipped = 1 + sampler.seed % 2
    plain, reflected = photos[flipped:], [warps.mirrored(photo) for photo in photos[:flipped]]
    case = either(plain + reflected, f"{flipped} mirrored", *_AMBIGUOUS)
    return replace(case, worlds=(world(plain), world(reflected)))


@row(14, "as many mirrored as plain")
def half_mirrored(sampler: Sampler) -> Case:
    photos = sampler.photos(3)
    reflected = [warps.mirrored(photo) for photo in photos]
    case = either(photos + reflected, "3 and their mirror images", *_AMBIGUOUS)
    return replace(case, worlds=(world(photos), world(reflected)))


@row(14, "symmetric facade")
def symmetric(sampler: Sampler) -> Case:
    """A flat facade whose right half mirrors its left, photographed from an arc."""
    (photo,) = sampler.photos(1)
    half = photo.image[:, : photo.image.shape[1] // 2]
    facade = np.concatenate([half, half[:, ::-1]], axis=1)
    views = warps.poster_views(replace(photo, image=facade), np.linspace(-25.0, 25.0, 4), 1.1)
    return refused(views, "views of a facade made of one", Code.PLANAR_ONLY, Code.AMBIGUOUS)


@row(14, "tiled facade")
def tiled(sampler: Sampler) -> Case:
    """One window of a photograph over and over again: the camera may have passed any number of them."""
    (photo,) = sampler.photos(1)
    columns = (3, 5)[sampler.seed % 2]
    height, width = photo.image.shape[:2]
    window = photo.image[height // 4 : height // 4 + height // 3, width // 4 : width // 4 + width // columns]
    facade = np.tile(window, (3, columns, 1))
    views = warps.poster_views(replace(photo, image=facade), np.linspace(-20.0, 20.0, 4), 1.2)
    return refused(views, f"views of {columns} x 3 windows of one", Code.PLANAR_ONLY, *_AMBIGUOUS)


@row(14, "every structure twice")
def doubled(sampler: Sampler) -> Case:
    """Each frame shows its left half twice: half of the matches fit the true cameras, the others a world beside it."""
    photos = [replace(photo, image=corruptions.repeated_half(photo.image)) for photo in sampler.photos(4)]
    # The left half is what the true camera saw; nothing else about these frames is true.
    return either(photos, "two equal halves each", *_AMBIGUOUS, Code.FOCAL_SUSPECT)


@row(14, "opposite sides")
def opposite_sides(sampler: Sampler) -> Case:
    """Neighbours from two sides of one place, which share no surface but may share its style."""
    for place in sampler.places_in_turn():
        apart = far_apart(place, 2, 75.0, sampler.rng)
        if apart and len(place.names) >= 10:
            indices = sorted(
                {min(max(middle + step, 0), len(place.names) - 1) for middle in apart for step in (-1, 0, 1)}
            )
            return either(place.photos(indices), "neighbours on two sides", *_AMBIGUOUS)
    near = sampler.photos(3)
    far = renamed(sampler.photos(3, near), "far")
    case = either(near + far, "3 of each", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(world(near), world(far)))


@row(14, "picture of the place elsewhere")
def picture_elsewhere(sampler: Sampler) -> Case:
    """A frame of another place in which a photograph of this one hangs on the wall."""
    here = sampler.photos(4)
    (wall,) = renamed(sampler.photos(1, here), "elsewhere")
    side = (0.4, 0.6)[sampler.seed % 2]
    size = round(side * wall.image.shape[1]), round(side * wall.image.shape[0])
    picture = cv2.resize(here[1].image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = (int(sampler.rng.integers(wall.image.shape[axis] - size[1 - axis])) for axis in (1, 0))
    hung = corruptions.pasted(wall.image, picture, np.ones(picture.shape[:2], np.float32), left, top)
    note = "one of the second place with a picture of the first"
    case = either([*here, replace(wall, image=hung, camera=None)], note, *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK})


@row(14, "the same thing in two places")
def same_thing(sampler: Sampler) -> Case:
    """A big poster that hangs in both places: all frames share it, and nothing else."""
    here = renamed(sampler.photos(3), "here")
    there = renamed(sampler.photos(3, here), "there")
    (poster,) = sampler.photos(1, here + there)
    views = warps.poster_views(poster, np.linspace(-20.0, 20.0, 6), 1.0)
    photos = [_with_poster(photo, view) for photo, view in zip(here + there, views, strict=True)]
    case = either(photos, "one poster in all", *_AMBIGUOUS, Code.PLANAR_ONLY, Code.MOVING_SCENE)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(world(here), world(there)))


def _with_poster(photo: Photo, view: Photo) -> Photo:
    """The view of a poster in the middle of the photograph, over a fifth of it."""
    height, width = (round(0.45 * side) for side in photo.image.shape[:2])
    small = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = round(0.28 * photo.image.shape[1]), round(0.28 * photo.image.shape[0])
    return replace(photo, image=corruptions.pasted(photo.image, small, corruptions.ellipse(height, width), left, top))
