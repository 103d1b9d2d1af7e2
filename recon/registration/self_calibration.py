"""Lenses: which frames share one, and what is known of it before anything is reconstructed.

One camera stores its pictures in several sizes. Frames of one shape have the focal length over their longer side in
common. All lenses are described in the pixels of the largest frame, and smaller frames are scaled to that size: so an
error of so many pixels means the same in all views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.keyframes import Keyframe, longer_side
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration import bundle_adjustment
from splatnode.recon.registration.mapping_problem import Lens

# Focal length before anything is reconstructed: a vote of the pairs of frames.

# Focal lengths are counted over the longer side of the image.
_MIN_RATIO, _MAX_RATIO = 0.3, 5.0  # 118 to 11 degrees of view: beyond, a pair's own estimate is a failure
_GRID = np.geomspace(_MIN_RATIO, _MAX_RATIO, 240)  # of candidates, 1.2 % apart

_TYPICAL_RATIO = 1.0  # of phones and webcams: 53 degrees of view
_TYPICAL_SIGMA = 0.35  # of log focal around it
_TYPICAL_WEIGHT = 30.0  # matches that it counts as much as: a pair has hundreds

_VOTE_SIGMA = 0.06  # of log focal: the spread of the estimates of single pairs
_MIN_DISTANCE = 0.15  # between two candidates, of log focal: nearer ones lead to the same map


def vote(pairs: Sequence[TwoView], num_candidates: int) -> tuple[float, ...]:
    """The most likely ratios of focal length to longer side, the best first.

    A pair votes by a Gaussian kernel in log focal, with the number of its matches that neither a plane nor a rotation
    explains: these leave the focal length open. A weak prior around typical lenses settles what is undecided.
    """
    density = _TYPICAL_WEIGHT * np.exp(-0.5 * (np.log(_GRID / _TYPICAL_RATIO) / _TYPICAL_SIGMA) ** 2)
    for pair in pairs:
        count = len(pair.matches)
        if not _MIN_RATIO < pair.focal_ratio < _MAX_RATIO:
            continue
        weight = count * max(0.0, 1.0 - max(pair.num_homography, pair.num_rotation) / count)
        density += weight * np.exp(-0.5 * (np.log(_GRID / pair.focal_ratio) / _VOTE_SIGMA) ** 2)
    chosen: list[float] = []
    remaining: npt.NDArray[np.float64] = density
    for _ in range(num_candidates):
        best = float(_GRID[int(remaining.argmax())])
        chosen.append(best)
        remaining = remaining * (np.abs(np.log(_GRID / best)) > _MIN_DISTANCE)
    return tuple(chosen)


_NUM_CANDIDATES = 3  # focal lengths that are tried for a lens of which nothing is known
_SAME_NOMINAL = 0.01  # step of log focal in which nominal focal lengths are told apart: they are rounded numbers
# By which the distortion moves the farthest corner, over the longer side: 8 pixels of 512. What is estimated below is
# as much the errors of few points as the lens: held-out PSNR fell by .3 to .4 dB at 1 to 4 pixels, and rose from 13 on
LEAST_SHIFT = 0.016
CORNER = 0.6  # distance of a corner from the middle, over the longer side: that of a picture of 3 x 2
_ROUNDING_PX = 1.0  # difference of the shorter sides of two frames of one shape: sizes are whole pixels


class LensGroupingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lenses: which frames share one, and what is known of it before anything is reconstructed."""

    exif_sigma: float = 0.05  # of log focal, from EXIF: nominal focal lengths are rounded, and focusing changes them
    voted_sigma: float = 0.3  # of log focal, when pairs of frames voted for it
    # Largest difference of log focals, adjusted for each size of frames of one shape by itself, with which all have one
    # lens; beyond, some frames are crops or zoomed. Resized frames differed by 0.007 at most, crops to 75 % by
    # 0.114 at least, with the principal point as free as `free_shift_sigma`.
    max_focal_difference: float = 0.05
    free_shift_sigma: float = 0.1  # of the principal point in that comparison, as a share of the longer side


@dataclass(frozen=True)
class Grouping:
    """Frames grouped by lens."""

    lens_of: tuple[int, ...]  # of each frame
    longer_side: int  # of the largest frame, in whose pixels all lenses are described
    scales: tuple[float, ...]  # of each frame: these pixels over its own


