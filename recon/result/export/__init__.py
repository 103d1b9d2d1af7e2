"""Scenes and cameras as files. NumPy only: a result can be read, converted and written where there is no torch."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Protocol, cast

from splatnode.capture.process import plugins
from splatnode.capture.process.terminal import say, show_waiting
from splatnode.recon.result.export import formats
from splatnode.recon.result.export.limits import EVERYTHING, Box, SceneFileError, Selection, sanitize_gaussians
from splatnode.recon.result.export.result import remove_result, write_beside, write_result
from splatnode.recon.result.export.staged import ResultWriteError, write_file, write_files
from splatnode.recon.result.export.stored import StoredResult, read_cameras, read_gaussians

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
    return sorted({*_list_own_names(), *plugins.entry_points(plugins.EXPORT_FORMATS)})


def _list_own_names() -> list[str]:
    return [module.name for module in iter_modules(formats.__path__)]


def load_format(name: str) -> Format:
    """The format called `name`. Raises ValueError where there is none."""
    if name not in list_format_names():
        raise ValueError(f"the format must be one of {', '.join(list_format_names())}; got {name!r}")
    if name in _list_own_names():
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
