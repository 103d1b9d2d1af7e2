"""COLMAP's sparse model: cameras, images, and the Gaussians' centres as points without tracks.

The images are those at modelled size; the centre of the top-left pixel is at (0.5, 0.5), as in COLMAP.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import pack

import numpy as np

from splatnode.recon.result.export.prepare import compute_base_rgb, format_number_row, format_text_file
from splatnode.recon.result.export.quaternions import quats_from_matrices
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.verdict import RELATIVE, Scale

DEFAULT_NAME = "colmap"

_PINHOLE = 1  # COLMAP's number for the camera model
_END_OF_NAME = bytes(1)
_NO_POINTS2D = bytes(8)  # their number, as 64 bits
_NO_ERROR, _NO_TRACK = 0.0, 0


@dataclass(frozen=True)
class _Image:
    image_id: int  # its place among the cameras, from 1
    motion: tuple[float, ...]  # quaternion wxyz and translation of T_camera_world
    camera_id: int
    name: str


def export(result: StoredResult) -> dict[str, bytes]:
    return encode_colmap(result.cameras(), result.gaussians(), result.scale())


def encode_colmap(
    cameras: Sequence[CameraEstimate], gaussians: GaussianArrays, scale: Scale = RELATIVE
) -> dict[str, bytes]:
    """The model's three files by name: as text, or in binary where a name has a space.

    At a space COLMAP, and all who read its text, would end the name. Images with the same calibration share a camera.
    """
    calibrations = [(c.width, c.height, c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) for c in cameras]
    camera_ids = {calibration: i + 1 for i, calibration in enumerate(dict.fromkeys(calibrations))}
    images = [
        _Image(number, _compute_motion(camera), camera_ids[calibration], camera.name)
        for number, (camera, calibration) in enumerate(zip(cameras, calibrations, strict=True), 1)
    ]
    colours = compute_base_rgb(gaussians)
    points = [
        (i, *mean, *colour)
        for i, (mean, colour) in enumerate(zip(gaussians.means.tolist(), colours.tolist(), strict=True), 1)
    ]
    if any(character.isspace() for camera in cameras for character in camera.name):
        return _encode_binary(camera_ids, images, points)
    return _encode_text(camera_ids, images, points, scale)


def _compute_motion(camera: CameraEstimate) -> tuple[float, ...]:
    T_camera_world = np.linalg.inv(camera.T_world_camera)
    return (*quats_from_matrices(T_camera_world[:3, :3]), *T_camera_world[:3, 3])


def _encode_text(
    camera_ids: dict[tuple, int], images: Sequence[_Image], points: Sequence[tuple], scale: Scale
) -> dict[str, bytes]:
    camera_lines = [f"{i} PINHOLE {format_number_row(calibration)}" for calibration, i in camera_ids.items()]
    image_lines = [
        line
        for image in images
        for line in (f"{image.image_id} {format_number_row(image.motion)} {image.camera_id} {image.name}", "")
    ]
    point_lines = [f"{i} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0" for i, x, y, z, r, g, b in points]
    return {
        "cameras.txt": format_text_file("CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", camera_lines, scale),
        "images.txt": format_text_file("IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", image_lines, scale),
        "points3D.txt": format_text_file("POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", point_lines, scale),
    }


def _encode_binary(camera_ids: dict[tuple, int], images: Sequence[_Image], points: Sequence[tuple]) -> dict[str, bytes]:
    return {
        "cameras.bin": _pack_records([pack("<IiQQ4d", i, _PINHOLE, *lens) for lens, i in camera_ids.items()]),
        "images.bin": _pack_records(
            [
                pack("<I7dI", image.image_id, *image.motion, image.camera_id)
                + image.name.encode()
                + _END_OF_NAME
                + _NO_POINTS2D
                for image in images
            ]
        ),
        "points3D.bin": _pack_records([pack("<Q3d3BdQ", *point, _NO_ERROR, _NO_TRACK) for point in points]),
    }


def _pack_records(records: Sequence[bytes]) -> bytes:
    """As COLMAP's binary files hold them: their number first."""
    return pack("<Q", len(records)) + b"".join(records)
