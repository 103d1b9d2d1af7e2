"""How a photograph was turned when it was taken, as EXIF tells, undone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

ORIENTATION = 0x0112  # of EXIF
# By what EXIF says, quarters of a turn to the left, and whether it is mirrored then.
_TURNS = {
    1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (3, True), 6: (3, False), 7: (1, True), 8: (1, False),
}  # fmt: skip
ON_ITS_SIDE = tuple(orientation for orientation, (quarters, _) in _TURNS.items() if quarters % 2)


def upright(image: npt.NDArray, orientation: int) -> npt.NDArray:
    """The image (H, W) or (H, W, C) turned as EXIF says; `orientation` is 1 to 8."""
    quarters, mirrored = _TURNS.get(orientation, _TURNS[1])
    turned = np.rot90(image, quarters)
    return turned[:, ::-1] if mirrored else turned
