"""The verdict on registered poses, before anything is published.

`refuse_before_registration` needs no registration; `decide` asks the checks one after the other, and the first that
refuses gives the reason. A further check is a file with a function of a `Case`, and its line in CHECKS.
"""

from __future__ import annotations

from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification import causes, checks
from splatnode.recon.verification.acceptances import accepted
from splatnode.recon.verification.before_registration import refuse_before_registration, refuse_unplaced
from splatnode.recon.verification.checks import Case
from splatnode.recon.verification.config import Config
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.fitted import FITTED
from splatnode.recon.verification.models import Fitted
from splatnode.recon.verification.odds_check import odds
from splatnode.recon.verification.strong_lens import bends_strongly
from splatnode.recon.verification.undetermined import undetermined

__all__ = ["Config", "decide", "refuse_before_registration"]

LIMITS = (  # each asks one piece of the evidence, and decides by itself
    checks.given_lens,
    checks.given_focal,
    checks.distortion,
    checks.moving_plane,
    checks.weakest_link,
    checks.disconnected,
    checks.mirrored_photographs,
)
CHECKS = (  # what is surer about the reason comes first; those after the first may take all numbers for finite
    undetermined,
    *LIMITS,
    bends_strongly,
    odds,
    causes.unknown,
    checks.required,
)


def decide(
    graph: ViewGraph,
    registration: Registration | None,
    evidence: Evidence | None,
    config: Config,
    fitted: Fitted = FITTED,
) -> Verdict:
    """OK, or another code that is publishable, or the reason why there is no scene.

    `evidence` is that of `recon.verification.verify` for this registration, which `refuse_before_registration` let
    pass.
    """
    if registration is None or evidence is None or len(registration.cameras) < config.min_cameras:
        return refuse_unplaced(graph, registration, config)
    case = Case(evidence, config, fitted.of(evidence), graph, registration)
    for check in CHECKS:
        refusal = check(case)
        if refusal is not None:
            return refusal
    return accepted(case)
