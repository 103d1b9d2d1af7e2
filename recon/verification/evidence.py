"""Evidence: numbers that speak for or against a registration, each from a source of its own."""

from __future__ import annotations

from dataclasses import dataclass

from splatnode.recon.verification.cycles import CycleConsistency
from splatnode.recon.verification.errors import Errors, PoseErrors
from splatnode.recon.verification.lens import Distortion, FreedLens
from splatnode.recon.verification.reflection import Reflection
from splatnode.recon.verification.weakest_link import WeakestLink


@dataclass(frozen=True)
class CameraEvidence:
    """The evidence for the pose of one camera."""

    name: str
    inlier_ratio: float  # of its matches, in all verified pairs: those that the poses explain
    confirmed: int  # points of it that at least two other cameras see
    coverage: float  # share of its picture that its points fill: of a box around nearly all of them
    flat_share: float  # of the matches of its flattest pair: those that one homography explains
    gain: float  # of its exposure, over that of most cameras
    errors: PoseErrors
    focal: Errors  # of the logarithm of its focal length
    own_lens: bool  # its lens is not what it was taken for: it refutes the one that it shares, or that was given
    # Its focal length over the one that a calibration gives, where it refutes that; 1: it does not; 0: there is none
    refuted_focal: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """The evidence for or against a registration."""

    cameras: tuple[CameraEvidence, ...]
    inlier_ratio: float  # of all matches of verified pairs: those that the poses explain
    weakest_link: WeakestLink
    disconnected: tuple[str, ...]  # frames outside the largest component of geometrically consistent pairs
    reflection: Reflection  # the frames that stand out most as mirror images
    flatness: float  # share of the points on one plane
    mirrored_cost: float  # of the mirrored answer over that of this one
    cycles: CycleConsistency
    median_angle_deg: float
    rms_px: float
    focal: Errors  # of the logarithm of the least certain focal length
    travel: float  # RMS distance of the centres from their mean; the distance to the scene is 1
    freed: tuple[FreedLens, ...]  # lenses that came with the frames
    distortion: Distortion
