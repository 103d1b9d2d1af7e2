"""The verdict on registered poses, before anything is published.

`refuse_before_registration` needs no registration; `decide` asks the checks one after the other, and the first that
refuses gives the reason. A further check is a file with a function of a `VerificationCase`, and its line in CHECKS.
"""

from __future__ import annotations

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import causes, checks
from splatnode.recon.verification.acceptances import accept
from splatnode.recon.verification.before_registration import refuse_before_registration, refuse_unplaced
from splatnode.recon.verification.checks import VerificationCase
from splatnode.recon.verification.config import DecisionConfig
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.models import VerdictModels
from splatnode.recon.verification.odds_check import check_odds
from splatnode.recon.verification.strong_lens import check_strong_distortion
from splatnode.recon.verification.undetermined import check_finite

__all__ = ["DecisionConfig", "decide", "refuse_before_registration"]

LIMITS = (  # each asks one piece of the evidence, and decides by itself
    checks.check_given_lens,
    checks.check_given_focal,
    checks.check_distortion,
    checks.check_moving_plane,
    checks.check_weakest_link,
    checks.check_connectivity,
    checks.check_mirrored_images,
)
CHECKS = (  # what is surer about the reason comes first; those after the first may take all numbers for finite
    check_finite,
    *LIMITS,
    check_strong_distortion,
    check_odds,
    causes.check_bounds,
    checks.check_required_precision,
)


def decide(
    graph: ViewGraph,
    registration: Registration | None,
    evidence: Evidence | None,
    config: DecisionConfig,
    fitted: VerdictModels = FITTED,
) -> Verdict:
    """OK, or another code that is publishable, or the reason why there is no scene.

    `evidence` is that of `recon.verification.verify` for this registration, which `refuse_before_registration` let
    pass.
    """
    if registration is None or evidence is None or len(registration.cameras) < config.min_cameras:
        return refuse_unplaced(graph, registration, config)
    case = VerificationCase(evidence, config, fitted.select_model(evidence), graph, registration)
    for check in CHECKS:
        refusal = check(case)
        if refusal is not None:
            return refusal
    return accept(case)
