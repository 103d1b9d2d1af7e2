"""The numbers of the verdict. Written by `python -m tests.bench fit`; do not edit."""

from __future__ import annotations

from splatnode.recon.verification.error_model import (
    BoundModel,
    ErrorModel,
    OddsModel,
    Term,
    VerdictModel,
    VerdictModels,
)

FITTED = VerdictModels(
    many=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=1.54,
                floor=0.1,
                sigma=0.796,
                regions=0.407,
                profile=0.0,
                inlier_ratio=-0.659,
                link=0.0,
                count=0.291,
                own_lens=2.06,
            ),
            centre=BoundModel(
                factor=1.43,
                floor=0.0002,
                sigma=0.362,
                regions=0.639,
                profile=0.0,
                inlier_ratio=-0.643,
                link=-1.31,
                count=0.138,
                own_lens=1.97,
            ),
            focal=BoundModel(
                factor=4.06,
                floor=0.002,
                sigma=0.384,
                regions=0.36,
                profile=0.434,
                inlier_ratio=0.0,
                link=0.0,
                count=0.155,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.72,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=2.24),
                "camera_inlier_ratio": Term(typical=0.915, slope=0.0),
                "link_inlier_ratio": Term(typical=0.945, slope=0.0),
                "coverage": Term(typical=-0.976, slope=1.64),
                "flat_patch": Term(typical=0.0105, slope=-2.18),
                "reflection": Term(typical=0.104, slope=-5.97),
                "directions": Term(typical=0.367, slope=-0.307),
                "rotation_bound": Term(typical=-0.39, slope=-0.947),
                "travel_bound": Term(typical=1.19, slope=-1.49),
                "own_lens": Term(typical=0.0, slope=-1.96),
            },
        ),
    ),
    pair=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=2.21,
                floor=0.1,
                sigma=0.694,
                regions=0.221,
                profile=0.0,
                inlier_ratio=-0.994,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
            centre=BoundModel(
                factor=1.1,
                floor=0.0002,
                sigma=9.77e-05,
                regions=0.782,
                profile=0.0,
                inlier_ratio=-0.915,
                link=-0.915,
                count=0.0,
                own_lens=1.0,
            ),
            focal=BoundModel(
                factor=3.12,
                floor=0.002,
                sigma=0.605,
                regions=0.0643,
                profile=0.358,
                inlier_ratio=0.0,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
        ),
        odds=OddsModel(
            prior=0.857,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.94, slope=0.0),
                "link_inlier_ratio": Term(typical=0.977, slope=3.53),
                "coverage": Term(typical=-1.15, slope=0.585),
                "flat_patch": Term(typical=0.00223, slope=-4.49),
                "reflection": Term(typical=0.102, slope=-1.88),
                "directions": Term(typical=0.219, slope=0.0),
                "rotation_bound": Term(typical=0.576, slope=-1.6),
                "travel_bound": Term(typical=1.41, slope=-0.78),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
