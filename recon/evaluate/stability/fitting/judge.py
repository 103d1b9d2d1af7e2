"""What the verdict would be of a sample under other numbers, by the checks that ask the evidence alone."""

from __future__ import annotations

from dataclasses import replace

from splatnode.recon.evaluate.stability.claim import CameraError, make_finite_bounds
from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.verification.checks import EvidenceCase
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.decision import LIMITS
from splatnode.recon.verification.finiteness import find_non_finite
from splatnode.recon.verification.likelihood import compute_log_odds
from splatnode.recon.verification.models import VerdictModel


def judge_sample(sample: Sample, numbers: VerdictModel) -> EvidenceCase:
    return EvidenceCase(sample.evidence, DecisionConfig(), numbers)


def passes_limits(sample: Sample, numbers: VerdictModel) -> bool:
    """Whether nothing refuses it but the odds."""
    case = judge_sample(sample, numbers)
    if sample.stood_still:
        return False
    finite = not any(find_non_finite(sample.evidence))
    return finite and all(check(case) is None for check in LIMITS) and case.is_usable


def is_published(sample: Sample, numbers: VerdictModel) -> bool:
    odds = compute_log_odds(sample.evidence, numbers.claims, numbers.odds)
    return odds.total >= DecisionConfig().min_log_odds and passes_limits(sample, numbers)


def is_wrong(sample: Sample, numbers: VerdictModel) -> bool:
    """Grossly wrong; or not right, and beyond the claim."""
    return sample.is_gross or (not sample.right and exceeds_bounds(sample, numbers))


def exceeds_bounds(sample: Sample, numbers: VerdictModel) -> bool:
    """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance, and said to be exact."""
    rough = not judge_sample(sample, numbers).is_exact
    return not sample.is_one_world or any(error.is_wrong(rough) for error in attach_bounds(sample, numbers))


def attach_bounds(sample: Sample, numbers: VerdictModel) -> tuple[CameraError, ...]:
    """The errors, each beside the bounds that these numbers give its camera."""
    bounds = judge_sample(sample, numbers).bounds
    return tuple(replace(error, bounds=make_finite_bounds(bounds[name])) for name, error in sample.errors.items())
