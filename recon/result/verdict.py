"""Verdicts: a set of frames that cannot be reconstructed is a result with a code, one sentence, and what to do."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Code(enum.Enum):
    """The codes of a verdict. `recon/verification/refusals.py` has the sentences and the advice."""

    OK = "OK"
    OK_PARTIAL = "OK_PARTIAL"
    OK_ROUGH = "OK_ROUGH"
    TOO_ROUGH = "TOO_ROUGH"
    TOO_FEW_VIEWS = "TOO_FEW_VIEWS"
    NO_OVERLAP = "NO_OVERLAP"
    LOW_TEXTURE = "LOW_TEXTURE"
    NO_PARALLAX = "NO_PARALLAX"
    PLANAR_ONLY = "PLANAR_ONLY"
    BASELINE_TOO_SMALL = "BASELINE_TOO_SMALL"
    OUTLIER_VIEW = "OUTLIER_VIEW"
    AMBIGUOUS = "AMBIGUOUS"
    BLUR = "BLUR"
    EXPOSURE_SHIFT = "EXPOSURE_SHIFT"
    MOVING_SCENE = "MOVING_SCENE"
    STATIC_CAMERA = "STATIC_CAMERA"
    FOCAL_SUSPECT = "FOCAL_SUSPECT"
    MIXED_CAMERAS = "MIXED_CAMERAS"
    STEREO_IMAGES = "STEREO_IMAGES"
    PANORAMA = "PANORAMA"
    TURNTABLE = "TURNTABLE"
    SPLIT = "SPLIT"
    OVERFIT = "OVERFIT"
    DIVERGED = "DIVERGED"
    UNDETERMINED = "UNDETERMINED"
    BUDGET_HIT = "BUDGET_HIT"


SURE = (Code.OK, Code.OK_PARTIAL)  # the scene is known well enough to measure in it, and to map what is free


@dataclass(frozen=True)
class Verdict:
    """The verdict on a set of images, whether there is a scene of them or not."""

    code: Code  # OK, OK_PARTIAL or OK_ROUGH, or why there is no scene: docs/verdicts.md explains each
    message: str  # one sentence
    advice: str  # what to do about it; empty when there is nothing to do
    frames: tuple[str, ...] = ()  # the names that the code is about
    publishable: bool = False  # whether a scene may be shown as a result
    provisional: bool = False  # whether evidence is still to be looked at that may change it
