"""trajectory.tum: the cameras as the TUM RGB-D benchmark's tools read them (Sturm et al. 2012).

A line a camera: `time x y z qx qy qz qw`, from the camera to the world. The time is the frame's id.
"""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.recon.result.export.quaternions import quats_from_matrices
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.export.text import number_row, text_file
from splatnode.recon.result.scale import RELATIVE, Scale
from splatnode.recon.result.snapshot import CameraEstimate

DEFAULT_NAME = "trajectory.tum"


def export(result: StoredResult) -> bytes:
    return encode_tum(result.cameras(), result.scale())


def encode_tum(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """The file's bytes, in the order of the frames' ids."""
    lines = []
    for camera in sorted(cameras, key=lambda camera: camera.frame_id):
        w, x, y, z = quats_from_matrices(camera.T_world_camera[:3, :3])
        lines.append(f"{camera.frame_id} {number_row([*camera.T_world_camera[:3, 3], x, y, z, w])}")
    return text_file("time (frame id), x y z, qx qy qz qw of T_world_camera", lines, scale)
