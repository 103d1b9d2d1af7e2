"""Rows 1 to 6, 9 and 24: how many photographs there are, and how the camera moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.recon.evaluate.stability.case import Case, accepted, either, refused, row, world
from splatnode.recon.evaluate.stability.places import Photo, Stage, far_apart, parallel, renamed
from splatnode.recon.evaluate.stability.probes import same_cameras
from splatnode.recon.evaluate.truth import TrueCamera
from splatnode.recon.result.verdict import Code


@row(1, "clean")
def clean(stage: Stage) -> Case:
    count = (3, 4, 6)[stage.seed % 3]
    return accepted(stage.photos(count), "neighbours")


@row(1, "clean, further apart")
def clean_apart(stage: Stage) -> Case:
    return accepted(stage.photos(5, step_deg=20.0), "neighbours at up to 20 degrees")


@row(1, "clean, parallel views")
def parallel_views(stage: Stage) -> Case:
    """Where they are weak, the focal length is a guess: a right scene is as good as a refusal."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS)
    for place in stage.in_turn():
        starts, stride = parallel(place.Ts_world_camera, 4)
        if starts:
            start = int(stage.rng.choice(starts))
            return either(place.photos(range(start, start + 4 * stride, stride)), "views in one direction", *fitting)
    return either(_walked(stage, [0.0, 0.15, 0.3, 0.45], axis=0), "15 cm further to the side each", *fitting)


@row(2, "shuffled")
def shuffled(stage: Stage) -> Case:
    photos = stage.photos(4)
    order = [photos[i] for i in stage.rng.permutation(len(photos))]
    probe = same_cameras(photos, rotation_deg=0.1, centre_pct=0.3)
    return accepted(order, "in random order", probe=probe)


@row(3, "every frame twice")
def duplicates(stage: Stage) -> Case:
    photos = stage.photos(3)
    copies = [replace(photo, name=f"copy_{photo.name}") for photo in photos]
    # Leaving the copies out is as good as placing them.
    return accepted(photos + copies, "each and its copy", Code.OK_PARTIAL)


@row(3, "one frame many times")
def one_frame(stage: Stage) -> Case:
    (photo,) = stage.photos(1)
    copies = [replace(photo, name=f"copy_{i}_{photo.name}") for i in range(4)]
    return refused(copies, "copies of one", Code.STATIC_CAMERA)


@row(4, "single view")
def single(stage: Stage) -> Case:
    return refused(stage.photos(1), "", Code.TOO_FEW_VIEWS)


@row(5, "two views")
def two_views(stage: Stage) -> Case:
    place = stage.in_turn()[0]
    gap = 1 if stage.seed % 2 else max(1, (len(place.names) - 1) // 3)
    start = int(stage.rng.integers(len(place.names) - gap))
    note = f"{gap} apart in the order of capture"
    return either(place.photos([start, start + gap]), note, Code.TOO_FEW_VIEWS, Code.BASELINE_TOO_SMALL)


@row(6, "tiny baseline")
def tiny_baseline(stage: Stage) -> Case:
    """Neighbours of a video. Only the built-in place can be photographed from wherever one wants."""
    degrees = (0.05, 0.15, 0.3)[stage.seed % 3]
    views = 4
    config = synthetic.Config(views=8, seed=stage.seed % 2)
    (start, K), (end, _) = synthetic.scene_cameras(config)[3:5]  # 11 degrees apart
    share = degrees / 11.0
    photos = []
    for number in range(views):
        centre = start[:3, 3] + number * share * (end[:3, 3] - start[:3, 3])
        photos.append(_photograph(config, synthetic.look_at(centre, synthetic.TARGET), K, number))
    fitting = (Code.BASELINE_TOO_SMALL, Code.STATIC_CAMERA, Code.NO_PARALLAX, Code.TOO_FEW_VIEWS)
    return refused(photos, f"{degrees} degrees apart", *fitting)


@row(9, "places that share nothing")
def places_apart(stage: Stage) -> Case:
    chosen = stage.one_of_each(5)
    case = refused(chosen, "one of each", Code.NO_OVERLAP, Code.SPLIT, Code.TOO_FEW_VIEWS, Code.AMBIGUOUS)
    return replace(case, worlds=tuple(world([photo]) for photo in chosen))


@row(9, "views that share nothing")
def views_apart(stage: Stage) -> Case:
    """The corners of an orbit, or where no place was walked around, the ends of two walks."""
    for place in stage.in_turn():
        apart = far_apart(place, 4, 60.0, stage.rng)
        if apart:
            note = "at least 60 degrees apart"
            # Photographs with a wide lens may share something all the same.
            fitting = (Code.NO_OVERLAP, Code.SPLIT, Code.AMBIGUOUS, Code.BASELINE_TOO_SMALL)
            return either(place.photos(apart), note, *fitting)
    first = renamed(stage.photos(2), "a")
    second = renamed(stage.photos(2, first), "b")
    case = refused(first + second, "two of each", Code.NO_OVERLAP, Code.SPLIT)
    return replace(case, worlds=(world(first), world(second)))


@row(24, "forward motion")
def forward(stage: Stage) -> Case:
    """A recorded drive where there is one, else a walk towards the table of the built-in place."""
    fitting = (Code.FOCAL_SUSPECT, Code.BASELINE_TOO_SMALL, Code.AMBIGUOUS, Code.NO_OVERLAP)
    if stage.places.forward and stage.seed % 2:
        place = stage.places.forward[stage.seed // 2 % len(stage.places.forward)]
        start = int(stage.rng.integers(max(1, len(place.names) - 5)))
        return either(place.photos(range(start, min(start + 5, len(place.names)))), "recorded", *fitting)
    return either(_walked(stage, [0.0, 0.2, 0.4, 0.6, 0.8], axis=2), "20 cm further forward each", *fitting)


def _walked(stage: Stage, distances: Sequence[float], axis: int) -> list[Photo]:
    """The built-in place from a camera that moves by `distances` along its own `axis`, and does not turn."""
    config = synthetic.Config(views=8, seed=stage.seed % 2)
    start, K = synthetic.scene_cameras(config)[int(stage.rng.integers(2, 6))]
    photos = []
    for number, distance in enumerate(distances):
        T_world_camera = start.copy()
        T_world_camera[:3, 3] += distance * start[:3, axis]
        photos.append(_photograph(config, T_world_camera, K, number))
    return photos


def _photograph(config: synthetic.Config, T_world_camera: np.ndarray, K: np.ndarray, number: int) -> Photo:
    image = synthetic.photograph(config, (T_world_camera, K), noise_seed=number)
    camera = TrueCamera(T_world_camera, K, config.width, config.height)
    return Photo(f"view_{number}.png", image, camera, "built-in place")
