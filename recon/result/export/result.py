"""write_result: a snapshot as the folder that `splatnode replay` leaves."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from splatnode.recon.result.export.cameras import encode_cameras
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.formats.tum import encode_tum
from splatnode.recon.result.export.manifest import (
    EXPORTS,
    MANIFEST,
    MAPS,
    make_entries,
    read_derived_digests,
    read_digests,
    sha256,
)
from splatnode.recon.result.export.prepare import sanitize_gaussians
from splatnode.recon.result.export.staged import ResultWriteError, explain_error, json_bytes, write_files
from splatnode.recon.result.snapshot import Snapshot


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
    removed once the new manifest is there, and so is what was made of it: maps, exports and pictures. `report` is that
    of `build_report`. Raises ResultWriteError, with an earlier result intact, where the files cannot be written.
    """
    files = {"report.json": json_bytes(report)}
    if snapshot.verdict.publishable:
        files = _scene_files(snapshot, preview) | dict(further) | files
    previous = read_digests(out_dir / MANIFEST)
    manifest = {**snapshot.scale.record(), "verdict": snapshot.verdict.code.value, "files": make_entries(files)}
    gone = read_derived_digests(out_dir) | previous
    superseded = {name: digest for name, digest in gone.items() if name not in files and name != MANIFEST}
    write_files(out_dir, files | {MANIFEST: json_bytes(manifest)}, superseded)
    return out_dir / MANIFEST


def copy_result(folder: Path, out_dir: Path) -> Path:
    """Writes the result that lies in `folder` into `out_dir`, as `write_result` wrote it; returns the manifest's path.

    Raises SceneFileError where the files are not those of its manifest any more, and ResultWriteError.
    """
    listed, files = read_digests(folder / MANIFEST), {}
    for name, digest in listed.items():
        path = folder / name
        if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
            raise SceneFileError(f"{path} is not there any more, and {MANIFEST} lists it")
        files[name] = path.read_bytes()
        if sha256(files[name]) != digest:
            raise SceneFileError(f"{path} was changed since it was written: it is not what {MANIFEST} tells of")
    if not files:
        raise SceneFileError(f"{folder} has no {MANIFEST} that can be read: it is no result that was written whole")
    files[MANIFEST] = (folder / MANIFEST).read_bytes()
    gone = read_derived_digests(out_dir) | read_digests(out_dir / MANIFEST)
    superseded = {name: digest for name, digest in gone.items() if name not in files}
    write_files(out_dir, files, superseded)
    return out_dir / MANIFEST


def write_beside(path: Path, contents: Mapping[str, bytes], of: Path) -> None:
    """Writes what was made of the result `of`, a folder or its scene file: `contents`, by path relative to `path`.

    The name "" is that of the file `path` itself. What lies inside of the result's folder is listed in its
    `exports.json`: the next result that is written there removes it, unless somebody has changed it meanwhile.
    Raises ResultWriteError.
    """
    folder = Path(os.path.realpath(of if of.is_dir() else of.parent))
    if path.is_dir():
        path = Path(os.path.realpath(path))  # the user's own link
    target = Path(os.path.realpath(path.parent)) / path.name
    if not (target.is_relative_to(folder) and read_digests(folder / MANIFEST)):
        write_files(path.parent, {os.path.normpath(f"{path.name}/{name}"): data for name, data in contents.items()})
        return
    place = target.relative_to(folder)
    files = {os.path.normpath(place / name): data for name, data in contents.items()}
    known = {name: {"sha256": digest} for name, digest in read_digests(folder / EXPORTS).items()}
    write_files(folder, files | {EXPORTS: json_bytes({"files": known | make_entries(files)})})


def remove_result(out_dir: Path) -> None:
    """Removes what `write_result` wrote and nobody changed since, and the folder if it is empty then.

    Raises ResultWriteError.
    """
    previous = read_digests(out_dir / MANIFEST)
    if not previous:
        return
    try:
        own = {MANIFEST: sha256((out_dir / MANIFEST).read_bytes())}
    except OSError as error:
        raise ResultWriteError(error.errno, explain_error(error, out_dir)) from error
    write_files(out_dir, {}, read_derived_digests(out_dir) | previous | own)
    for folder in (out_dir / MAPS, out_dir):
        with contextlib.suppress(OSError):  # others' files may be in it
            folder.rmdir()


def _scene_files(snapshot: Snapshot, preview: bytes | None) -> dict[str, bytes]:
    gaussians = sanitize_gaussians(snapshot.gaussians)
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
