"""transforms.json: the cameras for nerfstudio and instant-ngp, with OpenGL camera axes (right, up, back).

The images are those at modelled size, expected in images/; the centre of the top-left pixel is at (0.5, 0.5). What
splatnode alone says of the lengths lies apart, for instant-ngp takes `scale` beside `frames` for a number of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.export.stored import (
    BOUNDS_MEANING,
    FRAME_SET_MEANING,
    GIVEN_MEANING,
    STAMP_MEANING,
    StoredResult,
    make_given_dict,
    make_stamp_dict,
)
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.result.verdict import RELATIVE, Scale

DEFAULT_NAME = "transforms.json"
GAUSSIANS = False  # cameras alone

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes right, down, ahead from right, up, back


def export(result: StoredResult) -> bytes:
    return encode_nerfstudio(result.cameras(), result.scale())


def encode_nerfstudio(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE, points: str | None = None) -> bytes:
    """The bytes of transforms.json; `points` is the file of the points to begin with, beside it, where there is one."""
    frames = [
        {
            "file_path": f"images/{camera.name}",
            "fl_x": camera.K[0, 0],
            "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
            "w": camera.width,
            "h": camera.height,
            "transform_matrix": (camera.T_world_camera @ _OPENCV_FROM_OPENGL).tolist(),
            **make_stamp_dict(camera.captured_at),
            "bounds": None if camera.bounds is None else asdict(camera.bounds),
            "camera_id": camera.camera_id or None,
            "frame_set": camera.frame_set,
            "given": _make_given_dict(camera),
        }
        for camera in cameras
    ]
    meaning = {"stamp_ns": STAMP_MEANING, "bounds": BOUNDS_MEANING, "frame_set": FRAME_SET_MEANING}
    meaning |= {"given": GIVEN_MEANING} | ({} if points is None else {"ply_file_path": points})
    return json_bytes({"camera_model": "OPENCV", **meaning, "splatnode": scale.record(), "frames": frames})


def _make_given_dict(camera: CameraEstimate) -> dict[str, object] | None:
    """The pose that was given for a camera, with this file's axes."""
    fields = make_given_dict(camera)
    if fields is None or camera.given is None:
        return None
    fields.pop("T_world_camera")
    return {"transform_matrix": (camera.given.T_world_camera @ _OPENCV_FROM_OPENGL).tolist(), **fields}
