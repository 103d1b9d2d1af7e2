"""The models of the verdict, with the numbers that a fitting found for them."""

from __future__ import annotations

from dataclasses import dataclass

from splatnode.recon.verification.claims import ClaimModel
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.likelihood import OddsModel


@dataclass(frozen=True)
class Numbers:
    claims: ClaimModel
    odds: OddsModel


@dataclass(frozen=True)
class Fitted:
    """Two cameras have numbers of their own: no third one sees their points, and no similarity takes out an error."""

    many: Numbers
    pair: Numbers

    def of(self, evidence: Evidence) -> Numbers:
        return self.pair if len(evidence.cameras) == 2 else self.many
