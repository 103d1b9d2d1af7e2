"""What is claimed of verified cameras: 95 % bounds of their errors."""

from __future__ import annotations

import numpy as np

from splatnode.recon.registration.register import Registration
from splatnode.recon.result.bounds import Bounds, axes_of
from splatnode.recon.verification.evidence import Evidence

WIDENED = 2.0  # standard errors


def claims(registration: Registration, evidence: Evidence) -> dict[str, Bounds]:
    """The bounds of each camera, by its name. The world's unit is the distance to the scene."""
    centres = np.stack([camera.T_world_camera[:3, 3] for camera in registration.cameras])
    spread = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    found = {}
    for registered, camera in zip(registration.cameras, evidence.cameras, strict=True):
        rotation = float(np.hypot(0.5 * evidence.spread.rotation_deg, camera.rotation_sigma_deg))
        centre = spread * float(np.hypot(0.5 * evidence.spread.centre_rel, camera.centre_sigma_rel))
        found[camera.name] = Bounds(
            rotation_deg=WIDENED * rotation,
            centre=WIDENED * centre,
            centre_percent=100.0 * WIDENED * centre,
            focal_percent=100.0 * WIDENED * float(np.hypot(0.5 * evidence.spread.focal_rel, evidence.focal_sigma)),
            axes=axes_of(registered.centre_covariance, WIDENED * centre),
        )
    return found
