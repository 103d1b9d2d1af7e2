"""The lens models that can be calibrated, those with fewer terms first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Intrinsics

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A lens as a vector of numbers: fx fy cx cy, then the first `num_terms` coefficients of its kind."""

    name: str
    kind: str  # Intrinsics.model
    num_terms: int
    told: str

    @property
    def num_numbers(self) -> int:
        return 4 + self.num_terms

    def lens(self, numbers: Array, width: int, height: int) -> Intrinsics:
        """`numbers` (P,) as a lens. Raises ValueError where they are none."""
        terms = tuple(float(term) for term in numbers[4:])
        if self.kind == "opencv" and 0 < len(terms) < 4:
            terms = (*terms, *[0.0] * (4 - len(terms)))  # p1 p2, without which k1 k2 cannot be told
        fx, fy, cx, cy = map(float, numbers[:4])
        return Intrinsics(width, height, fx, fy, cx, cy, "calibration", terms, self.kind)


MODELS = {
    model.name: model
    for model in (
        Model("pinhole", "opencv", 0, "a pinhole"),
        Model("opencv2", "opencv", 2, "OpenCV's radial terms k1 k2"),
        Model("opencv4", "opencv", 4, "OpenCV's k1 k2 p1 p2"),
        Model("fisheye", "fisheye", 4, "an equidistant fisheye, k1 k2 k3 k4"),
        Model("opencv5", "opencv", 5, "OpenCV's k1 k2 p1 p2 k3"),
        Model("opencv8", "opencv", 8, "OpenCV's k1 k2 p1 p2 k3 k4 k5 k6"),
    )
}
