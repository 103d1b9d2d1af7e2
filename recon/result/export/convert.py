"""export_scene: a result, or a scene file, in another format."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from splatnode.recon.result.export.cameras import (
    decode_cameras,
    decode_scale,
    encode_colmap,
    encode_nerfstudio,
    encode_tum,
)
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.ply import decode_ply, encode_ply
from splatnode.recon.result.export.prepare import viewer_safe
from splatnode.recon.result.export.splat import decode_splat, encode_splat
from splatnode.recon.result.export.spz import decode_spz, encode_spz
from splatnode.recon.result.export.staged import write_file, write_files
from splatnode.recon.result.scale import RELATIVE, Scale
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays

_DECODERS: dict[str, Callable[[bytes, str], GaussianArrays]] = {
    ".ply": decode_ply,
    ".spz": decode_spz,
    ".splat": decode_splat,
}
_SCENE_ENCODERS = {"ply": encode_ply, "spz": encode_spz, "splat": encode_splat}
_CAMERA_ENCODERS = {"nerfstudio": encode_nerfstudio, "tum": encode_tum}
FORMATS = {  # and where each goes, beside the scene
    "ply": "scene.ply",
    "spz": "scene.spz",
    "splat": "scene.splat",
    "colmap": "colmap",
    "nerfstudio": "transforms.json",
    "tum": "trajectory.tum",
}


def read_gaussians(path: Path) -> GaussianArrays:
    """The Gaussians of a .ply, .spz or .splat file, with finite values and bounded extents.

    Raises SceneFileError where the file is truncated or is something else, OSError where it cannot be read.
    """
    decode = _DECODERS.get(path.suffix.lower())
    if decode is None:
        raise SceneFileError(f"{path.name} must end with {', '.join(_DECODERS)}")
    gaussians = decode(path.read_bytes(), path.name)
    safe = viewer_safe(gaussians)
    if len(gaussians) and not len(safe):
        raise SceneFileError(f"{path.name} holds {len(gaussians)} Gaussians, none of them with finite values")
    return safe


def read_cameras(path: Path) -> tuple[CameraEstimate, ...]:
    """The cameras of a cameras.json. Raises SceneFileError, OSError."""
    return decode_cameras(path.read_bytes(), path.name)


def export_scene(source: Path, to: str, destination: Path | None = None) -> Path:
    """Writes the result folder or scene file `source` as `to`, one of FORMATS; returns where it is.

    `destination` is a file, for "colmap" a folder; without it, the place beside the scene, if nothing is there yet.
    Cameras come from the cameras.json of the folder or beside the file. Raises ValueError for an unknown format or a
    place that is taken, SceneFileError for input that cannot be read as what it should be, FileNotFoundError where
    there is none, ResultWriteError where the output cannot be written.
    """
    if to not in FORMATS:
        raise ValueError(f"the format must be one of {', '.join(FORMATS)}; got {to!r}")
    scene = source / "scene.ply" if source.is_dir() else source
    if destination is None:
        destination = scene.with_name(FORMATS[to])
        if destination.exists():
            raise ValueError(f"{destination} is there already: give another place with --out PATH")
    cameras = scene.with_name("cameras.json")
    if to in _SCENE_ENCODERS:
        encode = partial(encode_ply, scale=_scale(cameras)) if to == "ply" else _SCENE_ENCODERS[to]
        write_file(destination, encode(read_gaussians(_existing(scene))))
    elif to in _CAMERA_ENCODERS:
        write_file(destination, _CAMERA_ENCODERS[to](read_cameras(_existing(cameras)), scale=_scale(cameras)))
    else:
        model = encode_colmap(read_cameras(_existing(cameras)), read_gaussians(_existing(scene)), _scale(cameras))
        write_files(destination, model)
    return destination


def _scale(cameras: Path) -> Scale:
    return decode_scale(cameras.read_bytes()) if cameras.is_file() else RELATIVE


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not there. Give the folder of a result (splatnode replay FOLDER --out DIR), or a scene file; "
            "the formats of cameras need the result's cameras.json beside it"
        )
    return path
