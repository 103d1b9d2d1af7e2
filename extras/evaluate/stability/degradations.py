"""Rows 12, 13 and 15 to 18 and 23: what light, sensor, shutter and passers-by do to the pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from splatnode.capture.masks import apply_mask
from splatnode.extras.evaluate.stability import perturbations
from splatnode.extras.evaluate.stability.case import (
    TrialCase,
    make_accept_case,
    make_either_case,
    make_frames,
    make_refuse_case,
    row,
)
from splatnode.extras.evaluate.stability.perturbations import (
    Image,
    Sampler,
    TrialImage,
    generate_noise,
    make_patchwork,
    render_poster_views,
    render_turned_crops,
)
from splatnode.recon.result.verdict import Code


@row(12, "epsilon noise")
def epsilon_noise(sampler: Sampler) -> TrialCase:
    rng, sigma = sampler.rng, 1 + sampler.seed % 3
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.add_noise(image, sigma, rng))
    return make_accept_case(photos, f"{sigma} grey levels of noise")


@row(13, "texture lost in part")
def partly_flat(sampler: Sampler) -> TrialCase:
    share, side = (0.2, 0.3, 0.4)[sampler.seed % 3], 1 + 2 * int(sampler.rng.integers(2))
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.remove_texture(image, share, side))
    return make_accept_case(photos, f"{share:.0%} without texture", Code.OK_PARTIAL)


@row(13, "texture mostly lost")
def mostly_flat(sampler: Sampler) -> TrialCase:
    share, side = (0.5, 0.75)[sampler.seed % 2], 1 + 2 * int(sampler.rng.integers(2))
    photos = _change_images(sampler.load_images(4), lambda image: perturbations.remove_texture(image, share, side))
    fitting = (Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.PLANAR_ONLY)
    return make_either_case(photos, f"{share:.0%} without texture", *fitting)


@row(13, "white wall")
def white_wall(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = [TrialImage(f"wall_{i}.png", perturbations.render_white_wall(480, 640, rng), None) for i in range(4)]
    return make_refuse_case(photos, "", Code.LOW_TEXTURE, Code.TOO_FEW_VIEWS)


@row(15, "motion blur of one frame")
def one_blurred(sampler: Sampler) -> TrialCase:
    photos, length = sampler.load_images(5), (5, 11, 21)[sampler.seed % 3]
    angle = float(sampler.rng.uniform(0, 180))
    photos[2] = replace(photos[2], image=perturbations.apply_motion_blur(photos[2].image, length, angle))
    fitting = (Code.OK_PARTIAL, Code.OUTLIER_VIEW, Code.BLUR)
    return make_accept_case(photos, f"one smeared over {length} px", *fitting)


@row(15, "motion blur of all frames")
def all_blurred(sampler: Sampler) -> TrialCase:
    length, angles = (5, 11, 21)[sampler.seed % 3], iter(sampler.rng.uniform(0, 180, 4))
    photos = _change_images(
        sampler.load_images(4), lambda image: perturbations.apply_motion_blur(image, length, float(next(angles)))
    )
    fitting = (Code.BLUR, Code.LOW_TEXTURE, Code.NO_OVERLAP, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    return make_either_case(photos, f"4 frames smeared over {length} px", *fitting, Code.TOO_FEW_VIEWS)


@row(16, "exposure and white balance")
def exposure(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    photos = _change_images(
        sampler.load_images(4),
        lambda image: perturbations.change_exposure(
            image, float(2.0 ** rng.uniform(-1, 1)), float(rng.uniform(0.8, 1.25)), rng.uniform(0.8, 1.2, 3)
        ),
    )
    note = "gain 0.5 to 2, gamma, 20 % white balance"
    return make_accept_case(photos, note, Code.OK_PARTIAL)


@row(17, "lens and sensor")
def sensor_degradation(sampler: Sampler) -> TrialCase:
    rng = sampler.rng
    name, change = (
        ("60 % vignetting", lambda image: perturbations.apply_vignetting(image, 0.6)),
        ("JPEG of quality 20", lambda image: perturbations.compress_jpeg(image, 20)),
        ("low light", lambda image: perturbations.simulate_low_light(image, 400.0, rng)),
    )[sampler.seed % 3]
    return make_accept_case(_change_images(sampler.load_images(4), change), f"{name}")


@row(18, "moving object")
def moving_object(sampler: Sampler) -> TrialCase:
    """A cut-out of another place that moves by itself, of growing size."""
    share = (0.05, 0.15, 0.3)[sampler.seed % 3]
    photos = _add_passer_by(sampler, sampler.load_images(5), share)
    note, fitting = f"{share:.0%} covered", (Code.OK_PARTIAL, Code.MOVING_SCENE)
    return (make_either_case if share > 0.2 else make_accept_case)(photos, note, *fitting)


@row(18, "another thing in each frame")
def passers_by(sampler: Sampler) -> TrialCase:
    """Cut-outs of other photographs, one a frame: nothing matches them."""
    share = (0.05, 0.15, 0.3)[sampler.seed % 3]
    photos = sampler.load_images(5)
    things = [sampler.load_images(1, photos)[0].image for _ in photos]
    covered = [photo for photo, _ in _add_things(sampler, photos, things, share)]
    note, fitting = f"{share:.0%} covered", (Code.OK_PARTIAL, Code.MOVING_SCENE)
    return (make_either_case if share > 0.2 else make_accept_case)(covered, note, *fitting)


@row(18, "wrong masks")
def wrong_masks(sampler: Sampler) -> TrialCase:
    """A thing moves; the masks are those of the next frame, or are inverted: they leave nothing but the thing."""
    photos = sampler.load_images(5)
    things = [sampler.load_images(1, photos)[0].image] * len(photos)
    covered = _add_things(sampler, photos, things, share=0.15)
    free = [~thing for _, thing in covered]
    inverted = sampler.seed % 2 == 1
    masks = [~mask for mask in free] if inverted else [*free[1:], free[0]]
    changed = [photo for photo, _ in covered]
    hidden = tuple(apply_mask(frame, mask) for frame, mask in zip(make_frames(changed), masks, strict=True))
    fitting = Code.NO_PARALLAX, Code.PLANAR_ONLY, Code.NO_OVERLAP, Code.MOVING_SCENE, Code.LOW_TEXTURE, Code.AMBIGUOUS
    if inverted:
        return replace(
            make_refuse_case(changed, "masks that leave only what moves", *fitting), source=partial(list, hidden)
        )
    case = make_either_case(changed, "each with the mask of the next", Code.MOVING_SCENE, Code.AMBIGUOUS)
    return replace(case, source=partial(list, hidden))


@row(18, "own body in view")
def own_body(sampler: Sampler) -> TrialCase:
    """The robot's bumper: the lowest rows of every frame are the same."""
    photos, share = sampler.load_images(4), (0.1, 0.2)[sampler.seed % 2]
    body = sampler.load_images(1, photos)[0].image

    def paste_body(image: Image) -> Image:
        rows, width = round(share * image.shape[0]), min(image.shape[1], body.shape[1])
        bumper = body[-rows:, :width]
        return perturbations.paste_patch(image, bumper, np.ones((rows, width), np.float32), 0, image.shape[0] - rows)

    note = f"the lowest {share:.0%} are the robot itself"
    return make_accept_case(_change_images(photos, paste_body), note, Code.OK_PARTIAL, Code.MOVING_SCENE)


