"""Cameras as files: cameras.json (ours), COLMAP's model, nerfstudio's transforms.json, a TUM trajectory.

All are for the images at modelled size, with the centre of the top-left pixel at (0.5, 0.5) (COLMAP's and nerfstudio's
convention too). Every file says whether the world's unit is the metre.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from struct import pack

import numpy as np

from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.prepare import base_rgb
from splatnode.recon.result.export.quaternions import quats_from_matrices
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.scale import RELATIVE, Scale
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

_PINHOLE = 1  # COLMAP's number for the model
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes right, up, back


def camera_record(camera: CameraEstimate) -> dict[str, object]:
    """A camera as cameras.json and report.json hold it."""
    return {
        "name": camera.name,
        "frame_id": camera.frame_id,
        "T_world_camera": camera.T_world_camera.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
        "uncertainty": {"rotation_deg": camera.rotation_sigma_deg, "centre_rel": camera.centre_sigma_rel},
    }


def encode_cameras(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """cameras.json."""
    return json_bytes(
        {
            **scale.record(),
            "axes": "OpenCV: x right, y down, z forward",
            "T_world_camera": "p_world = T_world_camera @ p_camera",
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
    uncertainty = record.get("uncertainty") or {}
    return CameraEstimate(
        name=str(record["name"]),
        frame_id=int(record["frame_id"]),
        T_world_camera=T_world_camera,
        K=K,
        width=int(record["width"]),
        height=int(record["height"]),
        rotation_sigma_deg=uncertainty.get("rotation_deg"),
        centre_sigma_rel=uncertainty.get("centre_rel"),
    )


def encode_colmap(
    cameras: Sequence[CameraEstimate], gaussians: GaussianArrays, scale: Scale = RELATIVE
) -> dict[str, bytes]:
    """COLMAP's model: cameras, images and points3D (the Gaussians' centres, without tracks).

    As text; in binary where a name has a space, at which COLMAP, and all who read its text, would end the name.
    Images with the same calibration share a camera; the number of an image is its place in `cameras`, from 1.
    """
    calibrations = [(c.width, c.height, c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) for c in cameras]
    camera_ids = {calibration: i + 1 for i, calibration in enumerate(dict.fromkeys(calibrations))}
    images = []
    for number, (camera, calibration) in enumerate(zip(cameras, calibrations, strict=True), 1):
        T_camera_world = np.linalg.inv(camera.T_world_camera)
        motion = [*quats_from_matrices(T_camera_world[:3, :3]), *T_camera_world[:3, 3]]
        images.append((number, motion, camera_ids[calibration], camera.name))
    colours = base_rgb(gaussians)
    points = [
        (i, *mean, *colour)
        for i, (mean, colour) in enumerate(zip(gaussians.means.tolist(), colours.tolist(), strict=True), 1)
    ]
    if any(character.isspace() for camera in cameras for character in camera.name):
        return {
            "cameras.bin": _records([pack("<IiQQ4d", i, _PINHOLE, *lens) for lens, i in camera_ids.items()]),
            "images.bin": _records(
                [pack("<I7dI", i, *motion, of) + name.encode() + bytes(1 + 8) for i, motion, of, name in images]
            ),
            "points3D.bin": _records([pack("<Q3d3BdQ", *point, 0.0, 0) for point in points]),
        }
    camera_lines = [f"{i} PINHOLE {_row(calibration)}" for calibration, i in camera_ids.items()]
    image_lines = [line for i, motion, of, name in images for line in (f"{i} {_row(motion)} {of} {name}", "")]
    point_lines = [f"{i} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} 0" for i, x, y, z, r, g, b in points]
    return {
        "cameras.txt": _text(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"], camera_lines, scale),
        "images.txt": _text(["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"], image_lines, scale),
        "points3D.txt": _text(["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"], point_lines, scale),
    }


def _records(records: Sequence[bytes]) -> bytes:
    """As COLMAP's binary files hold them: their number first."""
    return pack("<Q", len(records)) + b"".join(records)


def encode_nerfstudio(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """transforms.json for nerfstudio and instant-ngp: OpenGL camera axes, images expected in images/."""
    frames = [
        {
            "file_path": f"images/{camera.name}",
            "fl_x": camera.K[0, 0],
            "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
            "w": camera.width,
            "h": camera.height,
            "transform_matrix": (camera.T_world_camera @ _OPENGL).tolist(),
        }
        for camera in cameras
    ]
    return json_bytes({"camera_model": "OPENCV", **scale.record(), "frames": frames})


def encode_tum(cameras: Sequence[CameraEstimate], scale: Scale = RELATIVE) -> bytes:
    """trajectory.tum: `time x y z qx qy qz qw` a line, camera to world; the time is the frame's id."""
    lines = []
    for camera in sorted(cameras, key=lambda camera: camera.frame_id):
        w, x, y, z = quats_from_matrices(camera.T_world_camera[:3, :3])
        lines.append(f"{camera.frame_id} {_row([*camera.T_world_camera[:3, 3], x, y, z, w])}")
    return _text(["# time (frame id), x y z, qx qy qz qw of T_world_camera"], lines, scale)


def _row(values: Sequence[float]) -> str:
    return " ".join(str(int(value)) if float(value).is_integer() else repr(float(value)) for value in values)


def _text(head: Sequence[str], lines: Sequence[str], scale: Scale) -> bytes:
    return ("\n".join([*head, f"# scale: {scale.sentence}", *lines]) + "\n").encode()
