"""What splatnode registered, published or not: whether a refusal was of right cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.registration.register import register
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.verification.verify import verify


def ensure_registration(estimate: Reconstruction, config: ReconstructionConfig) -> Reconstruction:
    """The estimate with the cameras and the evidence of a registration, also where the verdict needed none."""
    if estimate.registration is not None:
        return estimate
    registration = register(estimate.graph.keyframes, estimate.graph.pairs, config.registration)
    return replace(
        estimate, registration=registration, evidence=verify(estimate.graph, registration, config.verification)
    )


def list_registered_cameras(estimate: Reconstruction) -> tuple[CameraEstimate, ...]:
    """The registered cameras, for their frames at full size; those that were placed, where a scene may be published."""
    if estimate.registration is None:
        return ()
    bounds, found = estimate.bounds, []
    for camera in estimate.registration.cameras:
        frame = estimate.graph.keyframes[camera.index].frame
        K = np.diag([*camera.focals, 1.0])
        K[:2, 2] = camera.principal
        of_camera = (camera.T_world_camera, K, frame.width, frame.height, bounds.get(frame.name))
        found.append(CameraEstimate(frame.name, frame.frame_id, *of_camera))
    return tuple(
        each for each in found if not estimate.verdict.publishable or each.name in estimate.publishable_camera_names
    )
