"""Files that appear together or not at all: written under temporary names, then renamed.

What several files take to become one result is written down before the first is renamed: a process that is killed
between two renames, or whose disk fails there, leaves a note beside them, from which `finish_interrupted_write`
finishes the work.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import itertools
import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import LockHeld, claim_folder, make_folder, shortage, sync_folder
from splatnode.capture.process.system import raise_shortage

_MARK = "[0-9a-f]{12}"
_TEMPORARY, _NOTE = re.compile(rf"\..+\.{_MARK}\.tmp"), re.compile(rf"\.{_MARK}\.renaming")
_LARGEST_NOTE = 1 << 20


class ResultWriteError(OSError):
    """A result could not be written; nothing that was there before has been changed. `errno` tells why.

    But where a disk takes all files and then refuses to rename one of them, the text says that what was begun will be
    finished.
    """


class _Note(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The steps that remain in a folder once all new files are on the disk, in this order."""

    files: list[str]  # that are renamed to these names
    superseded: dict[str, str]  # files that are removed, by their SHA-256: one that changed meanwhile is its owner's


@dataclass(frozen=True)
class _StagedFile:
    """A file on its way: on the disk under a temporary name, which is locked as long as its writer lives."""

    name: str
    target: Path
    temporary: Path
    linked: bool  # whether `target` is elsewhere than its name says


_Place = Callable[[str, str], _StagedFile]  # of a name, and of the mark of what is being written


def write_files(folder: Path, contents: Mapping[str, bytes], superseded: Mapping[str, str] | None = None) -> None:
    """Writes `contents` (by path relative to `folder`), which are renamed in their order once all are on the disk.

    Whoever made `folder` may have put a link there, to a file that is none of his: a file takes the place of a link,
    and nothing is written into a folder that is reached by one.
    Files of `superseded` (SHA-256 by path) are removed then, if they are unchanged and inside `folder`. Raises
    ResultWriteError when one cannot be written (no space, no permission); the temporary files are gone then and every
    file that was there before is as it was.
    """
    _write(folder, contents, superseded or {}, partial(_stage_file, folder))


def write_file(path: Path, content: bytes) -> None:
    """One file that the user named, whole or not at all; a link of that name is followed. Raises ResultWriteError."""
    _write(path.parent, {path.name: content}, {}, partial(_follow_link, path.parent))


def _write(folder: Path, contents: Mapping[str, bytes], superseded: Mapping[str, str], place: _Place) -> None:
    with contextlib.ExitStack() as resources:  # folders that it makes and that stay empty are removed at the end
        try:
            finish_interrupted_write(folder, {(folder / name).parent for name in contents})
            _write_files(folder, contents, superseded, place, resources)
        except ResultWriteError:
            raise
        except OSError as error:
            raise ResultWriteError(error.errno, explain_error(error, folder, contents)) from error


def finish_interrupted_write(folder: Path, parents: Iterable[Path] = ()) -> None:
    """Finishes what a killed process had begun in `folder`: the result is the new one then, or the one before.

    Temporary files in it and in `parents` are removed; what a living process writes is left alone. Raises OSError.
    """
    for path in _list_entries(folder, _NOTE):
        with _hold_file(path) as free:
            if free:
                _complete_note(path)
    for path in (path for each in {folder, *parents} for path in _list_entries(each, _TEMPORARY)):
        with contextlib.suppress(OSError), _hold_file(path) as free:  # another user's is none of ours
            if free:
                path.unlink(missing_ok=True)


