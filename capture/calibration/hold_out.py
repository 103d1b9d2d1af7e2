"""Which lens model to take: the one with the fewest terms that predicts views it was not fitted to as well as any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import Board
from splatnode.capture.calibration.bundle import solve
from splatnode.capture.calibration.corners import BoardView
from splatnode.capture.calibration.estimate import Estimate, estimate_lens, refit_lens
from splatnode.capture.calibration.models import MODELS, Model

Array = npt.NDArray[np.float64]

FOLDS = 5
_NOISE = 2.0  # standard errors: so much better in the mean over views is better
_SLIGHT = 0.01  # of the mean square error: so little is worth no term, however sure


@dataclass(frozen=True, eq=False)
class Trial:
    """A model fitted to all views, and how it predicts each from the others."""

    estimate: Estimate
    errors: Array  # (V,) mean square distance of a view's corners from where they are predicted, square pixels

    @property
    def validation_rms_px(self) -> float:
        """Root mean square over the views."""
        return float(np.sqrt(self.errors.mean()))


@dataclass(frozen=True)
class Choice:
    taken: Trial
    trials: tuple[Trial, ...]  # of all models that explain the views


def choose(
    views: Sequence[BoardView],
    board: Board,
    width: int,
    height: int,
    models: Sequence[Model] = tuple(MODELS.values()),
) -> Choice | None:
    """The choice among `models`, which have more terms one after the other; None where none explains the views."""
    fitted = [estimate_lens(views, board, model, width, height) for model in models]
    found = [each for each in fitted if each is not None and len(each.names) >= FOLDS]
    if not found:
        return None
    closest = min(found, key=lambda each: float(np.median(np.abs(each.solution.residuals))))
    again = [refit_lens(each, closest) for each in found]  # what was not seen right is of the pictures, not of a model
    trials = tuple(Trial(each, _cross_validate(each)) for each in again if each is not None)
    best = min(trials, key=lambda trial: trial.validation_rms_px)
    if not np.isfinite(best.validation_rms_px):
        return None
    return Choice(next(trial for trial in trials if not _is_worse(trial, best)), trials)


def _is_worse(trial: Trial, best: Trial) -> bool:
    """Whether `best` predicts better by more than chance: the views are paired, and differ by the model alone."""
    gains = trial.errors - best.errors
    if not np.isfinite(gains).all():
        return True
    mean, noise = gains.mean(), gains.std() / np.sqrt(len(gains) - 1)
    return bool(mean > _NOISE * noise and mean > _SLIGHT * best.errors.mean())


def _cross_validate(whole: Estimate) -> Array:
    """(V,) of its views; of a view that is left out, only the pose is found. Infinite where a fit fails."""
    corners, numbers = whole.corners, np.arange(len(whole.names))
    start, Ts, kind = whole.solution.numbers, whole.solution.Ts_camera_board, whole.model.kind
    errors = np.full(len(numbers), np.inf)
    for fold in range(FOLDS):
        out = numbers % FOLDS == fold
        fitted = solve(corners.select_corners(~out[corners.view]), start, Ts[~out], kind)
        rest = corners.select_corners(out[corners.view])
        posed = solve(rest, fitted.numbers, Ts[out], kind, fixed=True)
        if np.isfinite(posed.cost):
            counts = np.diff([*rest.starts, len(rest.view)])
            errors[out] = np.add.reduceat((posed.residuals**2).sum(axis=1), rest.starts) / counts
    return errors
