"""COLMAP's sparse model: cameras, images, and the Gaussians' centres as points without tracks.

The images are those at modelled size; the centre of the top-left pixel is at (0.5, 0.5), as in COLMAP. Of several
cameras there are rigs and frames, too, which COLMAP has since 3.12: which cameras keep their relative poses, and what
they took together. A camera whose images do not keep their relative poses, or have several lenses, is a rig of its own:
what COLMAP reads must have the poses that were estimated.
Source of the formats: COLMAP's page on its output; the binary files as pycolmap 4.2 writes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import pack

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import compute_base_rgb, format_number_row, format_text_file
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.placement import quats_from_matrices
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.verdict import RELATIVE, Scale

UNIT = "unit.txt"  # beside binary files, which have no place for it; COLMAP does not look at it
_TURNED, _MOVED = 1e-4, 1e-4  # radians, and parts of the spread of all cameras, by which relative poses may differ

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExportedRig:
    """A rig: T_sensor_rig (4, 4) by COLMAP camera; the first is the reference, whose pose is the rig's."""

    sensors: Mapping[int, Array]


@dataclass(frozen=True, eq=False)
class ExportedFrame:
    """The images that a rig took at one time."""

    rig: int  # its place among the rigs
    T_rig_world: Array  # (4, 4)
    images: Sequence[int]  # the places of its images among the cameras


def find_rigs(
    cameras: Sequence[CameraEstimate], sensor_of: Sequence[int]
) -> tuple[list[ExportedRig], list[ExportedFrame]]:
    """The rigs of images, each of COLMAP's camera `sensor_of`, and their frames; every image is in one frame."""
    by_set = _group_by_set(cameras, sensor_of)
    together = _find_rigid_sensors(cameras, sensor_of, by_set)
    rigs = [ExportedRig(together)] if len(together) > 1 else []
    rigs += [
        ExportedRig({sensor: np.eye(4)})
        for sensor in dict.fromkeys(sensor_of)
        if len(rigs) == 0 or sensor not in together
    ]
    rig_of = {sensor: place for place, rig in enumerate(rigs) for sensor in rig.sensors}
    frames, done = [], set()
    for images in by_set.values():
        kept = [image for image in images if len(together) > 1 and sensor_of[image] in together]
        if len(kept) > 1:
            frames.append(_make_frame(cameras, sensor_of, rigs, rig_of, kept))
            done.update(kept)
    frames += [_make_frame(cameras, sensor_of, rigs, rig_of, [i]) for i in range(len(cameras)) if i not in done]
    return rigs, sorted(frames, key=lambda frame: min(frame.images))


def _group_by_set(cameras: Sequence[CameraEstimate], sensor_of: Sequence[int]) -> dict[int, list[int]]:
    """The images of each frame set, at most one of a sensor."""
    found: dict[int, list[int]] = {}
    for place, camera in enumerate(cameras):
        if camera.frame_set is not None:
            images = found.setdefault(camera.frame_set, [])
            if all(sensor_of[other] != sensor_of[place] for other in images):
                images.append(place)
    return found


def _find_rigid_sensors(
    cameras: Sequence[CameraEstimate], sensor_of: Sequence[int], by_set: Mapping[int, Sequence[int]]
) -> dict[int, Array]:
    """T_sensor_rig of the sensors that keep their poses to the one with most images, which is first."""
    ids: dict[str, set[int]] = {}
    for camera, sensor in zip(cameras, sensor_of, strict=True):
        ids.setdefault(camera.camera_id, set()).add(sensor)
    single = {sensor for camera_id, sensors in ids.items() if camera_id and len(sensors) == 1 for sensor in sensors}
    if not single:
        return {}
    reference = max(sorted(single), key=list(sensor_of).count)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in cameras])
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    found = {reference: np.eye(4)}
    for sensor in sorted(single - {reference}):
        relative = []
        for images in by_set.values():
            of = {sensor_of[image]: cameras[image].T_world_camera for image in images}
            if sensor in of and reference in of:
                relative.append(np.linalg.inv(of[sensor]) @ of[reference])
        if relative and all(_is_same(relative[0], other, spread) for other in relative):
            found[sensor] = relative[0]
    return found


def _is_same(one: Array, other: Array, spread: float) -> bool:
    turned = np.abs(one[:3, :3] - other[:3, :3]).max() <= _TURNED
    return bool(turned and np.abs(one[:3, 3] - other[:3, 3]).max() <= _MOVED * spread)


def _make_frame(
    cameras: Sequence[CameraEstimate],
    sensor_of: Sequence[int],
    rigs: Sequence[ExportedRig],
    rig_of: Mapping[int, int],
    images: Sequence[int],
) -> ExportedFrame:
    rig = rig_of[sensor_of[images[0]]]
    reference = next(iter(rigs[rig].sensors))
    chosen = next((image for image in images if sensor_of[image] == reference), images[0])
    T_sensor_rig = rigs[rig].sensors[sensor_of[chosen]]
    T_rig_world = np.linalg.inv(cameras[chosen].T_world_camera @ T_sensor_rig)
    return ExportedFrame(rig, np.asarray(T_rig_world, np.float64), images)


DEFAULT_NAME = "colmap"

