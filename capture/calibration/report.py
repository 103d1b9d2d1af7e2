"""What was found: lines for whoever calibrates, and the file that the other verbs read."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from splatnode.capture.calibration.board import Board
from splatnode.capture.calibration.coverage import CORNERS, Coverage
from splatnode.capture.calibration.estimate import Estimate
from splatnode.capture.calibration.hold_out import Choice
from splatnode.capture.calibration.uncertainty import pixel_sigmas

_HEAD = """\
# A lens, as splatnode calibrate found it. The verbs read `intrinsics`: splatnode replay photos --intrinsics FILE, and
# splatnode capture camera.yaml --intrinsics FILE. `calibration` is for people: how well it is known.
"""
_SQUARE = 0.002  # fx and fy of nearly all cameras differ by less
_SURE = 3.0  # standard deviations


def lens_file(choice: Choice, coverage: Coverage, board: Board) -> str:
    """The YAML, which `capture.lens_file` reads."""
    estimate = choice.taken.estimate
    lens, sigmas = estimate.lens, np.sqrt(np.diag(estimate.covariance))
    corners = pixel_sigmas(estimate, coverage.outermost)
    intrinsics = {
        "width": lens.width,
        "height": lens.height,
        **{name: round(getattr(lens, name), 4) for name in ("fx", "fy", "cx", "cy")},
        "model": lens.model,
        "distortion": [float(f"{term:.8g}") for term in lens.distortion],
        "source": lens.source,
    }
    calibration: dict[str, Any] = {
        "model": estimate.model.name,
        "board": {
            "columns": board.columns,
            "rows": board.rows,
            "square_mm": board.square_mm,
            "marker_mm": board.marker_mm,
            "dictionary": board.dictionary,
        },
        "views": len(estimate.names),
        "corners": len(estimate.corners.view),
        "corners_left_out": estimate.left_out,
        "residual_px": round(estimate.rms_px, 4),
        "held_out_px": {trial.estimate.model.name: _round_digits(trial.validation_rms_px) for trial in choice.trials},
        "sigma": {
            **{name: _round_digits(sigma) for name, sigma in zip(("fx", "fy", "cx", "cy"), sigmas[:4], strict=True)},
            "distortion": [_round_digits(sigma) for sigma in sigmas[4:]],
        },
        "corner_sigma_px": {name: _round_digits(sigma) for name, sigma in zip(CORNERS, corners, strict=True)},
        "tilt_deg": [round(float(end), 1) for end in (estimate.tilts_deg.min(), estimate.tilts_deg.max())],
        "distance_mm": [round(float(end)) for end in (estimate.distances_mm.min(), estimate.distances_mm.max())],
        "covered_percent": round(100 * coverage.share),
    }
    told = {"intrinsics": intrinsics, "calibration": calibration}
    grid = [f'  - "{line}"' for line in coverage.text_rows]
    return "\n".join(
        [
            _HEAD + yaml.safe_dump(told, sort_keys=False, default_flow_style=None, width=110).rstrip(),
            "  covered: # the picture: # where the board was seen, . where not, blank where there is no picture",
            *grid,
            "",
        ]
    )


def describe_choice(choice: Choice, coverage: Coverage) -> list[str]:
    """The lines for whoever calibrates."""
    estimate = choice.taken.estimate
    lens, sigmas = estimate.lens, np.sqrt(np.diag(estimate.covariance))
    numbers = ", ".join(
        f"{name} {value:.2f} ± {sigma:.2f}"
        for name, value, sigma in zip(
            ("fx", "fy", "cx", "cy"), (lens.fx, lens.fy, lens.cx, lens.cy), sigmas, strict=False
        )
    )
    tilts, distances = estimate.tilts_deg, estimate.distances_mm
    worst = float(np.max(pixel_sigmas(estimate, coverage.outermost)))
    trials = ", ".join(f"{trial.estimate.model.name} {trial.validation_rms_px:.3f}" for trial in choice.trials)
    lines = [
        f"{estimate.model.name} ({estimate.model.told}) from {len(estimate.names)} views: {numbers} pixels",
        f"corners are {estimate.rms_px:.3f} pixels (rms) from where this lens shows them; in views that were held out: "
        f"{trials}",
        f"the picture's corners are known to {worst:.2f} pixels (standard deviation), the focal length to "
        f"{100 * estimate.focal_sigma:.3f} %",
        f"the board was seen in {coverage.share:.0%} of the picture, tilted by {tilts.min():.0f} to {tilts.max():.0f} "
        f"degrees, {distances.min():.0f} to {distances.max():.0f} mm away",
    ]
    return [*lines, *_warnings(estimate)]


def _warnings(estimate: Estimate) -> list[str]:
    lens = estimate.lens
    by_focal = np.array([1 / lens.fx, -1 / lens.fy])
    sigma = float(np.sqrt(by_focal @ estimate.covariance[:2, :2] @ by_focal))  # of fx / fy, relative
    apart = abs(lens.fx / lens.fy - 1)
    if apart > max(_SQUARE, _SURE * sigma):
        return [
            f"fx and fy differ by {100 * apart:.1f} %, and in nearly all cameras they do not: was the board printed as "
            "wide as high? Measure ten squares across and down"
        ]
    return []


def _round_digits(value: float) -> float:
    """Three digits are enough of what says how well something is known."""
    return float(f"{value:.3g}")
