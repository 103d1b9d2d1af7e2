"""The pieces of a map as they are needed: files are read when the eye comes near, and forgotten when it goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatnode.recon.result.coarser import concatenate_gaussians, make_detail_levels
from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.pieces import SHELL_PIECE, Piece, Pieces
from splatnode.recon.result.shell import find_far_shell
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.graph import FULL, NOTHING, Array
from splatnode.viewer.nearness import Extent, choose_levels

_REACH = 90.0  # percentile of the distances of a piece's Gaussians from the middle of its cameras, which is its radius
Level = int


@dataclass(frozen=True, eq=False)
class _PieceSummary:
    """The coarse levels and the position of a piece that was read."""

    coarse: tuple[GaussianArrays, ...]
    counts: tuple[int, ...]
    sides: tuple[float, ...]
    centre: Array  # (3,)
    reach: float

    def extent(self, eye: Array, order: float) -> Extent:
        """As it is from the eye; `order` is when it is served."""
        away = float(np.linalg.norm(eye - self.centre)) - self.reach
        return Extent(max(0.0, away), order, self.counts, self.sides)


class MapLoader:
    """Keeps at most `budget` Gaussians in full or coarse, beside what is being read. To be used in one thread."""

    def __init__(self, pieces: Pieces, budget: int) -> None:
        self._pieces, self._budget = pieces, budget
        self._known: dict[str, _PieceSummary] = {}
        self._full: dict[str, GaussianArrays] = {}
        self.shown: dict[str, tuple[Level, int]] = {}  # by scene_id: the level that is loaded, and its Gaussians

    def gaussians(self) -> GaussianArrays:
        """Returns all that is loaded as one set of Gaussians."""
        parts = []
        for scene_id, (level, _) in self.shown.items():
            if level != NOTHING:
                parts.append(self._full[scene_id] if level == FULL else self._known[scene_id].coarse[level - 1])
        return concatenate_gaussians(parts)

    def look_from(self, eye: Array, changed: Callable[[], bool]) -> bool:
        """Loads and forgets one piece after the other until what is there is right for the `eye` (3,).

        After each `changed` is called, which may end it by True: the eye is elsewhere then. Returns whether anything
        has changed. Raises SceneFileError, OSError.
        """
        something = False
        for piece in sorted(self._list_unread(), key=lambda piece: _distance_to_piece(piece, eye)):
            self._read(piece)
            something = self._update_levels(eye) or something
            if changed():
                return something
        while (wanting := self._next_full_piece(eye)) is not None:
            self._read(wanting)
            something = self._update_levels(eye) or something
            if changed():
                return something
        return self._update_levels(eye) or something

    def _list_unread(self) -> list[Piece]:
        return [piece for piece in self._pieces.pieces if piece.scene_id not in self._known]

    def _next_full_piece(self, eye: Array) -> Piece | None:
        """A piece that is to be shown in full and whose Gaussians are not there."""
        levels_now = self._levels(eye)
        missing = [
            piece
            for piece in self._pieces.pieces
            if levels_now.get(piece.scene_id) == FULL and piece.scene_id not in self._full
        ]
        return min(missing, key=lambda piece: _distance_to_piece(piece, eye), default=None)

    def _levels(self, eye: Array) -> dict[str, Level]:
        order = {piece.scene_id: _distance_to_piece(piece, eye) for piece in self._pieces.pieces}
        extents = {scene_id: known.extent(eye, order[scene_id]) for scene_id, known in self._known.items()}
        return dict(zip(extents, choose_levels(list(extents.values()), self._budget), strict=True))

    def _update_levels(self, eye: Array) -> bool:
        """Forgets what is not to be there in full; whether what is shown has changed."""
        wanted = self._levels(eye)
        self._full = {scene_id: full for scene_id, full in self._full.items() if wanted.get(scene_id) == FULL}
        shown = {}
        for scene_id, level in wanted.items():
            coarse = self._known[scene_id].coarse
            if level == FULL and scene_id not in self._full:  # until it is read
                level = len(coarse) if coarse else NOTHING
            shown[scene_id] = level, 0 if level == NOTHING else self._known[scene_id].counts[level]
        before, self.shown = self.shown, shown
        return shown != before

    def _read(self, piece: Piece) -> None:
        gaussians = piece.load_gaussians()
        if not self._pieces.merged and len(self._pieces.pieces) > 1:  # the shell of one would veil the others
            gaussians = select_gaussians(gaussians, ~find_far_shell(gaussians, piece.cameras))
        self._full[piece.scene_id] = gaussians
        if piece.scene_id not in self._known:
            coarse = () if piece.scene_id == SHELL_PIECE else make_detail_levels(gaussians)
            centre = _piece_centre(piece, gaussians)
            away = np.linalg.norm(gaussians.means - centre, axis=1)
            self._known[piece.scene_id] = _PieceSummary(
                coarse=tuple(level.gaussians for level in coarse),
                counts=(len(gaussians), *(len(level.gaussians) for level in coarse)),
                sides=tuple(level.side for level in coarse),
                centre=centre,
                reach=float(np.percentile(away, _REACH)) if len(away) else 0.0,
            )


def _piece_centre(piece: Piece, gaussians: GaussianArrays) -> Array:
    """(3,) of the cameras; of the Gaussians where there are none."""
    if piece.cameras:
        return np.mean([camera.T_world_camera[:3, 3] for camera in piece.cameras], axis=0)
    return gaussians.means.mean(0, dtype=np.float64) if len(gaussians) else np.zeros(3)


def _distance_to_piece(piece: Piece, eye: Array) -> float:
    """From the eye to the nearest camera; 0 for what has none."""
    centres = [camera.T_world_camera[:3, 3] for camera in piece.cameras]
    return min((float(np.linalg.norm(eye - centre)) for centre in centres), default=0.0)
