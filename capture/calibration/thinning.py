"""Which of too many views says least that others do not say, too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.corners import BoardView
from splatnode.capture.calibration.coverage import add_view, create_coverage


def find_redundant_view(views: Sequence[BoardView], apart: npt.NDArray[np.float64], width: int, height: int) -> int:
    """The number of the view to do without: all of its cells of the picture are seen in others, too.

    Of such views it is the one that lies nearest to another, and of these two the one that has the nearer second
    neighbour. `apart` (V, V) says how far views lie from one another, and is infinite on the diagonal. There must be
    more views than the grid of `coverage` has cells: then not each can have a cell of its own.
    """
    cells = np.array([add_view(create_coverage(width, height), view).seen for view in views])
    own = (cells & (cells.sum(axis=0) == 1)).any(axis=(1, 2))
    spare = np.flatnonzero(~own)
    nearest, second = np.sort(apart[spare], axis=1)[:, :2].T
    return int(spare[np.lexsort((second, nearest))[0]])
