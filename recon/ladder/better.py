"""Which of two estimates of the same keyframes is better: an accepted answer is extended, never replaced."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.estimation import Reconstruction
from splatnode.recon.geometry import align_cameras, angles_deg
from splatnode.recon.result.verdict import Code

MAX_TURN_DEG = 2.0  # of an accepted camera from one estimate to the other, after the best similarity


def choose_better_reconstruction(one: Reconstruction, other: Reconstruction) -> Reconstruction:
    """`other` where it is publishable and has the cameras of `one`, where they were, and more; else `one`.

    A rough answer that weak matches lead to is not taken: they may join two places, and rough bounds would hide it.
    Of two refusals `one` stands: it says what is wrong with the photographs, `other` with what was made of them.
    """
    if (
        not other.publishable
        or other.verdict.code is Code.OK_ROUGH
        or not one.publishable_camera_names < other.publishable_camera_names
    ):
        return one
    return other if _compute_turn_deg(one, other) <= MAX_TURN_DEG else one


def _compute_turn_deg(one: Reconstruction, other: Reconstruction) -> float:
    """The largest angle between the cameras that `one` has placed and the same ones in `other`; 0 without any."""
    if not one.publishable_camera_names:
        return 0.0
    source, target = _collect_poses(one), _collect_poses(other)
    Ts, others = (
        np.stack([cameras[name] for name in sorted(one.publishable_camera_names)]) for cameras in (source, target)
    )
    return float(angles_deg(align_cameras(Ts, others).rotation @ Ts[:, :3, :3], others[:, :3, :3]).max())


def _collect_poses(estimate: Reconstruction) -> dict[str, npt.NDArray[np.float64]]:
    """T_world_camera by the keyframe's name."""
    if estimate.registration is None:
        return {}
    return {estimate.graph.names[camera.index]: camera.T_world_camera for camera in estimate.registration.cameras}
