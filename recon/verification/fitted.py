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
                factor=1.57,
                floor=0.1,
                sigma=0.773,
                regions=0.466,
                profile=0.0,
                inlier_ratio=-0.48,
                link=0.0,
                count=0.327,
                own_lens=1.86,
            ),
            centre=BoundModel(
                factor=1.6,
                floor=0.0002,
                sigma=0.399,
                regions=0.627,
                profile=0.0,
                inlier_ratio=-0.462,
                link=-1.35,
                count=0.147,
                own_lens=1.99,
            ),
            focal=BoundModel(
                factor=5.1,
                floor=0.002,
                sigma=0.522,
                regions=0.395,
                profile=0.299,
                inlier_ratio=0.0,
                link=0.0,
                count=0.15,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.3,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=4.33),
                "camera_inlier_ratio": Term(typical=0.913, slope=0.0),
                "link_inlier_ratio": Term(typical=0.943, slope=1.58),
                "coverage": Term(typical=-0.993, slope=0.0),
                "flat_patch": Term(typical=0.011, slope=-3.24),
                "reflection": Term(typical=0.103, slope=-7.63),
                "directions": Term(typical=0.37, slope=-0.455),
                "rotation_bound": Term(typical=-0.194, slope=-1.09),
                "travel_bound": Term(typical=1.41, slope=-1.35),
                "own_lens": Term(typical=0.0, slope=-2.11),
            },
        ),
    ),
    pair=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=2.19,
                floor=0.1,
                sigma=0.705,
                regions=0.205,
                profile=0.0,
                inlier_ratio=-1.06,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
            centre=BoundModel(
                factor=1.33,
                floor=0.0002,
                sigma=0.208,
                regions=0.633,
                profile=0.0,
                inlier_ratio=-1.43,
                link=-1.43,
                count=0.0,
                own_lens=1.0,
            ),
            focal=BoundModel(
                factor=2.59,
                floor=0.002,
                sigma=0.653,
                regions=0.0571,
                profile=0.332,
                inlier_ratio=0.0,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
        ),
        odds=OddsModel(
            prior=2.06,
            terms={
                "inlier_ratio": Term(typical=0.942, slope=0.894),
                "camera_inlier_ratio": Term(typical=0.942, slope=0.894),
                "link_inlier_ratio": Term(typical=0.979, slope=6.65),
                "coverage": Term(typical=-1.16, slope=0.481),
                "flat_patch": Term(typical=0.00221, slope=-6.98),
                "reflection": Term(typical=0.102, slope=0.0),
                "directions": Term(typical=0.248, slope=0.0),
                "rotation_bound": Term(typical=1.03, slope=-1.49),
                "travel_bound": Term(typical=2.67, slope=-0.792),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
