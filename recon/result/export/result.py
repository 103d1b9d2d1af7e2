"""write_result: a snapshot as the folder that `splatnode replay` leaves."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import msgspec

from splatnode.capture.process.foreign import foreign
from splatnode.capture.process.printable import is_printable
from splatnode.capture.process.records import record_in
from splatnode.recon.result.export.cameras import encode_cameras
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.formats.tum import encode_tum
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.prepare import viewer_safe
from splatnode.recon.result.export.staged import ResultWriteError, explanation, json_bytes, write_files
from splatnode.recon.result.snapshot import Snapshot

MANIFEST = "manifest.json"


def write_result(
    snapshot: Snapshot,
    out_dir: Path,
    report: Mapping[str, object],
    *,
    preview: bytes | None = None,
    further: Mapping[str, bytes] = MappingProxyType({}),
) -> Path:
    """Writes scene.ply, the cameras in four formats, preview.png, report.json and manifest.json; returns its path.

    `further` are other files of the scene, by name in the folder.

    A scene that its verdict does not let be published leaves report.json and manifest.json only. The folder holds one
    result: files that an earlier manifest lists, that are unchanged since, and that this result does not have are
    removed once the new manifest is there. `report` is that of `build_report`. Raises ResultWriteError, with an
    earlier result intact, where the files cannot be written.
    """
    files = {"report.json": json_bytes(report)}
    if snapshot.verdict.publishable:
        files = _scene_files(snapshot, preview) | dict(further) | files
    previous = _read_manifest(out_dir)
    manifest = {
        **snapshot.scale.record(),
        "verdict": snapshot.verdict.code.value,
        "files": {name: {"bytes": len(data), "sha256": _sha256(data)} for name, data in files.items()},
    }
    superseded = {name: digest for name, digest in previous.items() if name not in files and name != MANIFEST}
    write_files(out_dir, files | {MANIFEST: json_bytes(manifest)}, superseded)
    return out_dir / MANIFEST


def copy_result(folder: Path, out_dir: Path) -> Path:
    """Writes the result that lies in `folder` into `out_dir`, as `write_result` wrote it; returns the manifest's path.

    Raises SceneFileError where the files are not those of its manifest any more, and ResultWriteError.
    """
    listed, files = _read_manifest(folder), {}
    for name, digest in listed.items():
        path = folder / name
        if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
            raise SceneFileError(f"{path} is not there any more, and {MANIFEST} lists it")
        files[name] = path.read_bytes()
        if _sha256(files[name]) != digest:
            raise SceneFileError(f"{path} was changed since it was written: it is not what {MANIFEST} tells of")
    if not files:
        raise SceneFileError(f"{folder} has no {MANIFEST} that can be read: it is no result that was written whole")
    files[MANIFEST] = (folder / MANIFEST).read_bytes()
    superseded = {name: digest for name, digest in _read_manifest(out_dir).items() if name not in files}
    write_files(out_dir, files, superseded)
    return out_dir / MANIFEST


def remove_result(out_dir: Path) -> None:
    """Removes what `write_result` wrote and nobody changed since, and the folder if it is empty then.

    Raises ResultWriteError.
    """
    previous = _read_manifest(out_dir)
    if not previous:
        return
    try:
        own = {MANIFEST: _sha256((out_dir / MANIFEST).read_bytes())}
    except OSError as error:
        raise ResultWriteError(error.errno, explanation(error, out_dir)) from error
    write_files(out_dir, {}, previous | own)
    with contextlib.suppress(OSError):  # others' files may be in it
        out_dir.rmdir()


def _scene_files(snapshot: Snapshot, preview: bytes | None) -> dict[str, bytes]:
    gaussians = viewer_safe(snapshot.gaussians)
    cameras, scale = snapshot.cameras, snapshot.scale
    colmap = encode_colmap(cameras, gaussians, scale)
    return {
        "scene.ply": encode_ply(gaussians, scale),
        "cameras.json": encode_cameras(cameras, scale),
        **{f"colmap/{name}": data for name, data in colmap.items()},
        "trajectory.tum": encode_tum(cameras, scale),
        "transforms.json": encode_nerfstudio(cameras, scale),
        **({"preview.png": preview} if preview is not None else {}),
    }


class _Entry(msgspec.Struct, frozen=True):
    sha256: str


class _Manifest(msgspec.Struct, frozen=True):
    files: dict[str, _Entry]


def _read_manifest(out_dir: Path) -> dict[str, str]:
    """sha256 by file of the result that is there; empty where there is none that can be read."""
    with contextlib.suppress(OSError, SceneFileError), foreign(SceneFileError):
        manifest = record_in(read_json_file(out_dir / MANIFEST), _Manifest)
        return {name: entry.sha256 for name, entry in manifest.files.items() if is_printable(name)}
    return {}


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
