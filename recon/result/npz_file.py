"""NumPy's archives of a result folder, read as what strangers may have made: bounded, and of plain arrays alone."""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.recon.result.export.error import SceneFileError


@contextlib.contextmanager
def open_npz(data: bytes, most_bytes: int, name: str, what: str) -> Iterator[Mapping[str, npt.NDArray[Any]]]:
    """The arrays of an archive, which together have at most so many bytes; each is read when it is asked for.

    Raises SceneFileError, also for an array that is asked for and not there; it calls the file `name`, and its content
    `what`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most_bytes:
            raise SceneFileError(f"{name} holds {size} bytes; at most {most_bytes} are read")
        # Sides that no array has overflow when NumPy multiplies them, before it refuses them.
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays, np.errstate(all="ignore"):
            yield arrays
    except (KeyError, ValueError, OSError, zipfile.BadZipFile, EOFError) as error:
        raise_shortage(error)
        raise SceneFileError(f"{name} is not a file of {what}, or is damaged: {error}") from error
