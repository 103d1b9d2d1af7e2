"""cameras.json: our own file of cameras, which every result has and from which other formats are made.

The cameras are for the images at modelled size, with the centre of the top-left pixel at (0.5, 0.5). The file says
whether the world's unit is the metre.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np

from splatnode.recon.result.bounds import Bounds, as_axes
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.scale import RELATIVE, Scale
from splatnode.recon.result.snapshot import CameraEstimate

BOUNDS_MEANING = (
    "hold for 95 % of all cameras: rotation_deg after the best common rotation, centre (in the file's unit) and "
    "centre_percent (of the distance to the scene) after the best similarity, focal_percent of the focal length; axes "
    "are the semi-axes of the ellipsoid around the centre, in the file's unit and world"
)


def camera_record(camera: CameraEstimate) -> dict[str, object]:
    """A camera as cameras.json and report.json hold it."""
    return {
        "name": camera.name,
        "frame_id": camera.frame_id,
        "T_world_camera": camera.T_world_camera.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
        "bounds": None if camera.bounds is None else asdict(camera.bounds),
    }


def encode_cameras(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """cameras.json."""
    return json_bytes(
        {
            **scale.record(),
            "axes": "OpenCV: x right, y down, z forward",
            "T_world_camera": "p_world = T_world_camera @ p_camera",
            "bounds": BOUNDS_MEANING,
            "pixel_origin": "the centre of the top-left pixel is (0.5, 0.5)",
            "cameras": [camera_record(camera) for camera in cameras],
        }
    )


def decode_cameras(data: bytes, name: str = "cameras.json") -> tuple[CameraEstimate, ...]:
    """Reads cameras.json. Raises SceneFileError, which names the file as `name`, where it is something else."""
    try:
        return tuple(_camera_from_record(record) for record in json.loads(data)["cameras"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneFileError(f"{name} is not a cameras.json of splatnode, or is damaged: {error!r}") from error


def decode_scale(data: bytes) -> Scale:
    """The scale that a cameras.json of ours states."""
    record = json.loads(data)
    return Scale(record.get("scale") == "metric", record.get("scale_source"))


def _camera_from_record(record: Mapping) -> CameraEstimate:
    T_world_camera = np.array(record["T_world_camera"], np.float64)
    K = np.array(record["K"], np.float64)
    if T_world_camera.shape != (4, 4) or K.shape != (3, 3):
        raise ValueError(f"T_world_camera must be 4x4 and K 3x3, got {T_world_camera.shape} and {K.shape}")
    if not np.isfinite(T_world_camera).all() or not np.isfinite(K).all():
        raise ValueError("T_world_camera and K must be finite")
    return CameraEstimate(
        name=str(record["name"]),
        frame_id=int(record["frame_id"]),
        T_world_camera=T_world_camera,
        K=K,
        width=int(record["width"]),
        height=int(record["height"]),
        bounds=_bounds_from_record(record["bounds"]) if record.get("bounds") else None,
    )


def _bounds_from_record(record: Mapping) -> Bounds:
    numbers = {name: float(value) for name, value in record.items() if name != "axes"}
    axes = np.array(record["axes"], np.float64)
    if axes.shape != (3, 3) or not np.isfinite([*numbers.values(), *axes.ravel()]).all():
        raise ValueError("the bounds of a camera must be finite, and their axes 3x3")
    return Bounds(**numbers, axes=as_axes(axes))
