"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.claims import BoundModel, ClaimModel
from splatnode.recon.verification.likelihood import OddsModel, Term
from splatnode.recon.verification.models import Fitted, Numbers

FITTED = Fitted(
    many=Numbers(
        claims=ClaimModel(
            rotation=BoundModel(
                factor=1.91,
                floor=0.1,
                sigma=0.517,
                regions=0.673,
                profile=0.0,
                inlier_ratio=-0.394,
                link=0.0,
                count=0.335,
            ),
            centre=BoundModel(
                factor=1.2,
                floor=0.0002,
                sigma=0.28,
                regions=0.655,
                profile=0.0,
                inlier_ratio=-0.642,
                link=-1.15,
                count=0.162,
            ),
            focal=BoundModel(
                factor=1.98,
                floor=0.002,
                sigma=0.442,
                regions=0.0719,
                profile=0.393,
                inlier_ratio=0.0,
                link=0.0,
                count=0.12,
            ),
        ),
        odds=OddsModel(
            prior=3.23,
            terms={
                "inlier_ratio": Term(typical=0.943, slope=7.89),
                "link_inlier_ratio": Term(typical=0.954, slope=0.302),
                "coverage": Term(typical=-0.954, slope=0.0),
                "mirrored_cost": Term(typical=2.21, slope=0.0),
                "flat_patch": Term(typical=0.0112, slope=-3.26),
                "reflection": Term(typical=0.104, slope=-17.0),
                "directions": Term(typical=0.0849, slope=-1.92),
                "own_lens": Term(typical=0.0, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.925, slope=0.0),
                "rotation_bound": Term(typical=-0.679, slope=-1.58),
                "travel_bound": Term(typical=0.193, slope=-0.848),
            },
        ),
    ),
    pair=Numbers(
        claims=ClaimModel(
            rotation=BoundModel(
                factor=3.02, floor=0.1, sigma=0.53, regions=0.478, profile=0.0, inlier_ratio=0.0, link=0.0, count=0.0
            ),
            centre=BoundModel(
                factor=2.06,
                floor=0.0002,
                sigma=9.77e-05,
                regions=0.891,
                profile=0.0,
                inlier_ratio=-1.11,
                link=-1.11,
                count=0.0,
            ),
            focal=BoundModel(
                factor=2.99,
                floor=0.002,
                sigma=0.964,
                regions=0.106,
                profile=0.0,
                inlier_ratio=-4.88e-05,
                link=0.0,
                count=0.0,
            ),
        ),
        odds=OddsModel(
            prior=0.075,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=0.0),
                "link_inlier_ratio": Term(typical=0.975, slope=7.16),
                "coverage": Term(typical=-1.01, slope=1.62),
                "mirrored_cost": Term(typical=2.22, slope=1.41),
                "flat_patch": Term(typical=0.00864, slope=-4.4),
                "reflection": Term(typical=0.103, slope=0.0),
                "directions": Term(typical=0.0826, slope=0.0),
                "own_lens": Term(typical=0.0, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.925, slope=0.0),
                "rotation_bound": Term(typical=-0.275, slope=-0.967),
                "travel_bound": Term(typical=1.27, slope=-0.497),
            },
        ),
    ),
)