_PINHOLE = 1  # COLMAP's number for the camera model
_CAMERA = 0  # and for a sensor that is a camera
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
    """The model's files by name: as text, or in binary where a name has a space.

    At a space COLMAP, and all who read its text, would end the name. Images with the same calibration share a camera,
    if they are of one camera; of several cameras rigs and frames come with the three files.
    """
    calibrations = [(c.width, c.height, c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) for c in cameras]
    sensors = [(camera.camera_id, *calibration) for camera, calibration in zip(cameras, calibrations, strict=True)]
    numbers = {sensor: i + 1 for i, sensor in enumerate(dict.fromkeys(sensors))}
    camera_ids = {i: sensor[1:] for sensor, i in numbers.items()}
    images = [
        _Image(number, _compute_motion(camera.T_world_camera), numbers[sensor], camera.name)
        for number, (camera, sensor) in enumerate(zip(cameras, sensors, strict=True), 1)
    ]
    rigged = _Rigged(*find_rigs(cameras, [image.camera_id for image in images])) if any(_ids(cameras)) else None
    colours = compute_base_rgb(gaussians)
    points = [
        (i, *mean, *colour)
        for i, (mean, colour) in enumerate(zip(gaussians.means.tolist(), colours.tolist(), strict=True), 1)
    ]
    if any(character.isspace() for camera in cameras for character in camera.name):
        stated = {UNIT: format_text_file("the unit and the frame of the binary files beside this one", [], scale)}
        return _encode_binary(camera_ids, images, points) | (_pack_rigs(rigged, images) if rigged else {}) | stated
    text = _encode_text(camera_ids, images, points, scale)
    return text | (_format_rigs(rigged, images, scale) if rigged else {})


def _ids(cameras: Sequence[CameraEstimate]) -> list[str]:
    return [camera.camera_id for camera in cameras]


def _compute_motion(T_world_camera: npt.NDArray[np.float64]) -> tuple[float, ...]:
    return _format_motion(np.asarray(np.linalg.inv(T_world_camera), np.float64))


def _format_motion(T: npt.NDArray[np.float64]) -> tuple[float, ...]:
    """A rigid motion (4, 4) as quaternion wxyz and translation."""
    return (*quats_from_matrices(T[:3, :3]), *T[:3, 3])


@dataclass(frozen=True)
class _Rigged:
    rigs: Sequence[ExportedRig]
    frames: Sequence[ExportedFrame]


def _format_rigs(rigged: _Rigged, images: Sequence[_Image], scale: Scale) -> dict[str, bytes]:
    rig_lines = []
    for number, rig in enumerate(rigged.rigs, 1):
        (reference, _), *others = rig.sensors.items()
        rest = (f" CAMERA {sensor} 1 {format_number_row(_format_motion(T))}" for sensor, T in others)
        rig_lines.append(f"{number} {len(rig.sensors)} CAMERA {reference}{''.join(rest)}")
    frame_lines = []
    for number, frame in enumerate(rigged.frames, 1):
        data = "".join(f" CAMERA {images[i].camera_id} {images[i].image_id}" for i in frame.images)
        motion = format_number_row(_format_motion(frame.T_rig_world))
        frame_lines.append(f"{number} {frame.rig + 1} {motion} {len(frame.images)}{data}")
    rig_columns = (
        "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, "
    )
    frame_columns = "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, DATA_IDS[] as "
    return {
        "rigs.txt": format_text_file(f"{rig_columns}[QW, QX, QY, QZ, TX, TY, TZ])", rig_lines, scale),
        "frames.txt": format_text_file(f"{frame_columns}(SENSOR_TYPE, SENSOR_ID, DATA_ID)", frame_lines, scale),
    }


def _pack_rigs(rigged: _Rigged, images: Sequence[_Image]) -> dict[str, bytes]:
    rigs, frames = [], []
    for number, rig in enumerate(rigged.rigs, 1):
        (reference, _), *others = rig.sensors.items()
        packed = pack("<IIiI", number, len(rig.sensors), _CAMERA, reference)
        rigs.append(
            packed + b"".join(pack("<iI?7d", _CAMERA, sensor, True, *_format_motion(T)) for sensor, T in others)
        )
    for number, frame in enumerate(rigged.frames, 1):
        packed = pack("<II7dI", number, frame.rig + 1, *_format_motion(frame.T_rig_world), len(frame.images))
        data = (pack("<iIQ", _CAMERA, images[i].camera_id, images[i].image_id) for i in frame.images)
        frames.append(packed + b"".join(data))
    return {"rigs.bin": _pack_records(rigs), "frames.bin": _pack_records(frames)}


def _encode_text(
    camera_ids: dict[int, tuple], images: Sequence[_Image], points: Sequence[tuple], scale: Scale
) -> dict[str, bytes]:
    camera_lines = [f"{i} PINHOLE {format_number_row(calibration)}" for i, calibration in camera_ids.items()]
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


def _encode_binary(camera_ids: dict[int, tuple], images: Sequence[_Image], points: Sequence[tuple]) -> dict[str, bytes]:
    return {
        "cameras.bin": _pack_records([pack("<IiQQ4d", i, _PINHOLE, *lens) for i, lens in camera_ids.items()]),
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
