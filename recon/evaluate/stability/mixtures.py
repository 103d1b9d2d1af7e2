"""Rows 10 and 14: frames of other places, and places that look like each other. Here wrong scenes look right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from splatnode.recon.evaluate.stability import corruptions, warps
from splatnode.recon.evaluate.stability.case import (
    TrialCase,
    make_accept_case,
    make_either_case,
    make_refuse_case,
    make_world,
    row,
)
from splatnode.recon.evaluate.stability.places import Sampler, TrialImage, find_distant_views, rename_images
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
def outlier(sampler: Sampler) -> TrialCase:
    here = sampler.load_images(4)
    elsewhere = rename_images(sampler.load_images(1, here), "elsewhere")
    photos = here + elsewhere
    order = [photos[i] for i in sampler.rng.permutation(len(photos))]
    case = make_accept_case(order, "one of the second place", Code.OUTLIER_VIEW, Code.OK_PARTIAL)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here),))


@row(10, "two places")
def two_places(sampler: Sampler) -> TrialCase:
    here = rename_images(sampler.load_images(4), "here")
    there = rename_images(sampler.load_images(3, here), "there")
    case = make_either_case(here + there, "4 and 3", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here), make_world(there)))


@row(14, "some frames mirrored")
def some_mirrored(sampler: Sampler) -> TrialCase:
    """Mirrors some frames: what is symmetric matches, the rest belongs to a world that there is not."""
    photos = sampler.load_images(5)
    flipped = 1 + sampler.seed % 2
    plain, reflected = photos[flipped:], [warps.mirror_image(photo) for photo in photos[:flipped]]
    case = make_either_case(plain + reflected, f"{flipped} mirrored", *_AMBIGUOUS)
    return replace(case, worlds=(make_world(plain), make_world(reflected)))


@row(14, "as many mirrored as plain")
def half_mirrored(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    reflected = [warps.mirror_image(photo) for photo in photos]
    case = make_either_case(photos + reflected, "3 and their mirror images", *_AMBIGUOUS)
    return replace(case, worlds=(make_world(photos), make_world(reflected)))


@row(14, "symmetric facade")
def symmetric_facade(sampler: Sampler) -> TrialCase:
    """A flat facade whose right half mirrors its left, photographed from an arc."""
    (photo,) = sampler.load_images(1)
    half = photo.image[:, : photo.image.shape[1] // 2]
    facade = np.concatenate([half, half[:, ::-1]], axis=1)
    views = warps.render_poster_views(replace(photo, image=facade), np.linspace(-25.0, 25.0, 4), 1.1)
    return make_refuse_case(views, "views of a facade made of one", Code.PLANAR_ONLY, Code.AMBIGUOUS)


@row(14, "tiled facade")
def window_grid_facade(sampler: Sampler) -> TrialCase:
    """One window of a photograph over and over again: the camera may have passed any number of them."""
    (photo,) = sampler.load_images(1)
    columns = (3, 5)[sampler.seed % 2]
    height, width = photo.image.shape[:2]
    window = photo.image[height // 4 : height // 4 + height // 3, width // 4 : width // 4 + width // columns]
    facade = np.tile(window, (3, columns, 1))
    views = warps.render_poster_views(replace(photo, image=facade), np.linspace(-20.0, 20.0, 4), 1.2)
    return make_refuse_case(views, f"views of {columns} x 3 windows of one", Code.PLANAR_ONLY, *_AMBIGUOUS)


@row(14, "every structure twice")
def duplicate_structures(sampler: Sampler) -> TrialCase:
    """Each frame shows its left half twice: half of the matches fit the true cameras, the others a world beside it."""
    photos = [replace(photo, image=corruptions.repeat_left_half(photo.image)) for photo in sampler.load_images(4)]
    # The left half is what the true camera saw; nothing else about these frames is true.
    return make_either_case(photos, "two equal halves each", *_AMBIGUOUS, Code.FOCAL_SUSPECT)


@row(14, "opposite sides")
def opposite_sides(sampler: Sampler) -> TrialCase:
    """Neighbours from two sides of one place, which share no surface but may share its style."""
    for place in sampler.list_scenes_in_turn():
        apart = find_distant_views(place, 2, 75.0, sampler.rng)
        if apart and len(place.names) >= 10:
            indices = sorted(
                {min(max(middle + step, 0), len(place.names) - 1) for middle in apart for step in (-1, 0, 1)}
            )
            return make_either_case(place.load_images(indices), "neighbours on two sides", *_AMBIGUOUS)
    near = sampler.load_images(3)
    far = rename_images(sampler.load_images(3, near), "far")
    case = make_either_case(near + far, "3 of each", *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(near), make_world(far)))


@row(14, "picture of the place elsewhere")
def picture_elsewhere(sampler: Sampler) -> TrialCase:
    """A frame of another place in which a photograph of this one hangs on the wall."""
    here = sampler.load_images(4)
    (wall,) = rename_images(sampler.load_images(1, here), "elsewhere")
    side = (0.4, 0.6)[sampler.seed % 2]
    size = round(side * wall.image.shape[1]), round(side * wall.image.shape[0])
    picture = cv2.resize(here[1].image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = (int(sampler.rng.integers(wall.image.shape[axis] - size[1 - axis])) for axis in (1, 0))
    hung = corruptions.paste_patch(wall.image, picture, np.ones(picture.shape[:2], np.float32), left, top)
    note = "one of the second place with a picture of the first"
    case = make_either_case([*here, replace(wall, image=hung, camera=None)], note, *_AMBIGUOUS)
    return replace(case, codes=case.codes - {Code.OK})


@row(14, "the same thing in two places")
def same_thing(sampler: Sampler) -> TrialCase:
    """A big poster that hangs in both places: all frames share it, and nothing else."""
    here = rename_images(sampler.load_images(3), "here")
    there = rename_images(sampler.load_images(3, here), "there")
    (poster,) = sampler.load_images(1, here + there)
    views = warps.render_poster_views(poster, np.linspace(-20.0, 20.0, 6), 1.0)
    photos = [_paste_poster(photo, view) for photo, view in zip(here + there, views, strict=True)]
    case = make_either_case(photos, "one poster in all", *_AMBIGUOUS, Code.PLANAR_ONLY, Code.MOVING_SCENE)
    return replace(case, codes=case.codes - {Code.OK}, worlds=(make_world(here), make_world(there)))


def _paste_poster(photo: TrialImage, view: TrialImage) -> TrialImage:
    """The view of a poster in the middle of the photograph, over a fifth of it."""
    height, width = (round(0.45 * side) for side in photo.image.shape[:2])
    small = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    left, top = round(0.28 * photo.image.shape[1]), round(0.28 * photo.image.shape[0])
    return replace(
        photo,
        image=corruptions.paste_patch(photo.image, small, corruptions.make_ellipse_mask(height, width), left, top),
    )
