"""How much a scene file may hold, whatever it says of itself, and how its bytes are read."""

from __future__ import annotations

from pathlib import Path

from splatnode.capture.process.files import read_bounded

# SceneFileError: a file that cannot be read as the scene it should hold.


class SceneFileError(ValueError):
    """The message names the file, what was expected in it and what was found."""


MAX_GAUSSIANS = 10_000_000
MAX_VALUES = 350_000_000  # numbers of all Gaussians: 5.6 million with spherical harmonics of degree 3
BYTES_A_VALUE = 16  # of memory at most while a scene is read, beside the file's bytes
MAX_SCENE_BYTES = 4_000_000_000
MAX_JSON_BYTES = 50_000_000  # of cameras.json and report.json
MAX_CAMERAS = 10_000
_OTHER_VALUES = 12  # of a Gaussian beside its colour: centre, rotation, extents, opacity, source


def check_count(num_gaussians: int, num_bases: int, name: str) -> None:
    """Raises SceneFileError, which names the file as `name`, where these are more Gaussians than can be read."""
    most = min(MAX_GAUSSIANS, MAX_VALUES // count_values(num_bases))
    if num_gaussians > most:
        raise SceneFileError(
            f"{name} promises {num_gaussians} Gaussians; at most {most} with {num_bases} coefficients a colour can be "
            "read. Prune it, or save it with spherical harmonics of a lower degree"
        )


def count_values(num_bases: int) -> int:
    """How many numbers one Gaussian has."""
    return _OTHER_VALUES + 3 * num_bases


def read_scene_file(path: Path) -> bytes:
    """Raises SceneFileError, OSError."""
    return read_bounded(path, MAX_SCENE_BYTES, SceneFileError, path.name)


def read_json_file(path: Path) -> bytes:
    """Raises SceneFileError, OSError."""
    return read_bounded(path, MAX_JSON_BYTES, SceneFileError, path.name)
