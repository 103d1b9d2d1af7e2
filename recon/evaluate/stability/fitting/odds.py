"""The odds: a logistic regression of right against wrong, whose slopes have the sign that their measure must have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from splatnode.recon.evaluate.stability.fitting.judge import exceeds_bounds, is_wrong, passes_limits
from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.verification.claims import ErrorModel
from splatnode.recon.verification.likelihood import OddsModel, Term, compute_measures
from splatnode.recon.verification.models import VerdictModel

Array = npt.NDArray[np.float64]

# Of the slopes: whether more of a measure speaks for the poses, or against them.
FOR = (
    "inlier_ratio",
    "camera_inlier_ratio",
    "link_inlier_ratio",
    "coverage",
    "mirrored_cost",
)
AGAINST = ("flat_patch", "reflection", "directions", "rotation_bound", "travel_bound")
SIGNS = {**dict.fromkeys(FOR, 1), **dict.fromkeys(AGAINST, -1)}
WRONG_WEIGHT = 4.0  # of a wrong registration beside a right one: there are fewer, and each counts more
RIDGE = 0.02  # penalty of squared slopes (in standard deviations), for each registration and slope
MARGIN = 0.5  # nats by which the best wrong registration stays refused: others are made elsewhere


def fit(samples: Sequence[Sample], claim_model: ErrorModel) -> OddsModel:
    """The prior is such that no registration beyond its claim is published whose scene was left out when it was judged.

    So is what a lens of its own counts, with the sets that break what is assumed of lenses: where an image has one,
    more must speak for the poses. Sets that break it and do not show it look like any other, and set no prior.
    """
    claims_alone = VerdictModel(claim_model, OddsModel(0.0, {}))
    known = [sample for sample in samples if sample.right or is_wrong(sample, claims_alone)]
    known = [sample for sample in known if sample.own_lens or not sample.broken]
    table = np.array([[compute_measures(sample.evidence, claim_model)[name] for name in SIGNS] for sample in known])
    right = np.array([sample.right for sample in known])
    scenes = np.array([sample.scene for sample in known])
    limits = np.array([passes_limits(sample, claims_alone) for sample in known])
    beyond = np.array([exceeds_bounds(sample, claims_alone) for sample in known])
    own, broken = (np.array([getattr(sample, name) for sample in known]) for name in ("own_lens", "broken"))
    left_out = np.zeros(len(known))
    for scene in np.unique(scenes):
        rest = (scenes != scene) & ~broken
        left_out[scenes == scene] = _compute_log_odds(_fit_regression(table[rest], right[rest]), table[scenes == scene])
    whole = _fit_regression(table[~broken], right[~broken])
    doubted = ~right & limits & beyond
    lower = _compute_offset(left_out[doubted & ~own])
    of_own = max(0.0, _compute_offset(left_out[doubted & own]) - lower)
    terms = {**whole.terms, "own_lens": Term(0.0, -float(f"{of_own:.3g}"))}
    return OddsModel(float(f"{whole.prior - lower:.3g}"), terms)


def _compute_offset(doubted: Array) -> float:
    """Returns by how much log odds must be lowered for none of these to be published."""
    return max(0.0, float(doubted.max()) + MARGIN) if len(doubted) else 0.0


def _fit_regression(table: Array, right: npt.NDArray[np.bool_]) -> OddsModel:
    names = list(SIGNS)
    typical, scale = table[right].mean(0), table.std(0) + 1e-9
    design = np.column_stack([np.ones(len(table)), (table - typical) / scale])
    weights = np.where(right, 1.0, WRONG_WEIGHT)
    target = right.astype(np.float64)

    def loss(slopes: Array) -> tuple[float, Array]:
        total = design @ slopes
        penalty = RIDGE * len(table) / len(names)
        value = float((weights * (np.logaddexp(0.0, total) - target * total)).sum() + penalty * (slopes[1:] ** 2).sum())
        gradient = design.T @ (weights * (1.0 / (1.0 + np.exp(-total)) - target))
        gradient[1:] += 2.0 * penalty * slopes[1:]
        return value, gradient

    limits = [(None, None), *((0.0, None) if SIGNS[name] > 0 else (None, 0.0) for name in names)]
    found = minimize(loss, np.zeros(1 + len(names)), jac=True, method="L-BFGS-B", bounds=limits).x
    terms = {
        name: Term(float(f"{typical[k]:.3g}"), float(f"{found[1 + k] / scale[k]:.3g}")) for k, name in enumerate(names)
    }
    return OddsModel(float(found[0]), terms)


def _compute_log_odds(model: OddsModel, table: Array) -> Array:
    """(M,) log odds of rows of measures (M, T), in the order of the terms."""
    typical = np.array([term.typical for term in model.terms.values()])
    return model.prior + (table - typical) @ np.array([term.slope for term in model.terms.values()])
