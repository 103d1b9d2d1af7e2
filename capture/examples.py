"""The configurations that come with the package, with systemd's units and udev's rule: listed, or written to a folder.

In a checkout they lie in configs/. The first line of each is a comment that says what it is for.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import shutil
import uuid
from importlib import resources
from pathlib import Path

from splatnode.capture.process.durable import sync_folder
from splatnode.capture.process.folders import make_folder
from splatnode.capture.process.printable import sanitize_text
from splatnode.capture.process.terminal import say

_PATTERNS = ("*.yaml", "systemd/*.service", "udev/*.rules")
_IS_THERE = {errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR, errno.EBUSY, errno.EINVAL}


def config(args: argparse.Namespace) -> int:
    """Lists the configurations, or with `--write` writes them into a new folder."""
    contents = examples()
    if args.write is None:
        longest = max(map(len, contents))
        for name, content in contents.items():
            say(f"{name:{longest}}  {content.decode().splitlines()[0].lstrip('# ')}")
        say("Write them into a new folder: splatnode config --write configs")
        return 0
    write(args.write, contents)
    for name in contents:
        say(str(args.write / name))
    return 0


def examples() -> dict[str, bytes]:
    """The content of each file, by its name in the folder."""
    with resources.as_file(resources.files("splatnode") / "configs") as folder:
        paths = [path for pattern in _PATTERNS for path in sorted(folder.glob(pattern))]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def write(folder: Path, contents: dict[str, bytes]) -> None:
    """Makes `folder` with all files in it, or leaves nothing.

    Raises ValueError where there is something already, which stays as it is, and OSError. A process that is killed may
    leave its unfinished folder, `.NAME.*.tmp`, beside it.
    """
    staged = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.tmp") if folder.name else folder
    try:
        with make_folder(folder.parent), contextlib.ExitStack() as failing:
            staged.mkdir()
            failing.callback(shutil.rmtree, staged, ignore_errors=True)
            for name, content in contents.items():
                _write(staged / name, content)
            os.rename(staged, folder)  # takes the place of an empty folder, and of nothing else
            failing.pop_all()
            sync_folder(folder.parent)
    except OSError as error:
        if error.errno in _IS_THERE and os.path.lexists(folder):
            raise ValueError(
                f"{sanitize_text(folder)} is there already, and nothing was written. Name a folder that is new or empty"
            ) from error
        raise OSError(error.errno, error.strerror, str(folder)) from error


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    sync_folder(path.parent)
