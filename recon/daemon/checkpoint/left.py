"""Places that the camera has left, each a checkpoint of its own: left/scene-NNNN while its scene is not final yet.

What turns out to show another place than the rest becomes left/scene-NNNN-M: M is its first frame's number, from 1.
A folder counts from the moment when it has a ledger, and no longer once it has none. One whose scene is final is
finished/scene-NNNN: by what it holds a place is recognised when the camera comes back.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from splatnode.capture.process.durable import remove_leftovers, sync_folder
from splatnode.capture.process.private import make_owner_only_folder
from splatnode.recon.daemon.checkpoint.ledger import FILE as LEDGER
from splatnode.recon.daemon.checkpoint.ledger import Ledger, write_ledger

LEFT, FINISHED = "left", "finished"


def link_left_checkpoint(directory: Path, ledger: Ledger, files: Iterable[str], instead: str) -> None:
    """Links `files` of the checkpoint in `directory`, which go with `ledger`, into a folder of their own there.

    `files` are relative paths. Raises OSError, and NotPrivate, which names what to set `instead`.
    """
    _link_files(directory, directory / LEFT / ledger.scene_id, ledger, files, instead)


def link_split_checkpoint(folder: Path, ledger: Ledger, files: Iterable[str], instead: str, present: bool) -> None:
    """Links `files` of a place, in `folder`, into a folder of their own among those that were left, as `link_left_checkpoint` does.

    `present`: the place is where the camera is, else one that was left. A part that is there already, from a process
    that did not get any further, stays as it is.
    """
    target = folder / LEFT / ledger.scene_id if present else folder.with_name(ledger.scene_id)
    if not (target / LEDGER).exists():
        _link_files(folder, target, ledger, files, instead)


def _link_files(source: Path, target: Path, ledger: Ledger, files: Iterable[str], instead: str) -> None:
    remove(target)
    for each in (target.parent, target, target / "frames"):
        make_owner_only_folder(each, instead, ours=True)
    for name in files:
        os.link(source / name, target / name)
    sync_folder(target / "frames")
    write_ledger(target, ledger)


def list_left_folders(directory: Path) -> list[Path]:
    """Lists the folders of the inactive submaps, oldest first."""
    return sorted((path.parent for path in (directory / LEFT).glob(f"scene-*/{LEDGER}")), key=_parse_place_number)


def make_finished_path(directory: Path, scene_id: str) -> Path:
    """Returns the path of a finished scene's checkpoint, if there is one."""
    return directory / FINISHED / scene_id


def find_folder(directory: Path, scene_id: str) -> Path:
    """Returns the path of an inactive submap's checkpoint, finished or not, if there is one."""
    folder = make_finished_path(directory, scene_id)
    return folder if (folder / LEDGER).exists() else directory / LEFT / scene_id


def list_finished_folders(directory: Path) -> list[Path]:
    """The folders of the finished scenes, oldest first."""
    return sorted((path.parent for path in (directory / FINISHED).glob(f"scene-*/{LEDGER}")), key=_parse_place_number)


def move_to_finished(folder: Path, instead: str) -> None:
    """Takes the checkpoint of a place that was left among the finished ones.

    Raises OSError, and NotPrivate as `link_left_checkpoint`.
    """
    target = make_finished_path(folder.parent.parent, folder.name)
    make_owner_only_folder(target.parent, instead, ours=True)
    remove(target)
    folder.rename(target)
    sync_folder(target.parent)


def reopen(directory: Path, scene_id: str) -> Path | None:
    """The folder of a place that was left, taken back from the finished ones if it is there; None where there is none.

    Raises OSError.
    """
    folder, target = make_finished_path(directory, scene_id), directory / LEFT / scene_id
    if (folder / LEDGER).exists() and not (target / LEDGER).exists():
        folder.rename(target)
        sync_folder(target.parent)
    return target if (target / LEDGER).exists() else None


def remove(folder: Path) -> None:
    """Removes the checkpoint of a place that was left. What the disk keeps of it, the next start removes."""
    (folder / LEDGER).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def remove_incomplete(directory: Path, place: int) -> None:
    """Removes half-written files, and folders of places that were not left yet, `place` among them, or removed.

    A part of `place` stays: it is a place of its own from the moment when its folder has a ledger.
    """
    for folder in (directory / LEFT).glob("scene-*"):
        number, *part = _parse_place_number(folder)
        if number > place or (number == place and not part) or not (folder / LEDGER).exists():
            remove(folder)
    for folder in (*list_left_folders(directory), *list_finished_folders(directory)):
        remove_leftovers(folder)


def _parse_place_number(folder: Path) -> tuple[int, ...]:
    """The number of the place, and of the part of it; 0 for what is no number."""
    return tuple(int(each) if each.isdecimal() else 0 for each in folder.name.removeprefix("scene-").split("-"))
