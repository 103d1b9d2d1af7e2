"""depth.npz: the file of a result folder that holds the depths that two photographs confirm."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.bounded_file import read_bounded
from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.printable import LONGEST_NAME, sanitize_text
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.limits import MAX_CAMERAS
from splatnode.recon.result.npz_file import open_npz

DEPTHS = "depth.npz"  # in the result folder
MOST_BYTES = 1 << 29  # of the arrays in a file that is read
_LONGEST_SIDE = 8192  # pixels

Depths = Mapping[str, npt.NDArray[np.float16]]


def encode_depths(depths: Depths) -> bytes:
    """depth.npz: `names` (C,) of the cameras, and for each (h, w) z as `depth_0`, `depth_1` ...; NumPy arrays."""
    file = io.BytesIO()
    arrays: dict[str, Any] = {f"depth_{index}": each.astype(np.float16) for index, each in enumerate(depths.values())}
    np.savez_compressed(file, names=np.array([name.encode() for name in depths], np.bytes_), **arrays)
    return file.getvalue()


def read_depths(folder: Path) -> dict[str, npt.NDArray[np.float16]]:
    """The depths of the result in `folder`, by camera; none where it holds no such file.

    Raises SceneFileError where the file is damaged or is not ours, OSError.
    """
    path = folder / DEPTHS
    if not path.is_file():
        return {}
    with guard_untrusted(SceneFileError, str(path)):
        return decode_depths(read_bounded(path, MOST_BYTES, SceneFileError, str(path)), str(path))


def decode_depths(data: bytes, name: str = DEPTHS) -> dict[str, npt.NDArray[np.float16]]:
    """Reads depth.npz. Raises SceneFileError, which names the file as `name`, where it is something else."""
    with guard_untrusted(SceneFileError, name):
        with open_npz(data, MOST_BYTES, name, "depths") as arrays:
            names = arrays["names"]
            if names.ndim != 1 or names.dtype.kind != "S" or len(names) > MAX_CAMERAS:
                raise SceneFileError(f"{name}: names must be those of at most {MAX_CAMERAS} cameras")
            depths = [arrays[f"depth_{index}"] for index in range(len(names))]
        for depth in depths:
            sides = depth.shape if depth.ndim == 2 else (0,)
            if depth.dtype != np.float16 or not 1 <= min(sides) <= max(sides) <= _LONGEST_SIDE:
                raise SceneFileError(f"{name}: a depth must be (h, w) float16, got {depth.shape} {depth.dtype}")
            if not (np.isfinite(depth) & (depth >= 0)).all():
                raise SceneFileError(f"{name}: depths must be finite, and 0 or more")
        texts = [sanitize_text(each.decode(), LONGEST_NAME) for each in names.tolist()]
        return dict(zip(texts, depths, strict=True))