@row(23, "reflection of a lamp")
def highlight(sampler: Sampler) -> TrialCase:
    """It moves with the camera, and over the scene."""
    rng = sampler.rng
    where = rng.uniform(0.3, 0.7, 2)
    photos = _change_images(
        sampler.load_images(4),
        lambda image: perturbations.add_highlight(image, *(where + rng.uniform(-0.05, 0.05, 2)), size=0.2),
    )
    return make_accept_case(photos, "a highlight of a fifth of the width")


def _change_images(photos: Sequence[TrialImage], change: Callable[[Image], Image]) -> list[TrialImage]:
    return [replace(photo, image=change(photo.image)) for photo in photos]


def _add_passer_by(sampler: Sampler, photos: Sequence[TrialImage], share: float) -> list[TrialImage]:
    """One ellipse of another place's photograph over all frames."""
    cutout = sampler.load_images(1, photos)[0].image
    return [photo for photo, _ in _add_things(sampler, photos, [cutout] * len(photos), share)]


def _add_things(
    sampler: Sampler, photos: Sequence[TrialImage], things: Sequence[Image], share: float
) -> list[tuple[TrialImage, npt.NDArray[np.bool_]]]:
    """The photographs, over each an ellipse of its thing, covering `share` of it, on a way of its own; where it is."""
    rng = sampler.rng
    way = np.cumsum(rng.normal(scale=0.12, size=(len(photos), 2)), axis=0) + rng.uniform(0.3, 0.7, 2)
    result = []
    for photo, cutout, (across, down) in zip(photos, things, np.clip(way, 0.2, 0.8), strict=True):
        height, width = photo.image.shape[:2]
        side = np.sqrt(share * 4 / np.pi)  # of the frame's sides, so that the ellipse covers the share
        size = min(round(side * height), cutout.shape[0]), min(round(side * width), cutout.shape[1])
        left, top = round(across * width - size[1] / 2), round(down * height - size[0] / 2)
        patch = cutout[: size[0], : size[1]]
        ellipse = perturbations.make_ellipse_mask(*size)
        covered = replace(photo, image=perturbations.paste_patch(photo.image, patch, ellipse, left, top))
        black, white = np.zeros_like(photo.image), np.full((*size, 3), 255, np.uint8)
        result.append((covered, perturbations.paste_patch(black, white, ellipse, left, top).max(2) > 0))
    return result


# Rows 7, 8 and 11: photographs in which there is no depth to find, or no place at all.

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