def json_bytes(value: object) -> bytes:
    """`value` as a JSON file. Raises ValueError for NaN and infinities, which JSON does not have."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def explain_error(error: OSError, folder: Path, contents: Mapping[str, bytes] | None = None) -> str:
    """Why `contents` could not be written into `folder`, and what to do."""
    contents = contents or {}
    megabytes = sum(map(len, contents.values())) / 1e6
    advice = {
        errno.ENOSPC: "Free some space or choose another folder",
        errno.EDQUOT: "The quota is used up: free some space or choose another folder",
        errno.EACCES: "Choose a folder that you may write to",
        errno.EROFS: "The file system is read-only: choose another folder",
        errno.ENOTDIR: "A file stands where the folder should be: choose another folder",
    }.get(error.errno or 0, "Choose another folder")
    what = f" {len(contents)} files ({megabytes:.1f} MB)" if len(contents) > 1 else ""
    return f"cannot write{what} to {folder}: {error.strerror or error}. {advice}"


def _write_files(
    folder: Path,
    contents: Mapping[str, bytes],
    superseded: Mapping[str, str],
    place: _Place,
    resources: contextlib.ExitStack,
) -> None:
    mark = uuid.uuid4().hex[:12]
    note, noted = folder / f".{mark}.renaming", len(contents) + len(superseded) > 1
    staged = [place(name, mark) for name in contents]
    temporary = [each.temporary for each in staged]
    try:
        for each, content in zip(staged, contents.values(), strict=True):
            resources.enter_context(make_folder(each.target.parent))
            _write_through(each.temporary, content, resources)
        if noted:
            temporary += [_make_temporary_path(note, mark), note]
            here = [each.name for each in staged if not each.linked]
            _write_through(
                _make_temporary_path(note, mark), msgspec.json.encode(_Note(here, dict(superseded))), resources
            )
            _sync_parents(staged)
            os.replace(_make_temporary_path(note, mark), note)
            sync_folder(folder)
            temporary = []
        try:
            _finish(folder, staged, superseded)
            note.unlink(missing_ok=True)
        except OSError as error:
            if noted:
                raise ResultWriteError(error.errno, _explain_unfinished(error, folder)) from error
            raise
    finally:
        for leftover in temporary:
            with contextlib.suppress(OSError):
                leftover.unlink(missing_ok=True)


def _explain_unfinished(error: OSError, folder: Path) -> str:
    why = error.strerror or error
    return f"cannot rename all files in {folder}: {why}. Run the command again: what writes there next finishes it"


def _stage_file(folder: Path, name: str, mark: str) -> _StagedFile:
    """Returns the place that `name` says, whatever link is there."""
    if not _is_inside(folder, name):
        raise OSError(errno.ELOOP, f"{name} would be reached by a link, or lie outside; remove the link")
    target = Path(os.path.realpath((folder / name).parent), os.path.basename(name))
    if not target.is_symlink():
        _check_replaceable(target, name)
    return _StagedFile(name, target, _make_temporary_path(target, mark), linked=False)


def _follow_link(folder: Path, name: str, mark: str) -> _StagedFile:
    """Returns the place that `name` leads to, as if it were opened."""
    target = Path(os.path.realpath(folder / name))
    _check_replaceable(target, name)
    return _StagedFile(
        name, target, _make_temporary_path(target, mark), linked=target != Path(os.path.realpath(folder), name)
    )


def _check_replaceable(target: Path, name: str) -> None:
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, f"{name} is a folder")
    if target.exists() and not target.is_file():  # root could replace /dev/null
        raise FileExistsError(errno.EEXIST, f"{name} is a device or a pipe, not a file")


def _make_temporary_path(target: Path, mark: str) -> Path:
    return target.with_name(f".{target.name}.{mark}.tmp")


def _write_through(path: Path, content: bytes, resources: contextlib.ExitStack) -> None:
    """Leaves the file open and locked, which tells others that its writer lives."""
    file = resources.enter_context(path.open("xb", buffering=0))
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())


def _finish(folder: Path, staged: list[_StagedFile], superseded: Mapping[str, str]) -> None:
    for each in staged:
        os.replace(each.temporary, each.target)
    _sync_parents(staged)
    for name, digest in superseded.items():
        _remove(folder, name, digest)


def _sync_parents(staged: list[_StagedFile]) -> None:
    for parent in {each.target.parent for each in staged}:
        sync_folder(parent)


def _complete_note(path: Path) -> None:
    """Does what is left to do of a note. It says nothing of files outside its folder: it may be a stranger's."""
    folder, mark, note = path.parent, path.name.split(".")[1], _read_note(path)
    for name in filter(lambda name: _is_inside(folder, name), note.files):
        with contextlib.suppress(FileNotFoundError):  # it has its name already
            os.replace(_make_temporary_path(folder / name, mark), folder / name)
            sync_folder((folder / name).parent)
    for name, digest in note.superseded.items():
        _remove(folder, name, digest)
    path.unlink(missing_ok=True)


def _remove(folder: Path, name: str, digest: str) -> None:
    path = folder / name
    if not _is_inside(folder, name) or path.is_symlink() or not path.is_file():
        return
    if hashlib.sha256(path.read_bytes()).hexdigest() == digest:
        path.unlink()
        with contextlib.suppress(OSError):  # others' files may be beside it
            for parent in itertools.takewhile(lambda parent: parent != folder, path.parents):
                parent.rmdir()


def _is_inside(folder: Path, name: str) -> bool:
    """Whether `name` is that of a file in `folder` or in a folder in it, by no link."""
    parent = os.path.dirname(os.path.normpath(name))
    outside = os.path.isabs(name) or parent.startswith("..") or os.path.basename(name) in ("", ".", "..")
    return not outside and os.path.realpath(folder / parent) == os.path.normpath(
        os.path.realpath(folder) + "/" + parent
    )


def _read_note(path: Path) -> _Note:
    """An empty one where it cannot be read: no process leaves half a note."""
    with path.open("rb") as file:
        try:
            return record_in(file.read(_LARGEST_NOTE), _Note)
        except msgspec.DecodeError:
            return _Note([], {})


@contextlib.contextmanager
def _hold_file(path: Path) -> Iterator[bool]:
    """Holds a file that no living process holds; False where one does, or where the file has gone."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        yield False
        return
    try:
        yield _try_lock(descriptor)
    finally:
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _list_entries(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """The folder's entries with such names; none where there is no such folder or it cannot be listed.

    Raises what is_shortage tells.
    """
    try:
        return [folder / name for name in os.listdir(folder) if pattern.fullmatch(name)]
    except OSError as error:
        raise_shortage(error)
        return []


# The folder that results are written into: one process at a time, checked before the work, not left behind empty.


class FolderInUse(LockHeld):
    """Another process writes results into this folder."""

    def __init__(self, folder: Path, pid: int | None) -> None:
        who = f"process {pid}" if pid else "another process"
        super().__init__(f"{who} writes its results into {folder} already; stop it, or give another --out", pid)


@contextlib.contextmanager
def hold_result_folder(out: Path, needed_bytes: int = 0) -> Iterator[None]:
    """Holds the folder `out` for this process. Folders that it made and that are empty are removed at the end.

    Raises ResultWriteError where nothing can be written into it or fewer than `needed_bytes` are free, and FolderInUse
    where another process holds it: all before the work and not after it. What a killed process had begun is finished.
    """
    with contextlib.ExitStack() as resources:
        try:
            resources.enter_context(claim_folder(out))
            finish_interrupted_write(out, (path for path in out.iterdir() if path.is_dir() and not path.is_symlink()))
            why = shortage(out, needed_bytes, "the result")
        except LockHeld as error:
            raise FolderInUse(out, error.pid) from error
        except OSError as error:
            raise ResultWriteError(error.errno, explain_error(error, out)) from error
        if why:
            raise ResultWriteError(errno.ENOSPC, f"{why}. Free some space or choose another folder")
        yield
