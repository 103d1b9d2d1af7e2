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
                factor=1.34,
                floor=0.1,
                sigma=0.72,
                regions=0.425,
                profile=0.0,
                inlier_ratio=-0.952,
                link=0.0,
                count=0.304,
                own_lens=2.03,
            ),
            centre=BoundModel(
                factor=1.18,
                floor=0.0002,
                sigma=0.355,
                regions=0.625,
                profile=0.0,
                inlier_ratio=-1.12,
                link=-1.28,
                count=0.193,
                own_lens=1.9,
            ),
            focal=BoundModel(
                factor=3.24,
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
            prior=4.53,
            terms={
                "inlier_ratio": Term(typical=0.943, slope=8.54),
                "camera_inlier_ratio": Term(typical=0.922, slope=0.0),
                "link_inlier_ratio": Term(typical=0.951, slope=0.0),
                "coverage": Term(typical=-0.972, slope=0.0),
                "flat_patch": Term(typical=0.00945, slope=-5.01),
                "reflection": Term(typical=0.103, slope=-9.04),
                "directions": Term(typical=0.348, slope=-0.0694),
                "rotation_bound": Term(typical=-0.537, slope=-0.784),
                "travel_bound": Term(typical=0.936, slope=-1.52),
                "own_lens": Term(typical=0.0, slope=-3.96),
            },
        ),
    ),
    pair=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=2.54,
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
                factor=0.901,
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
                factor=2.67,
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
            prior=1.07,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=0.334),
                "camera_inlier_ratio": Term(typical=0.94, slope=0.334),
                "link_inlier_ratio": Term(typical=0.977, slope=5.59),
                "coverage": Term(typical=-1.13, slope=0.791),
                "flat_patch": Term(typical=0.00303, slope=-3.93),
                "reflection": Term(typical=0.102, slope=-2.65),
                "directions": Term(typical=0.233, slope=-0.468),
                "rotation_bound": Term(typical=0.444, slope=-1.38),
                "travel_bound": Term(typical=1.4, slope=-0.828),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
