"""All that is known of a photograph when it is judged."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.locating import posing
from splatnode.recon.locating.correspondences import Correspondences
from splatnode.recon.locating.posing import Posed
from splatnode.recon.matching.two_view import log10_number_of_false_alarms

Array = npt.NDArray[np.float64]

_SAMPLE = 4  # correspondences that define a pose and a focal length
_CELL = 4.0  # side of a cell in which features count as one, in limits of their errors
_SHUFFLES = 20  # of the landmarks among the pixels, which tell how often chance agrees


@dataclass(frozen=True, eq=False)
class Case:
    """A photograph's correspondences, and the camera that explains most of them."""

    known: Correspondences
    posed: Posed | None  # None: there is no camera
    width: int  # of the photograph, pixels
    height: int
    scale: float  # pixels for one at REFERENCE_SIDE
    noise_px: float  # of an observation, pixels of the photograph
    unit: float  # the median depth of the scene's points
    settings: posing.Config
    log10_nfa: float  # log10 of the expected number of cameras that chance gives so much agreement

    @classmethod
    def of(
        cls,
        known: Correspondences,
        posed: Posed | None,
        width: int,
        height: int,
        scale: float,
        noise_px: float,
        unit: float,
        settings: posing.Config,
    ) -> Case:
        log10_nfa = 0.0 if posed is None else _log10_nfa(known, posed, settings.max_error_px * scale, width * height)
        return cls(known, posed, width, height, scale, noise_px, unit, settings, log10_nfa)

    @property
    def num_independent(self) -> int:
        """How many spots of the photograph agree with the camera."""
        return independent(self.agreeing.pixels, self.settings.max_error_px * self.scale)

    @property
    def agreeing(self) -> Correspondences:
        """What agrees with the camera."""
        return self.known.of(np.zeros(0, np.int64) if self.posed is None else self.posed.agreeing)


def _log10_nfa(known: Correspondences, posed: Posed, limit_px: float, area: int) -> float:
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
    apart, agreeing = (independent(pixels, limit_px) for pixels in (known.pixels, known.pixels[posed.agreeing]))
    return log10_number_of_false_alarms(max(apart, agreeing), agreeing, _SAMPLE, min(chance, 1.0))


def independent(pixels: Array, limit_px: float) -> int:
    """How many of the pixels (M, 2) say something of their own: those in one cell of the picture count as one.

    One spot of the picture has several features, and where one of them agrees by chance, the others do, too.
    """
    return len(np.unique(np.floor(pixels / (_CELL * limit_px)), axis=0))
