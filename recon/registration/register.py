"""Registration: keyframes in, cameras and sparse points with the evidence for them out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, content_key, principal_point
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle, lenses, mapper, subpixel, uncertainty
from splatnode.recon.registration.config import Config
from splatnode.recon.registration.lenses import Grouping
from splatnode.recon.registration.mapping_problem import View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RegisteredCamera:
    """An estimated camera of the frame at full size."""

    index: int  # position among the keyframes
    T_world_camera: Array  # (4, 4)
    lens: int  # cameras with the same number share focal length and distortion, relative to their longer side
    focal: float  # pixels of the full-size image
    principal: Array  # (2,) pixels of the full-size image
    radial: float  # first radial distortion coefficient
    rotation_sigma_deg: float  # after the best similarity
    centre_sigma_rel: float  # relative to the spread of the centres, after the best similarity


@dataclass(frozen=True, eq=False)
class Registration:
    """What is known about the cameras. The world is the first camera's frame; the median depth of the points is 1."""

    cameras: tuple[RegisteredCamera, ...]  # in the order of the keyframes
    points: Array  # (P, 3) world
    observed_by: npt.NDArray[np.int64]  # (O,) keyframe index
    observed_point: npt.NDArray[np.int64]  # (O,)
    observed_pixels: Array  # (O, 2) full-size pixels
    agreement: dict[tuple[int, int], float]  # share of each pair's matches that the cameras explain
    focal_sigma: float  # of the logarithm of the least certain focal length
    median_angle_deg: float
    rms_px: float  # of the observations, at 1024 px on the longer side
    rival: float = 0.0  # matches that the best other set of cameras explained, over those that this one does


def register(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    config: Config,
    pause: Callable[[], None] = lambda: None,
) -> Registration | None:
    """Cameras of as many keyframes as hang together, or None when no two do.

    `pairs` holds the verified pairs by position (i < j). The answer is the same in whatever order the keyframes come.
    `pause` may raise to abandon the work.
    """
    if not pairs:
        return None
    order = sorted(range(len(keyframes)), key=lambda index: content_key(keyframes[index]))
    ordered = [keyframes[index] for index in order]
    built = _build(ordered, _renumbered(pairs, np.argsort(order)), config, pause)
    if built is None:
        return None
    found, grouping = built
    place = np.argsort(order)
    enlarged = [grouping.enlarged[i] for i in place]
    return in_first_camera(found.renumbered(order), keyframes, enlarged)


def _renumbered(pairs: Mapping[tuple[int, int], TwoView], place: Index) -> dict[tuple[int, int], TwoView]:
    """The pairs, sorted, of keyframes of which number i is now number `place[i]`."""
    renumbered = {}
    for (i, j), pair in pairs.items():
        first, second = int(place[i]), int(place[j])
        renumbered[min(first, second), max(first, second)] = pair if first < second else pair.swapped()
    return dict(sorted(renumbered.items()))


def _build(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    config: Config,
    pause: Callable[[], None],
) -> tuple[mapper.Map, Grouping] | None:
    """The map, in the pixels of its lenses, and these: one for all sizes unless the map contradicts that."""
    together, apart = (lenses.group(keyframes, across_sizes) for across_sizes in (True, False))
    built = _map(keyframes, pairs, together, config, pause)
    if built is None or together == apart:
        return None if built is None else (built, together)
    if not lenses.contradicted(built.problem, built.prior, built.loss, built.views[0], together, config.lenses):
        return built, together
    built = _map(keyframes, pairs, apart, config, pause)
    return None if built is None else (built, apart)


def _map(
    keyframes: Sequence[Keyframe],
    pairs: Mapping[tuple[int, int], TwoView],
    grouping: Grouping,
    config: Config,
    pause: Callable[[], None],
) -> mapper.Map | None:
    enlarged = grouping.enlarged
    of_refinement = config.mapper.finishing.subpixel
    pictures = [
        subpixel.picture(keyframe.frame.image, principal_point(keyframe.frame), of_refinement).enlarged(enlarged[i])
        for i, keyframe in enumerate(keyframes)
    ]
    known = lenses.lenses(keyframes, grouping, pairs, config.lenses)
    views, in_lens = views_of(keyframes, grouping), in_pixels_of_lens(pairs, grouping)
    return mapper.build_map(views, known, in_lens, config.mapper, pictures, pause)


def views_of(keyframes: Sequence[Keyframe], grouping: Grouping) -> list[View]:
    """The keyframes as the mapper sees them, in the pixels of their lenses."""
    return [
        View(
            points=grouping.enlarged[i] * (keyframe.features.points - principal_point(keyframe.frame)),
            lens=grouping.lens_of[i],
            longer_side=grouping.longer_sides[grouping.lens_of[i]],
        )
        for i, keyframe in enumerate(keyframes)
    ]


def in_pixels_of_lens(pairs: Mapping[tuple[int, int], TwoView], grouping: Grouping) -> dict[tuple[int, int], TwoView]:
    """The pairs in the pixels of their frames' lenses."""
    return {(i, j): pair.scaled(grouping.enlarged[i], grouping.enlarged[j]) for (i, j), pair in pairs.items()}


def in_first_camera(built: mapper.Map, keyframes: Sequence[Keyframe], enlarged: Sequence[float]) -> Registration:
    """The map with the first registered keyframe as the world's frame and a median point depth of 1.

    Its pixels are those of the frames `enlarged` to the size of their lens.
    """
    problem = built.problem
    order = sorted(built.views)
    covariances = bundle.covariance(problem, built.prior, built.loss, built.views[0])
    _, depths = bundle.project(problem)
    scale = 1.0 / max(float(np.median(depths)), 1e-9)
    rotation0, translation0 = problem.rotations[order[0]], problem.translations[order[0]]
    points = scale * (problem.points @ rotation0.T + translation0)
    rotation_sigmas, centre_sigmas = uncertainty.camera_sigmas(problem, covariances, order)
    cameras = []
    for place, i in enumerate(order):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = rotation0 @ problem.rotations[i].T
        T_world_camera[:3, 3] = scale * (translation0 - T_world_camera[:3, :3] @ problem.translations[i])
        lens = problem.lens_of_camera[i]
        cameras.append(
            RegisteredCamera(
                index=i,
                T_world_camera=T_world_camera,
                lens=int(lens),
                focal=float(np.exp(problem.log_focals[lens])) / enlarged[i],
                principal=principal_point(keyframes[i].frame) + problem.shifts[lens] / enlarged[i],
                radial=float(problem.radials[lens]),
                rotation_sigma_deg=float(rotation_sigmas[place]),
                centre_sigma_rel=float(centre_sigmas[place]),
            )
        )
    principal = np.stack([principal_point(keyframe.frame) for keyframe in keyframes])
    return Registration(
        cameras=tuple(cameras),
        points=points,
        observed_by=problem.camera_of,
        observed_point=problem.point_of,
        observed_pixels=problem.pixels / np.array(enlarged)[problem.camera_of, None] + principal[problem.camera_of],
        agreement=built.agreement,
        focal_sigma=float(np.sqrt(covariances.log_focals[problem.lens_of_camera[order]].max())),
        median_angle_deg=built.median_angle_deg,
        rms_px=built.rms_px,
        rival=built.rival,
    )
