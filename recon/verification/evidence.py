"""Evidence: numbers that speak for or against a registration, each from a source of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatnode.recon.verification.cycles import Cycles
from splatnode.recon.verification.epipolar_consistency import Score
from splatnode.recon.verification.jackknife import Spread
from splatnode.recon.verification.lens import Distortion, FreedLens
from splatnode.recon.verification.reflection import Reflection
from splatnode.recon.verification.weakest_link import WeakestLink


@dataclass(frozen=True)
class CameraEvidence:
    """What speaks for the pose of one camera."""

    name: str
    inlier_ratio: float  # of its matches, in all verified pairs: those that the poses explain
    confirmed: int  # points of it that at least two other cameras see
    gain: float  # of its exposure, over that of most cameras
    patches: Score  # of it in the pictures that share most points with it
    rotation_sigma_deg: float  # after the bundle adjustment
    centre_sigma_rel: float  # relative to the spread of the centres


@dataclass(frozen=True)
class Evidence:
    """Of a registration with at least three cameras."""

    cameras: tuple[CameraEvidence, ...]
    inlier_ratio: float  # of all matches of verified pairs: those that the poses explain
    weakest_link: WeakestLink
    disconnected: tuple[str, ...]  # frames outside the largest component of geometrically consistent pairs
    reflection: Reflection  # the frames that stand out most as mirror images
    flatness: float  # share of the points on one plane
    spread: Spread  # how much the answer changes without parts of the pictures
    mirrored_cost: float  # of the mirrored answer over that of this one
    cycles: Cycles
    median_angle_deg: float
    rms_px: float
    focal_sigma: float  # of the logarithm of the least certain focal length
    freed: tuple[FreedLens, ...]  # lenses that came with the frames
    distortion: Distortion

    @property
    def rotation_deg(self) -> float:
        """How wrong rotations may be: by the covariance, or by half of what leaving out regions changes."""
        return float(np.max([0.5 * self.spread.rotation_deg, *(camera.rotation_sigma_deg for camera in self.cameras)]))

    @property
    def centre_rel(self) -> float:
        """The same for the centres, relative to their spread; both together, for each misses what the other sees."""
        return float(
            np.hypot(0.5 * self.spread.centre_rel, np.max([camera.centre_sigma_rel for camera in self.cameras]))
        )
