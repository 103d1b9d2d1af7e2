"""What the verdict would be of a sample under other numbers, by the checks that ask the evidence alone."""

from __future__ import annotations

from dataclasses import replace

from splatnode.recon.evaluate.stability.claim import CameraError, claim_of
from splatnode.recon.evaluate.stability.fitting.samples import Sample
from splatnode.recon.verification.checks import Judged
from splatnode.recon.verification.config import Config
from splatnode.recon.verification.decision import LIMITS
from splatnode.recon.verification.finiteness import not_finite
from splatnode.recon.verification.likelihood import weigh
from splatnode.recon.verification.models import Numbers


def judged(sample: Sample, numbers: Numbers) -> Judged:
    return Judged(sample.evidence, Config(), numbers)


def passes_limits(sample: Sample, numbers: Numbers) -> bool:
    """Whether nothing refuses it but the odds."""
    case = judged(sample, numbers)
    if sample.stood_still:
        return False
    finite = not any(not_finite(sample.evidence))
    return finite and all(check(case) is None for check in LIMITS) and case.known


def published(sample: Sample, numbers: Numbers) -> bool:
    odds = weigh(sample.evidence, numbers.claims, numbers.odds)
    return odds.total >= Config().min_log_odds and passes_limits(sample, numbers)


def wrong(sample: Sample, numbers: Numbers) -> bool:
    """Grossly wrong; or not right, and beyond the claim."""
    return sample.gross or (not sample.right and beyond_claim(sample, numbers))


def beyond_claim(sample: Sample, numbers: Numbers) -> bool:
    """Beyond 2.5 times a bound; or beyond 5 degrees or 10 % of the distance, and said to be exact."""
    rough = not judged(sample, numbers).exact
    return not sample.together or any(error.wrong(rough) for error in claimed(sample, numbers))


def claimed(sample: Sample, numbers: Numbers) -> tuple[CameraError, ...]:
    """The errors, each beside the bounds that these numbers give its camera."""
    bounds = judged(sample, numbers).bounds
    return tuple(replace(error, bounds=claim_of(bounds[name])) for name, error in sample.errors.items())
