"""Scenes and cameras as files. NumPy only: a result can be read, converted and written where there is no torch."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Protocol, cast

import msgspec

from splatnode.capture.process import plugins
from splatnode.capture.process.config import record_in
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.terminal import say, show_waiting
from splatnode.capture.process.text import guard_untrusted, is_printable
from splatnode.recon.result.export import formats
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.formats.tum import encode_tum
from splatnode.recon.result.export.limits import (
    EVERYTHING,
    Box,
    SceneFileError,
    Selection,
    read_json_file,
    sanitize_gaussians,
)
from splatnode.recon.result.export.staged import ResultWriteError, explain_error, json_bytes, write_file, write_files
from splatnode.recon.result.export.stored import StoredResult, encode_cameras, read_cameras, read_gaussians
from splatnode.recon.result.snapshot import Snapshot

# write_result: a snapshot as the folder that `splatnode replay` leaves.

# The list of the files that were written together, by which they are known again and removed together.

MANIFEST = "manifest.json"  # of a result
EXPORTS = "exports.json"  # of what was made of a result afterwards and put into its folder: exports, pictures
OF_A_MAP = "map.json"  # of a map of free space
MAPS = "occupancy"  # the folder in a result's own that its map is in, where nobody names another


LIVE_PICTURE = "live.png"  # which a viewer without a window keeps up to date while a scene is made


class _Entry(msgspec.Struct, frozen=True):
    sha256: str


class _Manifest(msgspec.Struct, frozen=True):
    files: dict[str, _Entry]


def make_entries(files: Mapping[str, bytes]) -> dict[str, dict[str, object]]:
    """Makes the manifest's entry for each of the files."""
    return {name: {"bytes": len(data), "sha256": sha256(data)} for name, data in files.items()}


def read_digests(path: Path) -> dict[str, str]:
    """SHA-256 by file of what the manifest `path` lists; empty where there is none that can be read.

    Raises what is_shortage tells.
    """
    try:
        with guard_untrusted(SceneFileError):
            manifest = record_in(read_json_file(path), _Manifest)
    except (OSError, SceneFileError) as error:
        raise_shortage(error)
        return {}
    return {name: entry.sha256 for name, entry in manifest.files.items() if is_printable(name)}


