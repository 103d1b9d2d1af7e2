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
                factor=1.68,
                floor=0.1,
                sigma=0.747,
                regions=0.506,
                profile=0.0,
                inlier_ratio=-0.593,
                link=0.0,
                count=0.312,
                own_lens=1.83,
            ),
            centre=BoundModel(
                factor=1.78,
                floor=0.0002,
                sigma=0.357,
                regions=0.668,
                profile=0.0,
                inlier_ratio=-0.814,
                link=-1.16,
                count=0.132,
                own_lens=1.9,
            ),
            focal=BoundModel(
                factor=5.6,
                floor=0.002,
                sigma=0.516,
                regions=0.414,
                profile=0.297,
                inlier_ratio=0.0,
                link=0.0,
                count=0.125,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.55,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=5.37),
                "camera_inlier_ratio": Term(typical=0.914, slope=0.0),
                "link_inlier_ratio": Term(typical=0.944, slope=0.723),
                "coverage": Term(typical=-0.983, slope=0.0),
                "flat_patch": Term(typical=0.00995, slope=-3.46),
                "reflection": Term(typical=0.103, slope=-8.11),
                "directions": Term(typical=0.368, slope=-0.555),
                "rotation_bound": Term(typical=-0.209, slope=-1.2),
                "travel_bound": Term(typical=1.4, slope=-1.42),
                "own_lens": Term(typical=0.0, slope=-1.93),
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
                factor=1.66,
                floor=0.0002,
                sigma=0.208,
                regions=0.663,
                profile=0.0,
                inlier_ratio=-0.846,
                link=-0.846,
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
            prior=2.09,
            terms={
                "inlier_ratio": Term(typical=0.939, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.939, slope=0.0),
                "link_inlier_ratio": Term(typical=0.976, slope=5.39),
                "coverage": Term(typical=-1.16, slope=0.606),
                "flat_patch": Term(typical=0.00219, slope=-6.81),
                "reflection": Term(typical=0.102, slope=0.0),
                "directions": Term(typical=0.238, slope=0.0),
                "rotation_bound": Term(typical=1.04, slope=-1.53),
                "travel_bound": Term(typical=2.68, slope=-0.819),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
