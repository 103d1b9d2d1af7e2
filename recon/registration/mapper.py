"""Mapping for few views: several first pairs, several focal lengths, and the map that explains most of all matches.

With a handful of views there is time to try; the attempts are rated by ALL the pairwise matches, those included that a
map was not built from.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.registration import bundle, finishing, incremental, mapping_problem, triangulation
from splatnode.recon.registration.mapping_problem import Growth, Lens, Pairs, Survey, View
from splatnode.recon.registration.subpixel import Picture

Array = npt.NDArray[np.float64]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    incremental: incremental.Config = incremental.Config()
    finishing: finishing.Config = finishing.Config()
    growing_tracks: int = 350  # a view, while views are added: more cost time and change no decision
    final_tracks: int = 1500  # a view, in the end
    max_attempts: int = 6  # (focal, first pair) combinations tried
    score_px: float = 1.25  # error at which a match counts no more for an attempt, at 1024 px on the longer side
    same_rotation_deg: float = 0.5  # two attempts whose cameras and
    same_focal: float = 0.02  # focal lengths differ by less have found the same
    rival_rotation_deg: float = 5.0  # two attempts whose common cameras differ by more contradict each other


@dataclass(frozen=True, eq=False)
class Map:
    """Registered cameras and points. `problem` numbers the cameras as `views` does."""

    views: tuple[int, ...]  # indices of the registered views; the first is the world's origin
    problem: bundle.Problem
    prior: bundle.LensPrior
    loss: bundle.Config
    agreement: dict[tuple[int, int], float]  # share of each pair's inliers that the map explains
    median_angle_deg: float  # of the points' widest rays
    rms_px: float  # at 1024 px on the longer side
    rival: float  # score of the best attempt that found other cameras over the score of this map; 0 without any

    def renumbered(self, number: Sequence[int]) -> Map:
        """The map of the same views, of which what was view i is now view `number[i]`."""
        place, new = np.argsort(number), np.asarray(number)
        problem = replace(
            self.problem,
            rotations=self.problem.rotations[place],
            translations=self.problem.translations[place],
            lens_of_camera=self.problem.lens_of_camera[place],
            camera_of=new[self.problem.camera_of],
        )
        pairs = {(i, j): (min(new[i], new[j]), max(new[i], new[j])) for i, j in self.agreement}
        agreement = {(int(i), int(j)): self.agreement[old] for old, (i, j) in pairs.items()}
        return replace(
            self,
            views=tuple(int(new[view]) for view in self.views),
            problem=problem,
            agreement=dict(sorted(agreement.items())),
        )


def build_map(
    views: Sequence[View],
    lenses: Sequence[Lens],
    pairs: Pairs,
    config: Config,
    pictures: Sequence[Picture] = (),
    pause: Callable[[], None] = lambda: None,
) -> Map | None:
    """The best map over several starts, or None when no two views can be connected.

    `pictures`, one a view, make its observations exact. `pause` is called between attempts and may raise.
    """
    of = mapping_problem.survey(views, lenses, pairs, config.growing_tracks, config.final_tracks)
    attempts: list[tuple[float, Growth]] = []
    for pair, focals in _attempts(lenses, pairs, config.max_attempts):
        pause()
        grown = incremental.grow(of, focals, pair, config.incremental)
        if grown is None:
            continue
        found_again = bool(attempts) and _same(max(attempts, key=_score)[1], grown, config)
        attempts.append((incremental.score(of, grown, config.score_px), grown))
        if found_again and len(grown.registered) == len(views):
            break
    if not attempts:
        return None
    pause()
    best = max(attempts, key=_score)
    rivals = [
        score for score, grown in attempts if mapping_problem.difference(best[1], grown)[0] > config.rival_rotation_deg
    ]
    finished = finishing.finish(of, best[1], pictures, config.finishing)
    return None if finished is None else as_map(of, finished, max(rivals, default=0.0) / max(best[0], 1e-9), config)


def _score(attempt: tuple[float, Growth]) -> float:
    return attempt[0]


def _same(one: Growth, other: Growth, config: Config) -> bool:
    if set(one.registered) != set(other.registered):
        return False
    turned, zoomed = mapping_problem.difference(one, other)
    return turned < config.same_rotation_deg and zoomed < config.same_focal


def _attempts(lenses: Sequence[Lens], pairs: Pairs, limit: int) -> list[tuple[tuple[int, int], list[float]]]:
    """First pairs with focal lengths (one a lens), the likeliest of both first."""
    first = _first_pairs(pairs)
    num_focals = max(len(lens.focals) for lens in lenses)
    focals = [[lens.focals[min(choice, len(lens.focals) - 1)] for lens in lenses] for choice in range(num_focals)]
    order = sorted(itertools.product(range(len(first)), range(num_focals)), key=lambda place: (sum(place), place[0]))
    return [(first[pair], focals[choice]) for pair, choice in order[:limit]]


def _first_pairs(pairs: Pairs) -> list[tuple[int, int]]:
    """Pairs with many matches that a plane or a rotation does not explain come first."""

    def strength(key: tuple[int, int]) -> float:
        view = pairs[key]
        count = len(view.matches)
        return count * (1.05 - min(1.0, max(view.num_homography, view.num_rotation) / count)) ** 0.5

    return sorted(pairs, key=lambda key: (-strength(key), key))


def as_map(of: Survey, finished: finishing.Finished, rival: float, config: Config) -> Map:
    """The finished growth with what is known of it."""
    grown, problem = finished.incremental, finished.incremental.problem
    centres = -np.einsum("cji,cj->ci", problem.rotations, problem.translations)
    angles = triangulation.largest_angles(centres, problem.points, problem.camera_of, problem.point_of)
    return Map(
        views=grown.registered,
        problem=problem,
        prior=grown.prior,
        loss=finished.loss,
        agreement=mapping_problem.agreement(of, grown, config.incremental.triangulation.max_error_px),
        median_angle_deg=float(np.median(angles)),
        rms_px=finished.rms_px,
        rival=rival,
    )
