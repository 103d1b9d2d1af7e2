"""Registration: keyframes in, cameras and sparse points with the evidence for them out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from capture.frame import Frame
from recon.keyframe import Features, Keyframe
from recon.registration import bundle, features, lenses, looks, mapper, matching, refinement, two_view, uncertainty
from recon.registration.lenses import Grouping
from recon.registration.survey import View
from recon.registration.two_view import TwoView

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    features: features.Config = features.Config()
    matching: matching.Config = matching.Config()
    two_view: two_view.Config = two_view.Config()
    lenses: lenses.Config = lenses.Config()
    mapper: mapper.Config = mapper.Config()
    squeezes: tuple[float, ...] = (1.6,)  # of the image's width, for pairs that share little
    firm_matches: int = 150  # verified matches from which on a pair needs no squeezed features
    enough_firm_pairs: int = 4  # of a frame, so that it needs no more
    # log10 of the false alarms of a pair's plain matches from which on squeezed ones are tried although firm pairs
    # connect the frames already: of 40 such pairs that squeezed features verified, 39 were below, of others one in ten.
    hint_log10_nfa: float = -1.0
    still_px: float = 1.0  # median motion of a pair, at 1024 px, below which it may show the robot itself
    enough_moved: int = 60  # matches that moved by more, so that they are asked by themselves


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


@dataclass(frozen=True, eq=False)
class Compared:
    """What the features of two frames say."""

    matches: Index  # (M, 2) points, most distinct first
    pair: TwoView | None  # None where chance explains the matches
    log10_nfa: float  # of the matches' agreement, whether it is enough or not: below 0 it is a hint


def compare(keyframe1: Keyframe, keyframe2: Keyframe, config: Config) -> Compared:
    """Matches the features of the plain images of two keyframes and verifies the pair."""
    found = _match(keyframe1.features, keyframe2.features, (1.0, 1.0), config.matching)
    return _examine(keyframe1, keyframe2, found, config)


def compare_squeezed(keyframe1: Keyframe, keyframe2: Keyframe, plain: Compared, config: Config) -> Compared:
    """The same with what the squeezed features add to the matches of the `plain` ones.

    One of the two images is always the plain one: a surface is seen from the side in one image, not in both. Every
    point is in one match at most, in the most distinct.
    """
    from_the_side = {(1.0, squeeze) for squeeze in set(keyframe2.features.squeeze) - {1.0}}
    from_the_side |= {(squeeze, 1.0) for squeeze in set(keyframe1.features.squeeze) - {1.0}}
    found = [plain.matches]
    found += [
        _match(keyframe1.features, keyframe2.features, squeezes, config.matching) for squeezes in sorted(from_the_side)
    ]
    return _examine(keyframe1, keyframe2, _merged(found), config)


def compare_further(keyframe1: Keyframe, keyframe2: Keyframe, known: Compared, more: Index, config: Config) -> Compared:
    """The same with `more` matches (M, 2) of the keyframes' points, most distinct first, beside the `known` ones.

    They come from a prior, which may invent: what does not look alike is not taken.
    """
    if not looks.alike(keyframe1, keyframe2, more):
        return known
    return _examine(keyframe1, keyframe2, _merged([known.matches, more]), config)


def _merged(found: Sequence[Index]) -> Index:
    """(M, 2) matches of several sets, the most distinct of each first; every point is in one match at most."""
    rank = np.concatenate([np.arange(len(matches)) / max(1, len(matches)) for matches in found])
    merged = np.concatenate(found)[np.argsort(rank, kind="stable")]
    for side in (0, 1):
        _, first = np.unique(merged[:, side], return_index=True)
        merged = merged[np.sort(first)]
    return merged


def _match(features1: Features, features2: Features, squeezes: tuple[float, float], config: matching.Config) -> Index:
    """(M, 2) indices of points that match by the descriptors of these squeezes, most distinct first."""
    (chosen1,), (chosen2,) = (
        np.nonzero(features.squeeze == squeeze)
        for features, squeeze in zip((features1, features2), squeezes, strict=True)
    )
    match = matching.match(features1.descriptors[chosen1], features2.descriptors[chosen2], config)
    return np.stack([features1.point_of[chosen1[match[:, 0]]], features2.point_of[chosen2[match[:, 1]]]], 1)


def _examine(keyframe1: Keyframe, keyframe2: Keyframe, matches: Index, config: Config) -> Compared:
    """One focal length may serve both frames if they count in pixels of one size: the first is taken as enlarged."""
    enlarged = _longer_side(keyframe2.frame) / _longer_side(keyframe1.frame)
    points1 = enlarged * (keyframe1.features.points[matches[:, 0]] - principal_point(keyframe1.frame))
    points2 = keyframe2.features.points[matches[:, 1]] - principal_point(keyframe2.frame)
    size = (keyframe2.frame.width, keyframe2.frame.height)
    pair, log10_nfa = two_view.examine(points1, points2, matches, size, config.two_view)
    if pair is not None and _motion_px(pair.points1, pair.points2, size) < config.still_px:
        # What stands still in both pictures may be the robot itself: what moves is asked by itself.
        (moved,) = np.nonzero(np.linalg.norm(points2 - points1, axis=1) * 1024.0 / max(size) >= config.still_px)
        if len(moved) >= config.enough_moved:
            among = two_view.examine(points1[moved], points2[moved], matches[moved], size, config.two_view)
            pair, log10_nfa = among if among[0] is not None else (pair, log10_nfa)
    return Compared(matches, pair.enlarged(1.0 / enlarged, 1.0) if pair else None, log10_nfa)


def _motion_px(points1: Array, points2: Array, size: tuple[int, int]) -> float:
    """Median motion at 1024 pixels on the longer side."""
    return float(np.median(np.linalg.norm(points2 - points1, axis=1))) * 1024.0 / max(size)


def place_in_order(keyframe: Keyframe) -> bytes:
    """Sorts keyframes by what they show: with it, an answer does not depend on the order in which they came."""
    return keyframe.features.points[:64].tobytes()


def register(
    keyframes: Sequence[Keyframe], pairs: Mapping[tuple[int, int], TwoView], config: Config
) -> Registration | None:
    """Cameras of as many keyframes as hang together, or None when no two do.

    `pairs` holds the verified pairs by position (i < j). The answer is the same in whatever order the keyframes come.
    """
    if not pairs:
        return None
    order = sorted(range(len(keyframes)), key=lambda index: place_in_order(keyframes[index]))
    ordered = [keyframes[index] for index in order]
    built = _build(ordered, _renumbered(pairs, np.argsort(order)), config)
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
    keyframes: Sequence[Keyframe], pairs: Mapping[tuple[int, int], TwoView], config: Config
) -> tuple[mapper.Map, Grouping] | None:
    """The map, in the pixels of its lenses, and these: one for all sizes unless the map contradicts that."""
    together, apart = (lenses.group(keyframes, across_sizes) for across_sizes in (True, False))
    built = _map(keyframes, pairs, together, config)
    if built is None or together == apart:
        return None if built is None else (built, together)
    if not lenses.contradicted(built.problem, built.prior, built.loss, built.views[0], together, config.lenses):
        return built, together
    built = _map(keyframes, pairs, apart, config)
    return None if built is None else (built, apart)


def _map(
    keyframes: Sequence[Keyframe], pairs: Mapping[tuple[int, int], TwoView], grouping: Grouping, config: Config
) -> mapper.Map | None:
    enlarged = grouping.enlarged
    of_refinement = config.mapper.finishing.refinement
    pictures = [
        refinement.picture(keyframe.frame.image, principal_point(keyframe.frame), of_refinement).enlarged(enlarged[i])
        for i, keyframe in enumerate(keyframes)
    ]
    known = lenses.lenses(keyframes, grouping, pairs, config.lenses)
    views, in_lens = views_of(keyframes, grouping), in_pixels_of_lens(pairs, grouping)
    return mapper.build_map(views, known, in_lens, config.mapper, pictures)


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
    return {(i, j): pair.enlarged(grouping.enlarged[i], grouping.enlarged[j]) for (i, j), pair in pairs.items()}


def _longer_side(frame: Frame) -> int:
    return max(frame.width, frame.height)


def principal_point(frame: Frame) -> Array:
    """(2,) pixels: as given, else the middle of the image."""
    if frame.intrinsics is not None:
        return np.array([frame.intrinsics.cx, frame.intrinsics.cy])
    return np.array([frame.width / 2.0, frame.height / 2.0])


def in_first_camera(built: mapper.Map, keyframes: Sequence[Keyframe], enlarged: Sequence[float]) -> Registration:
    """The map with the first registered keyframe as the world's frame and a median point depth of 1.

    Its pixels are those of the frames `enlarged` to the size of their lens.
    """
    state = built.problem
    order = sorted(built.views)
    covariances = bundle.covariance(state, built.prior, built.loss, built.views[0])
    _, depths = bundle.project(state)
    scale = 1.0 / max(float(np.median(depths)), 1e-9)
    rotation0, translation0 = state.rotations[order[0]], state.translations[order[0]]
    points = scale * (state.points @ rotation0.T + translation0)
    rotation_sigmas, centre_sigmas = uncertainty.camera_sigmas(state, covariances, order)
    cameras = []
    for place, i in enumerate(order):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = rotation0 @ state.rotations[i].T
        T_world_camera[:3, 3] = scale * (translation0 - T_world_camera[:3, :3] @ state.translations[i])
        lens = state.lens_of_camera[i]
        cameras.append(
            RegisteredCamera(
                index=i,
                T_world_camera=T_world_camera,
                lens=int(lens),
                focal=float(np.exp(state.log_focals[lens])) / enlarged[i],
                principal=principal_point(keyframes[i].frame) + state.shifts[lens] / enlarged[i],
                radial=float(state.radials[lens]),
                rotation_sigma_deg=float(rotation_sigmas[place]),
                centre_sigma_rel=float(centre_sigmas[place]),
            )
        )
    principal = np.stack([principal_point(keyframe.frame) for keyframe in keyframes])
    return Registration(
        cameras=tuple(cameras),
        points=points,
        observed_by=state.camera_of,
        observed_point=state.point_of,
        observed_pixels=state.pixels / np.array(enlarged)[state.camera_of, None] + principal[state.camera_of],
        agreement=built.agreement,
        focal_sigma=float(np.sqrt(covariances.log_focals[state.lens_of_camera[order]].max())),
        median_angle_deg=built.median_angle_deg,
        rms_px=built.rms_px,
        rival=built.rival,
    )