def group(keyframes: Sequence[Keyframe], across_sizes: bool) -> Grouping:
    """Frames of one camera, one size (landscape or portrait) and one nominal focal length share a lens.

    If `across_sizes`, frames of one shape do, whatever their size. Nominal focal lengths count over the longer side.
    """
    first: list[Keyframe] = []  # of each lens
    lens_of = []
    for keyframe in keyframes:
        known = (lens for lens, other in enumerate(first) if _may_share(keyframe, other, across_sizes))
        lens = next(known, len(first))
        if lens == len(first):
            first.append(keyframe)
        lens_of.append(lens)
    sides = [longer_side(keyframe.frame) for keyframe in keyframes]
    largest = max(sides)
    return Grouping(tuple(lens_of), largest, tuple(largest / side for side in sides))


def _may_share(one: Keyframe, other: Keyframe, across_sizes: bool) -> bool:
    """Whether two frames may have been taken through one lens."""
    if _nominal(one) != _nominal(other):
        return False
    if one.frame.camera_id != other.frame.camera_id:
        return False
    cameras = one.frame.camera, other.frame.camera
    if all(cameras) and cameras[0] != cameras[1]:
        return False
    (long1, short1), (long2, short2) = (sorted(k.frame.image.shape[:2], reverse=True) for k in (one, other))
    if not across_sizes:
        return (long1, short1) == (long2, short2)
    return abs(short1 / long1 - short2 / long2) * min(long1, long2) <= _ROUNDING_PX


def _nominal(keyframe: Keyframe) -> tuple[str, int] | None:
    """Source and step of the focal length that came with a frame; None without one."""
    given = keyframe.frame.intrinsics
    if given is None:
        return None
    return given.source, round(float(np.log(given.fx / longer_side(keyframe.frame))) / _SAME_NOMINAL)


def candidates(
    keyframes: Sequence[Keyframe],
    grouping: Grouping,
    pairs: Mapping[tuple[int, int], TwoView],
    config: LensGroupingConfig,
) -> list[Lens]:
    """For each lens, the focal length that came with its frames, else those that the pairs of its frames vote for."""
    found = []
    for lens in range(max(grouping.lens_of) + 1):
        members = [i for i, member in enumerate(grouping.lens_of) if member == lens]
        given = keyframes[members[0]].frame.intrinsics
        if given is not None:
            calibrated = given.source in ("given", "calibration")
            scale = grouping.scales[members[0]]
            found.append(Lens((scale * given.fx,), 0.0 if calibrated else config.exif_sigma))
            continue
        inside = [pair for key, pair in pairs.items() if key[0] in members and key[1] in members]
        # A single image has no pair through its own lens alone: those with other images say roughly what it is.
        inside = inside or [pair for key, pair in pairs.items() if key[0] in members or key[1] in members]
        ratios = vote(inside, _NUM_CANDIDATES)
        found.append(Lens(tuple(ratio * grouping.longer_side for ratio in ratios), config.voted_sigma))
    return found


def sizes_disagree(
    estimate: bundle_adjustment.Problem,
    prior: bundle_adjustment.LensPrior,
    loss: bundle_adjustment.BundleAdjustmentConfig,
    fixed_camera: int,
    grouping: Grouping,
    config: LensGroupingConfig,
) -> bool:
    """Whether frames that share a lens get different focal lengths when each of their sizes has a lens of its own.

    Calibrated lenses (sigma 0) are never doubted.
    """
    kinds = sorted(set(zip(grouping.lens_of, grouping.scales, strict=True)))
    kind_of = np.array([kinds.index(kind) for kind in zip(grouping.lens_of, grouping.scales, strict=True)])
    lens_of = np.array([lens for lens, _ in kinds])
    apart = replace(
        estimate,
        lens_of_camera=kind_of,
        log_focals=estimate.log_focals[lens_of],
        radials=estimate.radials[lens_of],
        shifts=estimate.shifts[lens_of],
    )
    sigmas = prior.sigmas[lens_of]
    free = bundle_adjustment.LensPrior(
        log_focals=prior.log_focals[lens_of],
        sigmas=sigmas,
        radial_sigmas=prior.radial_sigmas[lens_of],
        shift_sigmas=np.where(sigmas > 0, config.free_shift_sigma * grouping.longer_side, 0.0),
    )
    focals = bundle_adjustment.adjust(apart, free, loss, fixed_camera).log_focals
    observed = np.bincount(kind_of[estimate.camera_of], minlength=len(kinds)) > 0
    return any(
        np.ptp(focals[observed & (lens_of == lens)]) > config.max_focal_difference
        for lens in set(lens_of[observed].tolist())
    )
