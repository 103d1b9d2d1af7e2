"""All that is known of a photograph when it is judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.frames.keyframe import REFERENCE_SIDE
from splatnode.recon.locating import posing
from splatnode.recon.locating.camera_model import CameraModel, Lens
from splatnode.recon.locating.correspondences import Correspondences
from splatnode.recon.locating.outcome import LensSource
from splatnode.recon.locating.posing import PoseEstimate
from splatnode.recon.matching.two_view import log10_number_of_false_alarms

Array = npt.NDArray[np.float64]

_SAMPLE = 5  # correspondences that define a pose, a focal length and a principal point
_CELL = 4.0  # side of a cell in which features count as one, in limits of their errors
_SHUFFLES = 20  # of the landmarks among the pixels, which tell how often chance agrees


@dataclass(frozen=True, eq=False)
class QueryContext:
    """The correspondences and settings by which a camera of a query image is judged."""

    known: Correspondences
    width: int  # of the photograph, pixels
    height: int
    reference_noise_px: float  # of an observation, pixels at REFERENCE_SIDE
    unit: float  # the median depth of the scene's points
    settings: posing.PoseSearchConfig

    @property
    def side(self) -> int:
        """The longer side, pixels."""
        return max(self.width, self.height)

    @property
    def scale(self) -> float:
        """Pixels for one at REFERENCE_SIDE."""
        return self.side / REFERENCE_SIDE

    @property
    def noise_px(self) -> float:
        """Returns the standard deviation of an observation, pixels of the query image."""
        return self.reference_noise_px * self.scale

    def estimate_pose(self, *lenses: Lens) -> PoseEstimate | None:
        """The camera with that of the lenses on which most correspondences agree."""
        return posing.estimate_pose(self.known, lenses, self.scale, self.noise_px, self.settings)

    def refine_pose(self, camera: CameraModel, lens: Lens) -> PoseEstimate | None:
        """The camera refined, with its inliers found again."""
        return posing.refine_pose(camera, self.known, lens, self.scale, self.noise_px, self.settings)

    def make_hypothesis(
        self, posed: PoseEstimate | None, source: LensSource = LensSource.FREE, rivals: Sequence[PoseEstimate] = ()
    ) -> PoseHypothesis:
        limit_px = self.settings.max_error_px * self.scale
        log10_nfa = 0.0 if posed is None else _log10_nfa(self.known, posed, limit_px, self.width * self.height)
        return PoseHypothesis(self, posed, log10_nfa, source, tuple(rivals))


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A camera for a photograph."""

    by: QueryContext
    posed: PoseEstimate | None  # None: there is none
    log10_nfa: float  # log10 of the expected number of cameras that chance gives so much agreement
    source: LensSource  # of the camera's lens
    rivals: tuple[PoseEstimate, ...] = ()  # cameras with other lenses that were found, too

    @property
    def correspondences(self) -> Correspondences:
        return self.by.known

    @property
    def num_independent(self) -> int:
        """How many spots of the photograph agree with the camera."""
        return count_independent(self.inliers.pixels, self.by.settings.max_error_px * self.by.scale)

    @property
    def inliers(self) -> Correspondences:
        """Returns the correspondences that agree with the camera."""
        return self.correspondences.select(np.zeros(0, np.int64) if self.posed is None else self.posed.agreeing)


def _log10_nfa(known: Correspondences, posed: PoseEstimate, limit_px: float, area: int) -> float:
    """log10 of the number of false alarms (Moisan and Stival, 2004), of unrelated pixels and landmarks.

    The chance of one agreement is that of landmarks dealt anew among the pixels, which are not spread evenly either,
    and at least that of an even spread.
    """
    seen, depth = posed.fit.camera.project(known.points)
    seen = np.where(depth[:, None] > 0, seen, np.inf)
    generator, hits = np.random.default_rng(0), 0
    for _ in range(_SHUFFLES):
        dealt = seen[generator.permutation(len(seen))]
        hits += int((np.linalg.norm(dealt - known.pixels, axis=1) < limit_px).sum())
    own = int(posed.agreeing.sum())
    # A landmark that is dealt to its own pixel again is no chance; on average one an agreement and shuffle in M is.
    dealt_again = _SHUFFLES * own / max(len(seen), 1)
    chance = max((hits - dealt_again) / (_SHUFFLES * max(len(seen), 1)), math.pi * limit_px**2 / area)
    apart, agreeing = (count_independent(pixels, limit_px) for pixels in (known.pixels, known.pixels[posed.agreeing]))
    return log10_number_of_false_alarms(max(apart, agreeing), agreeing, _SAMPLE, min(chance, 1.0))


def count_independent(pixels: Array, limit_px: float) -> int:
    """How many of the pixels (M, 2) say something of their own: those in one cell of the picture count as one.

    One spot of the picture has several features, and where one of them agrees by chance, the others do, too.
    """
    return len(np.unique(np.floor(pixels / (_CELL * limit_px)), axis=0))
