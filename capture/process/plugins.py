"""Plug-ins by entry points: what is installed beside the core adds verbs, cameras, priors, formats and viewers.

An entry point is a line of a file `entry_points.txt` (PyPA's specification): a group, a name, and the module, or the
object of one, that is meant. The room `extras` has such a file, so that a checkout needs no installation; a package of
your own declares its own in its pyproject.toml. The core reads these lines, and imports what one names when it is used.
"""

from __future__ import annotations

import functools
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import MappingProxyType
from typing import Any

from splatnode.capture.process.files import open_regular
from splatnode.capture.process.python import is_current_folder
from splatnode.capture.process.system import raise_shortage
from splatnode.capture.process.text import sanitize_text

log = logging.getLogger(__name__)

VERBS = "splatnode.verbs"  # a Verb
CAMERAS = "splatnode.cameras"  # a module, as one of capture/cameras
RECORDINGS = "splatnode.recordings"  # a module, as capture/film.py says
PRIORS = "splatnode.priors"  # a module, as one of recon/priors
EXPORT_FORMATS = "splatnode.export_formats"  # a module, as one of recon/result/export/formats
VIEWERS = "splatnode.viewers"  # a FurtherViewer

# What a plug-in must have. Those of cameras and priors are named where they are configured, `Plugin.needs`.
NEEDS: Mapping[str, tuple[str, ...]] = {
    VERBS: ("name", "summary", "add_arguments", "run"),
    RECORDINGS: ("is_recording", "configure_part", "explain_many"),
    EXPORT_FORMATS: ("DEFAULT_NAME", "export"),
    VIEWERS: ("name", "summary", "shows", "show", "add_arguments", "check", "is_server"),
}
_OWN = Path(__file__).parents[2] / "extras" / "entry_points.txt"
_FILE = "entry_points.txt"  # in the folder that an installation leaves for a distribution
_GROUP = re.compile(r"\[\s*([\w.-]+)\s*\]")
# NAME = MODULE or MODULE:OBJECT; extras behind it, in brackets, are for installers.
_LINE = re.compile(r"([^=\[\s][^=]*?)\s*=\s*([\w.]+)\s*(?::\s*([\w.]+))?\s*(?:\[.*\])?")
_MAX_BYTES = 1_000_000


def ignore(_: Any) -> None:
    """Tries nothing of a plug-in."""


class BrokenPlugin(ImportError):
    """A plug-in was named and cannot be imported, though its packages are there."""

    exit_code = 69


@dataclass(frozen=True)
class EntryPoint:
    group: str
    name: str
    module: str
    attribute: str  # dotted; empty: the module itself
    file: Path  # that declares it
    rival: Path | None = None  # the file of another package that gives this name something else

    def load(self) -> Any:
        """Returns what it names. Raises ModuleNotFoundError without an optional package, BrokenPlugin otherwise."""
        if self.rival is not None:
            raise BrokenPlugin(
                f"the plug-in {self.name!r} of {self.group} must be brought by one package; {self.package} and "
                f"{_name_package(self.rival)} both do. Uninstall one of them"
            )
        try:
            loaded = import_module(self.module)
            loaded = functools.reduce(getattr, self.attribute.split("."), loaded) if self.attribute else loaded
            needs = NEEDS.get(self.group, ())
            missing = [needed for needed in needs if not hasattr(loaded, needed)]
        except Exception as error:  # whatever a stranger's module does when it is imported
            missing = error.name if isinstance(error, ModuleNotFoundError) else None
            if missing and missing.split(".")[0] != self.module.split(".")[0]:
                raise
            raise BrokenPlugin(
                f"the plug-in {self.name!r} of {self.group} must be {self.target}, as {self.file} says, and that "
                f"cannot be imported: {error}. Install the package that has it again, or remove it"
            ) from error
        if missing:
            raise BrokenPlugin(
                f"the plug-in {self.name!r} of {self.group} must have {', '.join(needs)}; {self.target} of "
                f"{self.package} has no {' and no '.join(missing)}. Install a version of that package that has "
                "them, or remove it"
            )
        return loaded

    @property
    def target(self) -> str:
        return f"{self.module}:{self.attribute}" if self.attribute else self.module

    @property
    def is_ours(self) -> bool:
        return self.file == _OWN

    @property
    def package(self) -> str:
        """The name of the distribution that declares it, as PyPI writes it."""
        return "splatnode" if self.is_ours else _name_package(self.file)


