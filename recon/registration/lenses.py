"""Which frames were taken through one lens, and what is known of it before anything is reconstructed.

One camera stores its pictures in several sizes. What frames of one shape have in common is the focal length relative to
their longer side, so a lens counts in the pixels of its largest frame, and smaller ones are taken as enlarged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import Keyframe, longer_side
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.registration import bundle, focal
from splatnode.recon.registration.mapping_problem import Lens

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    exif_sigma: float = 0.05  # of log focal: nominal focal lengths are rounded, and focusing changes them
    voted_sigma: float = 0.3  # of log focal when frames voted for it
    # Frames of one shape and several sizes have one lens unless the focal lengths, found for each size by itself,
    # differ by this much (log): then some were cropped, or zoomed. Of resized ones they differed by 0.007 at most, of
    # crops to 75 % by 0.114 at least, with the principal point as free as this, of the longer side.
    same_focal: float = 0.05
    free_shift: float = 0.1


@dataclass(frozen=True)
class Grouping:
    """Frames by the lens that took them."""

    lens_of: tuple[int, ...]  # of each frame
    longer_sides: tuple[int, ...]  # of each lens: that of its largest frame
    enlarged: tuple[float, ...]  # of each frame: pixels of its lens over pixels of its own


def group(keyframes: Sequence[Keyframe], across_sizes: bool) -> Grouping:
    """Frames of one size (turned or not) and one nominal focal length share a lens; `across_sizes` those of one shape.

    A nominal focal length counts relative to the longer side.
    """
    first: list[Keyframe] = []  # of each lens
    lens_of = []
    for keyframe in keyframes:
        known = (i for i, other in enumerate(first) if _alike(keyframe, other, across_sizes))
        lens = next(known, len(first))
        if lens == len(first):
            first.append(keyframe)
        lens_of.append(lens)
    sides = [longer_side(keyframe.frame) for keyframe in keyframes]
    longer = [max(side for side, lens in zip(sides, lens_of, strict=True) if lens == g) for g in range(len(first))]
    enlarged = (longer[lens] / side for side, lens in zip(sides, lens_of, strict=True))
    return Grouping(tuple(lens_of), tuple(longer), tuple(enlarged))


def _alike(one: Keyframe, other: Keyframe, across_sizes: bool) -> bool:
    if _nominal(one) != _nominal(other):
        return False
    (long1, short1), (long2, short2) = (sorted(k.frame.image.shape[:2], reverse=True) for k in (one, other))
    if not across_sizes:
        return (long1, short1) == (long2, short2)
    return abs(short1 / long1 - short2 / long2) * min(long1, long2) <= 1.0  # sizes are rounded to whole pixels


def _nominal(keyframe: Keyframe) -> tuple[str, int] | None:
    given = keyframe.frame.intrinsics
    return (
        None if given is None else (given.source, round(float(np.log(given.fx / longer_side(keyframe.frame))) / 0.01))
    )


def lenses(
    keyframes: Sequence[Keyframe], grouping: Grouping, pairs: Mapping[tuple[int, int], TwoView], config: Config
) -> list[Lens]:
    """What is known of each lens: what came with its frames, or what the pairs of its frames vote for."""
    found = []
    for lens, side in enumerate(grouping.longer_sides):
        members = [i for i, member in enumerate(grouping.lens_of) if member == lens]
        given = keyframes[members[0]].frame.intrinsics
        if given is not None:
            known = given.source in ("given", "calibration")
            enlarged = grouping.enlarged[members[0]]
            found.append(Lens((enlarged * given.fx,), 0.0 if known else config.exif_sigma))
            continue
        inside = [pair for key, pair in pairs.items() if key[0] in members and key[1] in members]
        ratios = focal.vote(inside, num_candidates=3)
        found.append(Lens(tuple(ratio * side for ratio in ratios), config.voted_sigma))
    return found


def contradicted(
    problem: bundle.Problem,
    prior: bundle.LensPrior,
    loss: bundle.Config,
    fixed_camera: int,
    grouping: Grouping,
    config: Config,
) -> bool:
    """Whether frames of several sizes, adjusted with a lens for each, turn out not to be of the lens that they share.

    Only lenses that are not calibrated are asked.
    """
    kinds = sorted(set(zip(grouping.lens_of, grouping.enlarged, strict=True)))
    kind_of = np.array([kinds.index(kind) for kind in zip(grouping.lens_of, grouping.enlarged, strict=True)])
    lens_of = np.array([lens for lens, _ in kinds])
    apart = replace(
        problem,
        lens_of_camera=kind_of,
        log_focals=problem.log_focals[lens_of],
        radials=problem.radials[lens_of],
        shifts=problem.shifts[lens_of],
    )
    sigmas = prior.sigmas[lens_of]
    free = bundle.LensPrior(
        log_focals=prior.log_focals[lens_of],
        sigmas=sigmas,
        radial_sigmas=prior.radial_sigmas[lens_of],
        shift_sigmas=config.free_shift * np.array(grouping.longer_sides)[lens_of] * (sigmas > 0),
    )
    focals = bundle.adjust(apart, free, loss, fixed_camera).log_focals
    seen = np.bincount(kind_of[problem.camera_of], minlength=len(kinds)) > 0
    return any(np.ptp(focals[seen & (lens_of == lens)]) > config.same_focal for lens in set(lens_of[seen].tolist()))
