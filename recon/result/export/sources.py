"""sources.bin: the source frames of a result's Gaussians (`recon.result.sources`), which scene files have no place for.

Little-endian int32, one a Gaussian, in the order of the scene.ply beside it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.error import SceneFileError

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
