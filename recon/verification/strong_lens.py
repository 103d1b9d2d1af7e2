"""The check of lenses that bend lines by more than two radial coefficients can tell, as a fisheye's do.

Beyond, the coefficients fit the middle of the picture and not its corners, and may fold the picture over.
"""

from __future__ import annotations

import numpy as np

from splatnode.recon.geometry import distortion
from splatnode.recon.registration.register import RegisteredCamera
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.checks import VerificationCase
from splatnode.recon.verification.refusals import Refusal, refuse

STRONG = 0.25  # by which a corner moves at most, of its distance from the middle: of 25 % it is 9 pixels of 1024 off
_RADII = 100  # at which the lens is looked at

BENDS_STRONGLY = Refusal(
    Code.FOCAL_SUSPECT,
    "The lens bends lines strongly: it moves the corners of the picture by more than {moved:.0f} % of their distance "
    "from the middle, and what it does there cannot be told from the photographs.",
    "Calibrate the camera (splatnode calibrate) and give its lens by --intrinsics.",
)


def check_strong_distortion(case: VerificationCase) -> Verdict | None:
    """An estimated lens moves the corners of its pictures too far, or folds them over."""
    for camera in case.registration.cameras:
        frame = case.graph.keyframes[camera.index].frame
        if not _is_well_modelled(camera, frame.width, frame.height):
            return refuse(BENDS_STRONGLY, case.names, moved=100 * STRONG)
    return None


def _is_well_modelled(camera: RegisteredCamera, width: int, height: int) -> bool:
    """Whether the lens shows each pixel as far as its farthest corner one ray, and that corner's within STRONG."""
    if not camera.radial.any():
        return True
    across, down = camera.principal
    corner = float(np.hypot(max(across, width - across), max(down, height - down)) / camera.focal)
    radii = np.linspace(0.0, 1.0 + STRONG, _RADII) * corner
    seen = radii * distortion(radii**2, camera.radial)
    nearer = (1.0 - STRONG) * corner
    least = nearer * float(distortion(np.square(nearer), camera.radial))
    return bool((np.diff(seen) > 0).all() and least <= corner <= seen[-1])
