"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.claims import BoundModel, ClaimModel
from splatnode.recon.verification.likelihood import OddsModel, Term
from splatnode.recon.verification.models import Fitted, Numbers

FITTED = Fitted(
    many=Numbers(
        claims=ClaimModel(
            rotation=BoundModel(
                factor=1.6,
                floor=0.1,
                sigma=0.72,
                regions=0.425,
                profile=0.0,
                inlier_ratio=-0.952,
                link=0.0,
                count=0.304,
                own_lens=2.55,
            ),
            centre=BoundModel(
                factor=1.41,
                floor=0.0002,
                sigma=0.355,
                regions=0.625,
                profile=0.0,
                inlier_ratio=-1.12,
                link=-1.28,
                count=0.193,
                own_lens=1.99,
            ),
            focal=BoundModel(
                factor=4.09,
                floor=0.002,
                sigma=0.361,
                regions=0.333,
                profile=0.453,
                inlier_ratio=0.0,
                link=0.0,
                count=0.215,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.77,
            terms={
                "inlier_ratio": Term(typical=0.943, slope=7.27),
                "camera_inlier_ratio": Term(typical=0.922, slope=0.0),
                "link_inlier_ratio": Term(typical=0.951, slope=0.0),
                "coverage": Term(typical=-0.972, slope=0.0),
                "mirrored_cost": Term(typical=2.23, slope=0.0),
                "flat_patch": Term(typical=0.00945, slope=-6.04),
                "reflection": Term(typical=0.103, slope=-8.52),
                "directions": Term(typical=0.348, slope=-0.00825),
                "rotation_bound": Term(typical=-0.667, slope=-0.875),
                "travel_bound": Term(typical=0.427, slope=-1.39),
                "own_lens": Term(typical=0.0, slope=-3.14),
            },
        ),
    ),
    pair=Numbers(
        claims=ClaimModel(
            rotation=BoundModel(
                factor=2.98,
                floor=0.1,
                sigma=0.664,
                regions=0.286,
                profile=0.0,
                inlier_ratio=-0.692,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
            centre=BoundModel(
                factor=0.964,
                floor=0.0002,
                sigma=9.77e-05,
                regions=0.751,
                profile=0.0,
                inlier_ratio=-1.08,
                link=-1.08,
                count=0.0,
                own_lens=1.0,
            ),
            focal=BoundModel(
                factor=3.41,
                floor=0.002,
                sigma=0.406,
                regions=0.0928,
                profile=0.502,
                inlier_ratio=0.0,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
        ),
        odds=OddsModel(
            prior=0.658,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=0.189),
                "camera_inlier_ratio": Term(typical=0.94, slope=0.189),
                "link_inlier_ratio": Term(typical=0.977, slope=5.82),
                "coverage": Term(typical=-1.13, slope=0.765),
                "mirrored_cost": Term(typical=2.19, slope=0.0),
                "flat_patch": Term(typical=0.00303, slope=-4.13),
                "reflection": Term(typical=0.102, slope=-2.76),
                "directions": Term(typical=0.233, slope=-0.574),
                "rotation_bound": Term(typical=0.448, slope=-1.48),
                "travel_bound": Term(typical=1.45, slope=-0.798),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
