"""A result on disk, read as far as somebody asks for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import numpy as np
import numpy.typing as npt

from splatnode.capture.process import plugins
from splatnode.capture.process.text import guard_untrusted
from splatnode.recon.result.export import formats
from splatnode.recon.result.export.cameras import decode_cameras, decode_scale
from splatnode.recon.result.export.limits import (
    EVERYTHING,
    SceneFileError,
    Selection,
    read_json_file,
    read_scene_file,
    sanitize_gaussians,
)
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.verdict import RELATIVE, Scale

# sources.bin: the source frames of a result's Gaussians (`recon.result.sources`), which scene files have no place for.
#
# Little-endian int32, one a Gaussian, in the order of the scene.ply beside it.

SOURCES = "sources.bin"


def encode_sources(source_frame: npt.NDArray[np.int32]) -> bytes:
    return source_frame.astype("<i4").tobytes()


def decode_sources(data: bytes, num_gaussians: int) -> npt.NDArray[np.int32]:
    """The source frames (N,) of so many Gaussians. Raises SceneFileError where there are not so many."""
    if len(data) != 4 * num_gaussians:
        raise SceneFileError(
            f"{SOURCES} tells where {len(data) / 4:g} Gaussians come from, the scene file beside it has "
            f"{num_gaussians}: one of the two is not what was written. Make the scene anew"
        )
    return np.frombuffer(data, "<i4").astype(np.int32)


@dataclass(frozen=True)
class StoredResult:
    """A scene file, and the cameras.json beside it. Files are read when they are asked for.

    What is asked for raises FileNotFoundError where its file is not there, SceneFileError where the file is something
    else, OSError where it cannot be read.
    """

    scene: Path
    selection: Selection = EVERYTHING  # of its Gaussians

    @classmethod
    def create_from_path(cls, path: Path, selection: Selection = EVERYTHING) -> StoredResult:
        """The result in a folder, or that of a scene file."""
        return cls(path / "scene.ply" if path.is_dir() else path, selection)

    def gaussians(self) -> GaussianArrays:
        """Those that are selected, with finite values and bounded extents."""
        sources = self._find_sources() if self.selection.needs_sources else None
        return self.selection.apply(read_gaussians(_check_exists(self.scene), sources), self.scene.name)

    def cameras(self) -> tuple[CameraEstimate, ...]:
        return read_cameras(_check_exists(self._cameras))

    def scale(self) -> Scale:
        """The unit of the lengths, as cameras.json states it; relative where there is no such file."""
        return decode_scale(read_json_file(self._cameras), self._cameras.name) if self._cameras.is_file() else RELATIVE

    def _find_sources(self) -> Path:
        """Finds the file of the Gaussians' source frames. Raises SceneFileError where there is none."""
        path = self.scene.with_name(SOURCES)
        if self.scene.suffix.lower() != ".ply" or not path.is_file():
            raise SceneFileError(
                f"{self.scene} does not tell which Gaussians two photographs confirm, or which are the far background: "
                f"that is in the {SOURCES} beside "
                "a result's scene.ply, which merged maps, and results of earlier versions, do not have. "
                "Make the scene anew: splatnode replay FOLDER --out DIR"
            )
        return path

    @property
    def _cameras(self) -> Path:
        return self.scene.with_name("cameras.json")


def read_gaussians(path: Path, sources: Path | None = None) -> GaussianArrays:
    """The Gaussians of a scene file (.ply, .spz, .splat), with finite values and bounded extents.

    Their source frames are unknown but where `sources` has them.
    Raises SceneFileError where the file is truncated or is something else, OSError where it cannot be read.
    """
    decoders = _load_decoders(path.suffix.lower())
    decode = decoders.get(path.suffix.lower())
    if decode is None:
        raise SceneFileError(f"{path.name} must end with {', '.join(decoders)}")
    # NumPy warns of a NaN that signals, and of what is too large, before it is looked for and left out.
    with guard_untrusted(SceneFileError, path.name), np.errstate(all="ignore"):
        gaussians = decode(read_scene_file(path), path.name)
        if sources is not None:
            source_frame = decode_sources(read_scene_file(sources), len(gaussians))
            gaussians = replace(gaussians, source_frame=source_frame)
        safe = sanitize_gaussians(gaussians)
        if len(gaussians) and not len(safe):
            raise SceneFileError(f"{path.name} holds {len(gaussians)} Gaussians, none of them with finite values")
        return safe


def read_cameras(path: Path) -> tuple[CameraEstimate, ...]:
    """The cameras of a cameras.json. Raises SceneFileError, OSError."""
    return decode_cameras(read_json_file(path), path.name)


def _load_decoders(suffix: str) -> dict[str, Callable[[bytes, str], GaussianArrays]]:
    """Loads the decoders by suffix: those here, and that of `suffix`. A format can be read if it has `decode`."""
    modules = {name: import_module(f"{formats.__name__}.{name}") for _, name, _ in iter_modules(formats.__path__)}
    further = plugins.entry_points(plugins.EXPORT_FORMATS)
    if (name := suffix.removeprefix(".")) in further and name not in modules:
        modules[name] = further[name].load()
    return {f".{name}": module.decode for name, module in sorted(modules.items()) if hasattr(module, "decode")}


def _check_exists(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not there. Give the folder of a result (splatnode replay FOLDER --out DIR), or a scene file; "
            "the formats of cameras need the result's cameras.json beside it"
        )
    return path
