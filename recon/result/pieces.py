"""The pieces of a map: what is read scene by scene, so that a part of a map can be looked at without the rest of it.

Where the map was merged (`splatnode merge`), a piece is what the merged scene kept of a submap, beside the one of all
far shells. Where it was not, or where scenes came since, a piece is the scene itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.result.export.cameras import decode_cameras
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.limits import read_json_file
from splatnode.recon.result.export.stored import read_cameras, read_gaussians
from splatnode.recon.result.placement import IDENTITY, Placement
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays
from splatnode.recon.result.whole import JoinedMap, MapSet, SubmapEntry

SHELL_PIECE = "far-shell"


@dataclass(frozen=True, eq=False)
class Piece:
    """A file with Gaussians, and how they lie in the map."""

    scene_id: str  # SHELL_PIECE: of no scene
    path: Path
    placement: Placement
    cameras: tuple[CameraEstimate, ...]  # of its scene, in the map's world

    def load_gaussians(self) -> GaussianArrays:
        """In the map's world and unit. Raises SceneFileError, which names the file, and OSError."""
        try:
            return self.placement.transform_gaussians(read_gaussians(self.path))
        except SceneFileError as error:
            raise SceneFileError(f"{self.path.parent}: {error}") from error


@dataclass(frozen=True, eq=False)
class Pieces:
    """All of a map."""

    pieces: tuple[Piece, ...]
    merged: bool  # whether they are what merging kept

    @property
    def cameras(self) -> tuple[CameraEstimate, ...]:
        """One camera for each image, in the order of the scenes."""
        found: dict[str, CameraEstimate] = {}
        for camera in (camera for piece in self.pieces for camera in piece.cameras):
            found.setdefault(camera.name, camera)
        return tuple(found.values())


def make_merged_path(out: Path, of: JoinedMap) -> Path:
    """Returns the path of a map's merged result."""
    return out / f"map-{of.name}"


def make_piece_name(scene_id: str) -> str:
    """The name, in a merged result, of the file with what was kept of a scene."""
    return f"pieces/{scene_id}.ply"


def find_pieces(whole: MapSet, of: JoinedMap, out: Path) -> Pieces:
    """The pieces of a map whose merged result may be in `out`. Raises SceneFileError, OSError."""
    shown = {name: placement for name, placement in of.placements.items() if has_scene(whole.places[name])}
    folder = make_merged_path(out, of)
    if shown and (folder / make_piece_name(SHELL_PIECE)).is_file() and all(_is_merged(whole, n, folder) for n in shown):
        cameras = {each.name: each for each in decode_cameras(read_json_file(folder / "cameras.json"), str(folder))}
        used = {name: whole.places[name].frames_used for name in shown}
        known = {name: tuple(cameras[each] for each in names if each in cameras) for name, names in used.items()}
        pieces = [Piece(name, folder / make_piece_name(name), IDENTITY, known[name]) for name in shown]
        return Pieces((*pieces, Piece(SHELL_PIECE, folder / make_piece_name(SHELL_PIECE), IDENTITY, ())), merged=True)
    return Pieces(tuple(_make_scene_pieces(whole, shown)), merged=False)


def _is_merged(whole: MapSet, scene_id: str, folder: Path) -> bool:
    """Whether a merged result has the scene as it is now."""
    piece, scene = folder / make_piece_name(scene_id), whole.places[scene_id].folder
    return piece.is_file() and (scene is None or (scene / "scene.ply").stat().st_mtime <= piece.stat().st_mtime)


def has_scene(place: SubmapEntry) -> bool:
    """Whether the place has a result that may be shown."""
    return place.folder is not None and place.publishable and (place.folder / "scene.ply").is_file()


def _make_scene_pieces(whole: MapSet, placements: Mapping[str, Placement]) -> list[Piece]:
    found = []
    for scene_id, placement in placements.items():
        folder = whole.places[scene_id].folder
        assert folder is not None  # `has_scene` has seen to it
        cameras = tuple(placement.transform_camera(camera) for camera in read_cameras(folder / "cameras.json"))
        found.append(Piece(scene_id, folder / "scene.ply", placement, cameras))
    return found
