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
                factor=1.72,
                floor=0.1,
                sigma=0.757,
                regions=0.493,
                profile=0.0,
                inlier_ratio=-0.711,
                link=0.0,
                count=0.293,
                own_lens=1.91,
            ),
            centre=BoundModel(
                factor=1.8,
                floor=0.0002,
                sigma=0.365,
                regions=0.661,
                profile=0.0,
                inlier_ratio=-0.854,
                link=-1.2,
                count=0.127,
                own_lens=1.9,
            ),
            focal=BoundModel(
                factor=5.55,
                floor=0.002,
                sigma=0.514,
                regions=0.419,
                profile=0.298,
                inlier_ratio=0.0,
                link=0.0,
                count=0.148,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.48,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=5.89),
                "camera_inlier_ratio": Term(typical=0.915, slope=0.0),
                "link_inlier_ratio": Term(typical=0.945, slope=0.124),
                "coverage": Term(typical=-0.98, slope=0.0),
                "flat_patch": Term(typical=0.0101, slope=-3.3),
                "reflection": Term(typical=0.104, slope=-8.09),
                "directions": Term(typical=0.359, slope=-0.367),
                "rotation_bound": Term(typical=-0.33, slope=-1.12),
                "travel_bound": Term(typical=1.24, slope=-1.47),
                "own_lens": Term(typical=0.0, slope=-1.47),
            },
        ),
    ),
    pair=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=2.29,
                floor=0.1,
                sigma=0.707,
                regions=0.22,
                profile=0.0,
                inlier_ratio=-0.624,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
            centre=BoundModel(
                factor=1.04,
                floor=0.0002,
                sigma=9.77e-05,
                regions=0.774,
                profile=0.0,
                inlier_ratio=-0.947,
                link=-0.947,
                count=0.0,
                own_lens=1.0,
            ),
            focal=BoundModel(
                factor=2.57,
                floor=0.002,
                sigma=0.652,
                regions=0.0549,
                profile=0.333,
                inlier_ratio=0.0,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
        ),
        odds=OddsModel(
            prior=2.32,
            terms={
                "inlier_ratio": Term(typical=0.939, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.939, slope=0.0),
                "link_inlier_ratio": Term(typical=0.976, slope=6.33),
                "coverage": Term(typical=-1.16, slope=0.407),
                "flat_patch": Term(typical=0.00219, slope=-4.91),
                "reflection": Term(typical=0.102, slope=0.0),
                "directions": Term(typical=0.238, slope=0.0),
                "rotation_bound": Term(typical=0.651, slope=-1.4),
                "travel_bound": Term(typical=1.45, slope=-0.762),
                "own_lens": Term(typical=0.0, slope=-2.24),
            },
        ),
    ),
)
