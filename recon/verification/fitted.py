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
                factor=1.53,
                floor=0.1,
                sigma=0.757,
                regions=0.482,
                profile=0.0,
                inlier_ratio=-0.404,
                link=0.0,
                count=0.342,
                own_lens=2.04,
            ),
            centre=BoundModel(
                factor=1.6,
                floor=0.0002,
                sigma=0.387,
                regions=0.637,
                profile=0.0,
                inlier_ratio=-0.742,
                link=-1.06,
                count=0.164,
                own_lens=2.02,
            ),
            focal=BoundModel(
                factor=5.2,
                floor=0.002,
                sigma=0.551,
                regions=0.378,
                profile=0.293,
                inlier_ratio=0.0,
                link=0.0,
                count=0.141,
                own_lens=4.0,
            ),
        ),
        odds=OddsModel(
            prior=4.57,
            terms={
                "inlier_ratio": Term(typical=0.94, slope=2.72),
                "camera_inlier_ratio": Term(typical=0.915, slope=0.0),
                "link_inlier_ratio": Term(typical=0.945, slope=2.62),
                "coverage": Term(typical=-0.99, slope=0.0),
                "flat_patch": Term(typical=0.011, slope=-3.15),
                "reflection": Term(typical=0.103, slope=-7.83),
                "directions": Term(typical=0.36, slope=-0.612),
                "rotation_bound": Term(typical=-0.134, slope=-1.36),
                "travel_bound": Term(typical=1.42, slope=-1.5),
                "own_lens": Term(typical=0.0, slope=-1.67),
            },
        ),
    ),
    pair=VerdictModel(
        claims=ErrorModel(
            rotation=BoundModel(
                factor=2.32,
                floor=0.1,
                sigma=0.746,
                regions=0.226,
                profile=0.0,
                inlier_ratio=-1.64,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
            centre=BoundModel(
                factor=1.08,
                floor=0.0002,
                sigma=0.245,
                regions=0.59,
                profile=0.0,
                inlier_ratio=-1.86,
                link=-1.86,
                count=0.0,
                own_lens=1.0,
            ),
            focal=BoundModel(
                factor=2.63,
                floor=0.002,
                sigma=0.733,
                regions=0.0158,
                profile=0.305,
                inlier_ratio=0.0,
                link=0.0,
                count=0.0,
                own_lens=1.0,
            ),
        ),
        odds=OddsModel(
            prior=1.87,
            terms={
                "inlier_ratio": Term(typical=0.942, slope=0.0),
                "camera_inlier_ratio": Term(typical=0.942, slope=0.0),
                "link_inlier_ratio": Term(typical=0.979, slope=8.38),
                "coverage": Term(typical=-1.16, slope=0.46),
                "flat_patch": Term(typical=0.00244, slope=-7.84),
                "reflection": Term(typical=0.102, slope=0.0),
                "directions": Term(typical=0.245, slope=-0.214),
                "rotation_bound": Term(typical=1.04, slope=-1.32),
                "travel_bound": Term(typical=2.67, slope=-0.64),
                "own_lens": Term(typical=0.0, slope=-0.0),
            },
        ),
    ),
)
