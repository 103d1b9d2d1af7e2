"""Files that appear together or not at all: written under temporary names, then renamed."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import uuid
from collections.abc import Mapping
from pathlib import Path

from splatnode.capture.process.durable import sync_folder
from splatnode.capture.process.folders import made


class ResultWriteError(OSError):
    """A result could not be written; nothing that was there before has been changed. `errno` tells why."""


def write_files(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Writes `contents` (by path relative to `folder`), which are renamed in their order once all are on the disk.

    Raises ResultWriteError when one cannot be written (no space, no permission); the temporary files are gone then and
    every file that was there before is as it was.
    """
    with contextlib.ExitStack() as folders:  # those that it makes and that stay empty are removed at the end
        _write_files(folder, contents, folders)


def _write_files(folder: Path, contents: Mapping[str, bytes], folders: contextlib.ExitStack) -> None:
    mark = f".{uuid.uuid4().hex[:12]}.tmp"
    temporary: dict[Path, Path] = {}
    try:
        for name, content in contents.items():
            target = Path(os.path.realpath(folder / name))  # what a link names is written, as if it were opened
            if target.is_dir():
                raise IsADirectoryError(errno.EISDIR, f"{name} is a folder")
            if target.exists() and not target.is_file():  # root could replace /dev/null
                raise FileExistsError(errno.EEXIST, f"{name} is a device or a pipe, not a file")
            temporary[target] = target.with_name(f".{target.name}{mark}")
            folders.enter_context(made(target.parent))
            _write_through(temporary[target], content)
        for target, source in temporary.items():
            os.replace(source, target)
        for parent in {target.parent for target in temporary}:
            sync_folder(parent)
    except OSError as error:
        raise ResultWriteError(error.errno, explanation(error, folder, contents)) from error
    finally:
        for source in temporary.values():
            with contextlib.suppress(OSError):
                source.unlink(missing_ok=True)


def write_file(path: Path, content: bytes) -> None:
    """One file, whole or not at all. Raises ResultWriteError."""
    write_files(path.parent, {path.name: content})


def json_bytes(value: object) -> bytes:
    """`value` as a JSON file. Raises ValueError for NaN and infinities, which JSON does not have."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def _write_through(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def explanation(error: OSError, folder: Path, contents: Mapping[str, bytes] | None = None) -> str:
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
