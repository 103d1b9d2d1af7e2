"""Rows 1 to 6, 9 and 24: how many photographs there are, and how the camera moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.recon.evaluate.stability.case import (
    TrialCase,
    make_accept_case,
    make_either_case,
    make_refuse_case,
    make_world,
    row,
)
from splatnode.recon.evaluate.stability.places import (
    Sampler,
    TrialImage,
    find_distant_views,
    find_parallel_sets,
    rename_images,
)
from splatnode.recon.evaluate.stability.probes import make_same_cameras_probe
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.verdict import Code


@row(1, "clean")
def clean_views(sampler: Sampler) -> TrialCase:
    count = (3, 4, 6)[sampler.seed % 3]
    return make_accept_case(sampler.load_images(count), "neighbours")


@row(1, "clean, further apart")
def clean_apart(sampler: Sampler) -> TrialCase:
    return make_accept_case(sampler.load_images(5, step_deg=20.0), "neighbours at up to 20 degrees")


@row(1, "clean, parallel views")
def parallel_views(sampler: Sampler) -> TrialCase:
    """Makes parallel views; where they are weak, a right scene is as good as a refusal."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    for place in sampler.list_scenes_in_turn():
        starts, stride = find_parallel_sets(place.Ts_world_camera, 4)
        if starts:
            start = int(sampler.rng.choice(starts))
            return make_either_case(
                place.load_images(range(start, start + 4 * stride, stride)), "views in one direction", *fitting
            )
    return make_either_case(
        _render_walk(sampler, [0.0, 0.15, 0.3, 0.45], axis=0), "15 cm further to the side each", *fitting
    )


@row(2, "shuffled")
def random_order(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(4)
    order = [photos[i] for i in sampler.rng.permutation(len(photos))]
    probe = make_same_cameras_probe(photos, rotation_deg=0.1, centre_pct=0.3)
    return make_accept_case(order, "in random order", probe=probe)


@row(3, "every frame twice")
def duplicates(sampler: Sampler) -> TrialCase:
    photos = sampler.load_images(3)
    copies = [replace(photo, name=f"copy_{photo.name}") for photo in photos]
    # Leaving the copies out is as good as placing them.
    return make_accept_case(photos + copies, "each and its copy", Code.OK_PARTIAL)


@row(3, "one frame many times")
def one_frame(sampler: Sampler) -> TrialCase:
    (photo,) = sampler.load_images(1)
    copies = [replace(photo, name=f"copy_{i}_{photo.name}") for i in range(4)]
    return make_refuse_case(copies, "copies of one", Code.STATIC_CAMERA)


@row(4, "single view")
def single_view(sampler: Sampler) -> TrialCase:
    return make_refuse_case(sampler.load_images(1), "", Code.TOO_FEW_VIEWS)


@row(5, "two views")
def two_views(sampler: Sampler) -> TrialCase:
    place = sampler.list_scenes_in_turn()[0]
    gap = 1 if sampler.seed % 2 else max(1, (len(place.names) - 1) // 3)
    start = int(sampler.rng.integers(len(place.names) - gap))
    note = f"{gap} apart in the order of capture"
    codes = (Code.TOO_FEW_VIEWS, Code.BASELINE_TOO_SMALL, Code.FOCAL_SUSPECT, Code.NO_OVERLAP, Code.PLANAR_ONLY)
    return make_either_case(place.load_images([start, start + gap]), note, *codes)


@row(6, "tiny baseline")
def tiny_baseline(sampler: Sampler) -> TrialCase:
    """Neighbours of a video. Only the built-in place can be photographed from wherever one wants."""
    degrees = (0.05, 0.15, 0.3)[sampler.seed % 3]
    views = 4
    config = synthetic.Config(views=8, seed=sampler.seed % 2)
    (start, K), (end, _) = synthetic.scene_cameras(config)[3:5]  # 11 degrees apart
    share = degrees / 11.0
    photos = []
    for number in range(views):
        centre = start[:3, 3] + number * share * (end[:3, 3] - start[:3, 3])
        photos.append(_render_image(config, synthetic.look_at(centre, synthetic.TARGET), K, number))
    fitting = (Code.BASELINE_TOO_SMALL, Code.STATIC_CAMERA, Code.NO_PARALLAX, Code.TOO_FEW_VIEWS)
    return make_refuse_case(photos, f"{degrees} degrees apart", *fitting)


@row(9, "places that share nothing")
def places_apart(sampler: Sampler) -> TrialCase:
    chosen = sampler.load_one_per_scene(5)
    case = make_refuse_case(chosen, "one of each", Code.NO_OVERLAP, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)
    return replace(case, worlds=tuple(make_world([photo]) for photo in chosen))


@row(9, "views that share nothing")
def views_apart(sampler: Sampler) -> TrialCase:
    """The corners of an orbit, or where no place was walked around, the ends of two walks."""
    for place in sampler.list_scenes_in_turn():
        apart = find_distant_views(place, 4, 60.0, sampler.rng)
        if apart:
            note = "at least 60 degrees apart"
            # Photographs with a wide lens may share something all the same.
            fitting = (Code.NO_OVERLAP, Code.SPLIT, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)
            return make_either_case(place.load_images(apart), note, *fitting)
    first = rename_images(sampler.load_images(2), "a")
    second = rename_images(sampler.load_images(2, first), "b")
    case = make_refuse_case(first + second, "two of each", Code.NO_OVERLAP, Code.SPLIT)
    return replace(case, worlds=(make_world(first), make_world(second)))


@row(24, "forward motion")
def forward_motion(sampler: Sampler) -> TrialCase:
    """A recorded drive where there is one, else a walk towards the table of the built-in place."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.NO_OVERLAP)
    if sampler.places.forward and sampler.seed % 2:
        place = sampler.places.forward[sampler.seed // 2 % len(sampler.places.forward)]
        start = int(sampler.rng.integers(max(1, len(place.names) - 5)))
        return make_either_case(place.load_images(range(start, min(start + 5, len(place.names)))), "recorded", *fitting)
    return make_either_case(
        _render_walk(sampler, [0.0, 0.2, 0.4, 0.6, 0.8], axis=2), "20 cm further forward each", *fitting
    )


def _render_walk(sampler: Sampler, distances: Sequence[float], axis: int) -> list[TrialImage]:
    """The built-in place from a camera that moves by `distances` along its own `axis`, and does not turn."""
    config = synthetic.Config(views=8, seed=sampler.seed % 2)
    start, K = synthetic.scene_cameras(config)[int(sampler.rng.integers(2, 6))]
    photos = []
    for number, distance in enumerate(distances):
        T_world_camera = start.copy()
        T_world_camera[:3, 3] += distance * start[:3, axis]
        photos.append(_render_image(config, T_world_camera, K, number))
    return photos


def _render_image(config: synthetic.Config, T_world_camera: np.ndarray, K: np.ndarray, number: int) -> TrialImage:
    image = synthetic.render_image(config, (T_world_camera, K), noise_seed=number)
    camera = TrueCamera(T_world_camera, K, config.width, config.height)
    return TrialImage(f"view_{number}.png", image, camera, "built-in place")
