"""trajectory.tum: the cameras as the TUM RGB-D benchmark's tools read them (Sturm et al. 2012).

A line a camera: `time x y z qx qy qz qw`, from the camera to the world. The time is that of capture, in seconds, where
all cameras have one by the same clock; else it is the frame's id. The file's first line says which, and why.
"""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.capture.frame import Stamp
from splatnode.recon.result.export.limits import format_number_row, format_text_file
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.placement import quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import RELATIVE, Scale

DEFAULT_NAME = "trajectory.tum"
GAUSSIANS = False  # cameras alone


def export(result: StoredResult) -> bytes:
    return encode_tum(result.cameras(), result.scale())


def encode_tum(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """The file's bytes, in the order of time, and of the frames' ids where the time is the same."""
    ordered = sorted(cameras, key=lambda camera: camera.frame_id)
    stamps = [camera.captured_at for camera in ordered if camera.captured_at is not None]
    why_not = _explain_unusable_stamps(stamps, len(ordered))
    if why_not:
        head, rows = f"frame id; {why_not}", [(str(camera.frame_id), camera) for camera in ordered]
    else:
        head = f"seconds {stamps[0].clock.meaning}"
        by_time = sorted(zip(stamps, ordered, strict=True), key=lambda row: row[0].ns)
        rows = [(stamp.seconds, camera) for stamp, camera in by_time]
    lines = [f"{time} {format_number_row(_compute_motion(camera))}" for time, camera in rows]
    return format_text_file(f"time ({head}), x y z, qx qy qz qw of T_world_camera", lines, scale)


def _explain_unusable_stamps(stamps: Sequence[Stamp], wanted: int) -> str:
    """Why these stamps of `wanted` photographs are no times of one trajectory; empty where they are."""
    if not stamps or len(stamps) < wanted:
        return f"photographs without a time stamp: {wanted - len(stamps)} of {wanted}"
    clocks = sorted({stamp.clock.value for stamp in stamps})
    return f"the time stamps are of different clocks: {', '.join(clocks)}" if len(clocks) > 1 else ""


def _compute_motion(camera: CameraEstimate) -> list[float]:
    w, x, y, z = quats_from_matrices(camera.T_world_camera[:3, :3])
    return [*camera.T_world_camera[:3, 3], x, y, z, w]