def read_derived_digests(folder: Path) -> dict[str, str]:
    """SHA-256 by file of what was made of the result in `folder`, and of the manifests: maps, exports and pictures."""
    found = {}
    for manifest in (OF_A_MAP, f"{MAPS}/{OF_A_MAP}", EXPORTS):
        within = manifest.removesuffix(OF_A_MAP).removesuffix(EXPORTS)
        listed = {f"{within}{name}": digest for name, digest in read_digests(folder / manifest).items()}
        try:
            listed |= {manifest: sha256((folder / manifest).read_bytes())} if listed else {}
        except OSError as error:
            raise_shortage(error)
        found |= listed
    return found


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


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
    `exports.json`: the next result that is written there removes it, unless somebody has changed it meanwhile. So does
    the next export to the same place with what it does not write itself; elsewhere, a folder of several files has such
    a list of its own. Raises ResultWriteError.
    """
    folder = Path(os.path.realpath(of if of.is_dir() else of.parent))
    if path.is_dir():
        path = Path(os.path.realpath(path))  # the user's own link
    target = Path(os.path.realpath(path.parent)) / path.name
    if not (target.is_relative_to(folder) and read_digests(folder / MANIFEST)):
        files = {os.path.normpath(f"{path.name}/{name}"): data for name, data in contents.items()}
        listed = read_digests(path / EXPORTS)
        gone = {f"{path.name}/{name}": digest for name, digest in listed.items() if name not in contents}
        if len(contents) > 1:
            files[f"{path.name}/{EXPORTS}"] = json_bytes({"files": make_entries(contents)})
        write_files(path.parent, files, gone)
        return
    place = target.relative_to(folder)
    files = {os.path.normpath(place / name): data for name, data in contents.items()}
    listed = read_digests(folder / EXPORTS)
    gone = {name: digest for name, digest in listed.items() if name.startswith(f"{place}/") and name not in files}
    known = {name: {"sha256": digest} for name, digest in listed.items() if name not in gone}
    write_files(folder, files | {EXPORTS: json_bytes({"files": known | make_entries(files)})}, gone)


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


# Scenes and cameras as files. NumPy only: a result can be read, converted and written where there is no torch.

__all__ = [
    "ResultWriteError",
    "SceneFileError",
    "export_scene",
    "read_cameras",
    "read_gaussians",
    "remove_result",
    "sanitize_gaussians",
    "write_beside",
    "write_file",
    "write_files",
    "write_result",
]


# What an export format is. A new one is a new module of recon.result.export.formats, and nothing else.
#
# Further ones are installed beside the core: an entry point of `splatnode.export_formats` names the module of each.
# The verb export is here, too.


class Format(Protocol):
    """The interface of a module of recon.result.export.formats.

    A module that also has `decode(data: bytes, name: str) -> GaussianArrays` can be read: the files whose suffix is
    the module's name. `decode` raises SceneFileError, which names the file as `name`, where the data are not such a
    file. One whose files hold no Gaussians has `GAUSSIANS = False`.
    """

    DEFAULT_NAME: str  # of the file, or of the folder where there are several files, beside the scene

    def export(self, result: StoredResult) -> bytes | Mapping[str, bytes]:
        """The content of the file, or of each file by its name in the folder.

        It asks `result` for what it needs, and lets the errors of that pass.
        """
        ...


def list_format_names() -> list[str]:
    """The formats that there are, in the order of the alphabet. None of them is imported."""
    return list(plugins.list_names(Path(formats.__path__[0]), plugins.EXPORT_FORMATS))


def load_format(name: str) -> Format:
    """The format called `name`. Raises ValueError where there is none."""
    if name not in list_format_names():
        raise ValueError(f"the format must be one of {', '.join(list_format_names())}; got {name!r}")
    if (Path(formats.__path__[0]) / f"{name}.py").exists():
        return cast(Format, import_module(f"{formats.__name__}.{name}"))
    return plugins.entry_points(plugins.EXPORT_FORMATS)[name].load()


# export_scene: a result, or a scene file, in another format.


def export_scene(source: Path, to: str, destination: Path | None = None, selection: Selection = EVERYTHING) -> Path:
    """Writes the result folder or scene file `source` in the format `to`; returns where it is.

    `to` is a module of recon.result.export.formats, `selection` says which Gaussians are written. `destination` is a
    file, or a folder for a format of several files (colmap); without it, it is the format's own name beside the scene,
    if nothing is there yet. What lies in the folder of a result is removed with that result (`write_beside`). Cameras
    come from the cameras.json of the folder or beside the file. Raises ValueError for an unknown format, a destination
    that is taken, or a selection where the format has no Gaussians; SceneFileError for input that cannot be read as
    what it should be, or of which nothing is selected; FileNotFoundError where there is none, ResultWriteError where
    the output cannot be written.
    """
    format_ = load_format(to)
    if not selection.is_everything and not getattr(format_, "GAUSSIANS", True):
        raise ValueError(
            f"{to} holds cameras and no Gaussians: --multi-view-only, --no-background and --crop have nothing to "
            "leave out"
        )
    result = StoredResult.create_from_path(source, selection)
    if destination is None:
        destination = result.scene.with_name(format_.DEFAULT_NAME)
        if destination.exists():
            raise ValueError(f"{destination} is there already: give another place with --out PATH")
    content = format_.export(result)
    write_beside(destination, {"": content} if isinstance(content, bytes) else content, of=result.scene)
    return destination


def export(args: argparse.Namespace) -> int:
    within = None if args.crop is None else Box(args.crop[:3], args.crop[3:])
    with show_waiting(f"writing the scene as {args.to}"):
        written = export_scene(
            args.scene, args.to, args.out, Selection(args.multi_view_only, within, args.no_background)
        )
    say(written)
    return 0
