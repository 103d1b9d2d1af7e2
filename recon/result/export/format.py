"""What an export format is. A new one is a new module of recon.result.export.formats, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import Protocol, cast

from splatnode.recon.result.export import formats
from splatnode.recon.result.export.stored import StoredResult


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
    return sorted(module.name for module in iter_modules(formats.__path__))


def load_format(name: str) -> Format:
    """The format called `name`. Raises ValueError where there is none."""
    if name not in list_format_names():
        raise ValueError(f"the format must be one of {', '.join(list_format_names())}; got {name!r}")
    return cast(Format, import_module(f"{formats.__name__}.{name}"))
