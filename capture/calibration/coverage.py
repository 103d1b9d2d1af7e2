"""Where in the picture the board was seen, on a grid of cells that are nearly square."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.corners import BoardView

_COLUMNS = 10  # of the grid along the picture's longer side
_DARK = 12.0  # grey levels, of a cell's mean: what is never lighter is no picture, as beyond a fisheye's circle
_AT_CORNER = 2  # cells to each side, in which the board is to be seen near a corner of the picture
CORNERS = {"upper left": (0, 0), "upper right": (1, 0), "lower left": (0, 1), "lower right": (1, 1)}


@dataclass(frozen=True, eq=False)
class Coverage:
    width: int  # of the pictures, pixels
    height: int  # likewise, pixels
    seen: npt.NDArray[np.bool_]  # (R, C) whether a corner of the board was seen in the cell
    lightest: npt.NDArray[np.float64]  # (R, C) mean grey level of the cell in the picture where it was lightest

    @property
    def picture_mask(self) -> npt.NDArray[np.bool_]:  # (R, C)
        """Returns the mask of cells with a picture. Where the board was seen, there is one."""
        return (self.lightest > _DARK) | self.seen

    @property
    def share(self) -> float:
        """Returns the share of the cells with a picture in which the board was seen."""
        return float(self.seen.sum() / max(1, self.picture_mask.sum()))

    @property
    def open_corners(self) -> tuple[str, ...]:
        """The picture's corners near which the board was not seen, though there is a picture."""
        near = {name: (_end(y, _AT_CORNER), _end(x, _AT_CORNER)) for name, (x, y) in CORNERS.items()}
        return tuple(
            name for name, cells in near.items() if self.picture_mask[cells].any() and not self.seen[cells].any()
        )

    @property
    def outermost(self) -> npt.NDArray[np.float64]:  # (4, 2)
        """The pixels nearest to the picture's corners where there is a picture, in the order of CORNERS."""
        middle = np.array([self.width, self.height]) / 2
        steps = np.linspace(1.0, 0.0, 4 * _COLUMNS + 1)[:, None]
        found = []
        for x, y in CORNERS.values():
            way = middle + steps * ((x * self.width, y * self.height) - middle)
            rows, columns = _cells(way, self.width, self.height, self.seen.shape)
            found.append(way[int(np.argmax(self.picture_mask[rows, columns]))])
        return np.array(found)

    @property
    def text_rows(self) -> list[str]:
        """A line a row of cells: # where the board was seen, . where not yet, a blank where there is no picture."""
        signs = np.where(self.seen, "#", np.where(self.picture_mask, ".", " "))
        return ["".join(row) for row in signs]


def create_coverage(width: int, height: int) -> Coverage:
    """Creates the coverage of pictures of this size, before the first."""
    cell = max(width, height) / _COLUMNS
    shape = max(1, round(height / cell)), max(1, round(width / cell))
    return Coverage(width, height, np.zeros(shape, bool), np.zeros(shape))


def add_picture(coverage: Coverage, image: npt.NDArray[np.uint8]) -> Coverage:
    """And the light of a picture (H, W, 3), whether or not it shows the board."""
    rows, columns = coverage.seen.shape
    mean = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64).mean(axis=-1)
    return replace(coverage, lightest=np.maximum(coverage.lightest, mean))


def add_view(coverage: Coverage, view: BoardView) -> Coverage:
    """And the corners of a view."""
    seen = coverage.seen.copy()
    seen[_cells(view.pixels, coverage.width, coverage.height, seen.shape)] = True
    return replace(coverage, seen=seen)


def _cells(pixels: npt.NDArray, width: int, height: int, shape: tuple[int, ...]) -> tuple[npt.NDArray, npt.NDArray]:
    rows = np.clip((pixels[:, 1] * shape[0] / height).astype(int), 0, shape[0] - 1)
    return rows, np.clip((pixels[:, 0] * shape[1] / width).astype(int), 0, shape[1] - 1)


def _end(far: int, cells: int) -> slice:
    return slice(-cells, None) if far else slice(0, cells)
