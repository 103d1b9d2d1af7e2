"""export_scene: a result, or a scene file, in another format."""

from __future__ import annotations

from pathlib import Path

from splatnode.recon.result.export.format import load_format
from splatnode.recon.result.export.result import write_beside
from splatnode.recon.result.export.selection import EVERYTHING, Selection
from splatnode.recon.result.export.stored import StoredResult


def export_scene(source: Path, to: str, destination: Path | None = None, selection: Selection = EVERYTHING) -> Path:
    """Writes the result folder or scene file `source` in the format `to`; returns where it is.

    `to` is a module of recon.result.export.formats, `selection` says which Gaussians are written. `destination` is a
    file, or a folder for a format of several files (colmap); without it, it is the format's own name beside the scene,
    if nothing is there yet. What lies in the folder of a result is removed with that result (`write_beside`). Cameras
    come from the cameras.json of the folder or beside the file. Raises ValueError for an unknown format, a destination
    that is taken, or a selection where the format has no Gaussians; SceneFileError for input that cannot be read as
    what it should be, or of which nothing is selected; FileNotFoundError where there is none, ResultWriteError where
    the output cannot be written.
    """
    format_ = load_format(to)
    if not selection.is_everything and not getattr(format_, "GAUSSIANS", True):
        raise ValueError(
            f"{to} holds cameras and no Gaussians: --only-seen, --no-background and --crop have nothing to leave out"
        )
    result = StoredResult.create_from_path(source, selection)
    if destination is None:
        destination = result.scene.with_name(format_.DEFAULT_NAME)
        if destination.exists():
            raise ValueError(f"{destination} is there already: give another place with --out PATH")
    content = format_.export(result)
    write_beside(destination, {"": content} if isinstance(content, bytes) else content, of=result.scene)
    return destination