def entry_points(group: str) -> Mapping[str, EntryPoint]:
    """The entry points of a group by their names: those of `extras`, then those of installed distributions.

    A name of `extras` stays what it is. Where two distributions give one name to two things, `load` refuses it. None is
    imported.
    """
    return _read_all(tuple(sys.path), os.getcwd()).get(group, MappingProxyType({}))


def list_names(folder: Path, group: str) -> tuple[str, ...]:
    """The names of the modules in a folder of the core and of the entry points of a group, sorted; none is imported."""
    return tuple(sorted({*(module.name for module in iter_modules([str(folder)])), *entry_points(group)}))


def load_all(group: str, try_out: Callable[[Any], object] = ignore) -> dict[str, Any]:
    """Loads what the entry points of a group name, by their names.

    It logs and leaves out what cannot be imported, or what of another package `try_out` fails on.
    """
    loaded = {}
    for name, entry in entry_points(group).items():
        try:
            found = entry.load()
            if not entry.is_ours:
                _try_out(entry, found, try_out)
        except ImportError as error:
            log.warning("%s", sanitize_text(f"left out: {error}"))
        else:
            loaded[name] = found
    return loaded


def _try_out(entry: EntryPoint, found: Any, try_out: Callable[[Any], object]) -> None:
    try:
        try_out(found)
    except Exception as error:  # whatever a stranger's function does
        raise BrokenPlugin(
            f"the plug-in {entry.name!r} of {entry.group}, {entry.target} of {entry.package}, cannot be offered: "
            f"{type(error).__name__}: {error}. Install another version of that package, or remove it"
        ) from error


@functools.lru_cache(maxsize=4)
def _read_all(path: tuple[str, ...], current: str) -> Mapping[str, Mapping[str, EntryPoint]]:
    """All groups of this project, of what is not in the `current` folder.

    `importlib.metadata` finds the same, in the time of a whole start.
    """
    found: dict[str, dict[str, EntryPoint]] = {}
    for file in (_OWN, *_find_files(path)):
        for entry in _read_file(file):
            first = found.setdefault(entry.group, {}).setdefault(entry.name, entry)
            if not first.is_ours and first.target != entry.target:
                found[entry.group][entry.name] = replace(first, rival=file)
    return MappingProxyType({group: MappingProxyType(entries) for group, entries in found.items()})


def _find_files(path: tuple[str, ...]) -> Iterator[Path]:
    """The files of installed distributions but this one, in the order of the path and of the alphabet.

    Of a distribution that is installed twice the first counts, as for an import.
    """
    seen = {"splatnode"}
    for folder in dict.fromkeys(path):
        if not os.path.isabs(folder) or is_current_folder(folder):  # whoever made its files is nobody's choice
            continue
        try:
            names = sorted(os.listdir(folder))
        except OSError as error:  # a zip file, or nothing
            raise_shortage(error)
            continue
        for name in names:
            file = Path(folder, name, _FILE)
            if name.endswith((".dist-info", ".egg-info")) and _name_package(file) not in seen:
                seen.add(_name_package(file))
                yield file


def _name_package(file: Path) -> str:
    """The name of the distribution whose file this is: of my_eyes-1.0.dist-info/entry_points.txt it is my-eyes."""
    folder = file.parent.name.removesuffix(".dist-info").removesuffix(".egg-info")
    return re.sub(r"[-_.]+", "-", folder.split("-")[0]).lower()


def _read_file(file: Path) -> Iterator[EntryPoint]:
    try:
        with open_regular(file, OSError) as opened:
            text = opened.read(_MAX_BYTES).decode("utf-8", "replace")
    except OSError as error:  # most distributions declare nothing
        raise_shortage(error)
        return
    if "splatnode." not in text:
        return
    group = ""
    for line in map(str.strip, text.splitlines()):
        if header := _GROUP.fullmatch(line):
            group = header[1]
        elif group.startswith("splatnode.") and not line.startswith(("#", ";")) and (named := _LINE.fullmatch(line)):
            yield EntryPoint(group, named[1], named[2], named[3] or "", file)
