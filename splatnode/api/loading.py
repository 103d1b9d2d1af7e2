"""A result that was written, read again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from splatnode.api.result import Result, result_of
from splatnode.recon.result.depth_file import read_depths
from splatnode.recon.result.export.result import copy_result
from splatnode.recon.result.landmarks_file import LANDMARKS, read_landmarks
from splatnode.recon.result.stored_snapshot import read_result
from splatnode.recon.result.whole import is_map_set


@dataclass(frozen=True)
class StoredFiles:
    """The files of a result, where they were read."""

    folder: Path

    def write(self, out: Path) -> None:
        copy_result(self.folder, out)


def load(folder: str | PathLike[str]) -> Result:
    """The result in a folder that `Result.save`, `splatnode replay` or a node wrote; a refusal, too.

    Which lenses were given is not in the files. Saving it again copies the files. Raises FileNotFoundError where there
    is no result, ValueError where the files are something else or damaged.
    """
    place = Path(folder)
    if not place.is_dir():
        raise FileNotFoundError(f"{place} is no folder; give one that Result.save or splatnode replay --out wrote")
    if is_map_set(place):
        scenes = ", ".join(sorted(path.parent.name for path in place.glob("*/report.json")))
        raise ValueError(f"{place} holds several results; give one of its folders: {scenes}")
    snapshot = read_result(place)[0]
    if (place / LANDMARKS).exists():
        snapshot = replace(snapshot, landmarks=read_landmarks(place))
    snapshot = replace(snapshot, depths=read_depths(place))
    return result_of(snapshot, StoredFiles(place.resolve()))
