"""A data set for trainers on a GPU, nerfstudio and those that read COLMAP's folders: photographs, cameras, points.

The photographs are in full size, upright, without the distortion of their lens; cameras are those of these photographs.
Trainers take `transforms.json` and `sparse_pc.ply`, or `sparse/0`; both have the Gaussians' centres to begin with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.image_file import (
    UnusableImage,
    ValueRange,
    decode_any_image,
    encode_jpeg,
    encode_png,
    find_common_range,
    read_image_file,
)
from splatnode.capture.lenses import undistort_image
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.export.limits import SceneFileError, compute_base_rgb
from splatnode.recon.result.export.stored import StoredResult
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.stored_snapshot import find_image, list_image_folders

DEFAULT_NAME = "dataset"
POINTS = "sparse_pc.ply"  # as nerfstudio names the points of its own data sets

_COLOURS = ("red", "green", "blue")
_JPEG = (".jpg", ".jpeg")
_JPEG_QUALITY = 95
_ROUNDED = 1.0  # pixels of the modelled photograph's sides, by which rounding changes their ratio


def export(result: StoredResult) -> dict[str, bytes]:
    """images/, transforms.json, sparse_pc.ply and sparse/0/. Raises SceneFileError where a photograph is gone."""
    folders = list_image_folders(result.scene.parent)
    files, cameras = {}, []
    found = [find_image(camera, folders) for camera in result.cameras()]
    used = find_common_range([path for path in found if path is not None])
    for camera in result.cameras():
        image = _load_image(camera, folders, used)
        name = camera.name if camera.name.lower().endswith((".png", *_JPEG)) else f"{camera.name}.png"
        files[f"images/{name}"] = _encode_image(image, name)
        cameras.append(_resize_camera(replace(camera, name=name), *image.shape[1::-1]))
    scale, gaussians = result.scale(), result.gaussians()
    model = encode_colmap(cameras, gaussians, scale)
    files |= {f"sparse/0/{name}": data for name, data in model.items()}
    files[POINTS] = encode_points(gaussians)
    return files | {"transforms.json": encode_nerfstudio(cameras, scale, POINTS)}


def encode_points(gaussians: GaussianArrays) -> bytes:
    """The Gaussians' centres and colours as a PLY file of points: what Open3D, and so nerfstudio, reads."""
    rows = np.zeros(len(gaussians), [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in _COLOURS])
    for axis, name in enumerate("xyz"):
        rows[name] = gaussians.means[:, axis]
    for channel, name in enumerate(_COLOURS):
        rows[name] = compute_base_rgb(gaussians)[:, channel]
    properties = [f"property float {name}" for name in "xyz"] + [f"property uchar {name}" for name in _COLOURS]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    return "\n".join(head).encode() + rows.tobytes()


def _load_image(camera: CameraEstimate, folders: Sequence[Path], used: ValueRange | None) -> npt.NDArray[np.uint8]:
    """(H, W, 3) in full size, upright, without the distortion of its lens. Raises SceneFileError."""
    path = find_image(camera, folders)
    if path is None:
        places = " or ".join(str(folder) for folder in folders)
        raise SceneFileError(f"the photograph {camera.name} is not in {places} any more: put it back there")
    try:
        lens = camera.lens or camera.given_lens
        image = undistort_image(decode_any_image(read_image_file(path), used=used).image, lens)
    except (UnusableImage, ValueError) as error:
        raise SceneFileError(f"{path}: {error}") from error
    height, width = image.shape[:2]
    if abs(width * camera.height - height * camera.width) > _ROUNDED * max(width, height):
        raise SceneFileError(
            f"{path} has {width} x {height} pixels, which is not the shape of the photograph that the scene was made "
            f"of ({camera.width} x {camera.height} as it was modelled): it is another one"
        )
    return image


def _resize_camera(camera: CameraEstimate, width: int, height: int) -> CameraEstimate:
    """The camera for its photograph of this many pixels, which has no distortion any more."""
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return replace(camera, K=K, width=width, height=height, lens=None, given_lens=None)


def _encode_image(image: npt.NDArray[np.uint8], name: str) -> bytes:
    return encode_jpeg(image, _JPEG_QUALITY) if name.lower().endswith(_JPEG) else encode_png(image)
