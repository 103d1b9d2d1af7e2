"""The models of the verdict, with the numbers that a fitting found for them."""

from __future__ import annotations

from dataclasses import dataclass

from splatnode.recon.verification.claims import ErrorModel
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.likelihood import OddsModel


@dataclass(frozen=True)
class VerdictModel:
    claims: ErrorModel
    odds: OddsModel


@dataclass(frozen=True)
class VerdictModels:
    """Two cameras have numbers of their own: no third one sees their points, and no similarity takes out an error."""

    many: VerdictModel
    pair: VerdictModel

    def select_model(self, evidence: Evidence) -> VerdictModel:
        return self.pair if len(evidence.cameras) == 2 else self.many
