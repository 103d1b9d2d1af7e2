"""Folders of one user alone, and files in them that nobody else can have put there, whatever the umask.

What is checked is what was opened: a name may lead elsewhere a moment later, a descriptor does not. Root is trusted.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from splatnode.capture.process.logs import event
from splatnode.capture.process.printable import sanitize_text

log = logging.getLogger(__name__)

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_OTHERS, _OTHERS_WRITE = 0o077, 0o022
_NAMED = 5  # stray files


class NotOwnerOnly(PermissionError):
    """Another user could read or replace what is kept there; the text says what to do."""


class StrayFile(ValueError):
    """A file is not this user's, or is larger than any that is written there."""


def make_owner_only_folder(folder: Path, instead: str, *, ours: bool) -> None:
    """Makes `folder`, and what is missing above it, for this user alone.

    Where it is there and others may read it, it is closed to them if it is `ours` by its name, and refused if it is
    any folder that somebody named. Raises OSError, and NotPrivate, which names what to set `instead`.
    """
    with _open_folder(folder, instead) as descriptor:
        found = os.fstat(descriptor)
        if found.st_uid != os.geteuid():
            raise NotOwnerOnly(_describe_owner(folder, found, instead))
        if ours and found.st_mode & _OTHERS and not found.st_mode & stat.S_IWOTH:
            os.fchmod(descriptor, 0o700)
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
        if mode & _OTHERS:
            raise NotOwnerOnly(
                f"{_sanitize_path(folder)} must be private (mode 0700), got mode {mode:04o}. If nobody else has put anything "
                f"there, run: chmod 700 {_sanitize_path(folder)}. Or set {instead} to a folder that is not there yet"
            )


def check_way(folder: Path, instead: str = "") -> None:
    """Raises NotPrivate where another user could make the way to `folder` lead elsewhere, as sshd's StrictModes does.

    Each folder above it must be root's or this user's, and no group and nobody else may write there, unless it is
    sticky. So must each above what a link on the way leads to. What is not there yet is no hindrance. The text says
    what to run, and what to set `instead`.
    """
    _check_steps(Path.cwd() / folder, instead, is_end=True)


def check_owner_only(folder: Path) -> None:
    """Raises NotPrivate where another user could change what lies in `folder`, OSError where it is none."""
    check_way(folder)
    with _open(os.path.realpath(folder), _FOLDER) as descriptor:
        _check_owner(os.fstat(descriptor), folder)


@contextlib.contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A folder among the system's temporary ones, which is removed at the end, and which this user alone can change.

    Raises NotPrivate, OSError.
    """
    with tempfile.TemporaryDirectory(prefix=prefix) as name:
        check_way(Path(name), "$TMPDIR")
        yield Path(name)


def read_own(path: Path, most_bytes: int, *, only_ours: bool = False) -> bytes:
    """The content of a file of this user. Raises OSError, and StrayFile for what is none, or is larger.

    `only_ours`: raises NotPrivate where another user could change it.
    """
    if only_ours:
        check_way(path.parent)
    if not stat.S_ISREG(os.lstat(path).st_mode):  # before it is opened: a device may begin to work
        raise StrayFile(f"{_sanitize_path(path)} is no regular file")
    with open(os.open(path, os.O_RDONLY | _FILE), "rb", buffering=0) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode) or found.st_uid not in (0, os.geteuid()):
            raise StrayFile(f"{_sanitize_path(path)} is no file of this user")
        if found.st_size > most_bytes:
            raise StrayFile(f"{_sanitize_path(path)} has {found.st_size} bytes; at most {most_bytes} are read")
        if only_ours:
            _check_owner(found, path)
        return _read(file.fileno(), found.st_size)


def create_own(path: Path) -> int:
    """The descriptor of a new file that only this user can read. Raises OSError where anything has that name."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _FILE, 0o600)
    try:
        os.fchmod(descriptor, 0o600)  # a umask may have taken even that
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def list_own_files(folder: Path, name: re.Pattern[str], ending: str) -> list[Path]:
    """The regular files of this user in `folder` called as `name` says, in the order of the numbers they begin with.

    What else ends with `ending` (a copy, a folder, a link, a pipe) is left alone, and said.
    """
    ours, strays = [], []
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.endswith(ending):
                continue
            found = entry.stat(follow_symlinks=False)
            is_ours = stat.S_ISREG(found.st_mode) and found.st_uid in (0, os.geteuid())
            (ours if is_ours and name.fullmatch(entry.name) else strays).append(entry.name)
    if strays:
        named = ", ".join(sanitize_text(each, 100) for each in sorted(strays)[:_NAMED])
        event(log, logging.WARNING, "left_alone", folder=folder, files=len(strays), such_as=named)
    return [folder / each for each in sorted(ours, key=_number_and_name)]


def _number_and_name(name: str) -> tuple[int, str]:
    digits = re.match("[0-9]*", name)
    return int(digits[0]) if digits and digits[0] else 0, name


def _check_owner(found: os.stat_result, path: Path) -> None:
    if found.st_uid not in (0, os.geteuid()) or found.st_mode & _OTHERS_WRITE:
        raise NotOwnerOnly(
            f"{_sanitize_path(path)} can be changed by others (mode {stat.S_IMODE(found.st_mode):04o} of user {found.st_uid}). "
            f"Look what lies there, then run: chown {os.geteuid()} {_sanitize_path(path)}; chmod go-w {_sanitize_path(path)}"
        )


@contextlib.contextmanager
def _open_folder(folder: Path, instead: str) -> Iterator[int]:
    """A descriptor of the folder, which is made where it is missing."""
    check_way(folder, instead)
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    for each in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process has just made it
            _make(each)
    with _open(os.path.realpath(folder), _FOLDER) as descriptor:
        yield descriptor


def _make(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    with _open(folder, os.O_PATH | _FOLDER) as descriptor:
        if os.fstat(descriptor).st_mode & 0o700 != 0o700:  # a umask has taken the owner's own rights
            os.chmod(f"/proc/self/fd/{descriptor}", 0o700)


@contextlib.contextmanager
def _open(path: Path | str, flags: int) -> Iterator[int]:
    descriptor = os.open(path, flags)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _check_step(each: Path, instead: str, is_end: bool) -> bool:
    """Whether the way goes on behind `each`. Raises NotPrivate; what may be done with an end, its caller checks."""
    try:
        found = os.lstat(each)
    except (FileNotFoundError, NotADirectoryError):
        return False
    is_link = stat.S_ISLNK(found.st_mode)
    others_write = bool(found.st_mode & _OTHERS_WRITE) and not found.st_mode & stat.S_ISVTX
    bad_mode = others_write and not is_link and not is_end
    is_anothers = found.st_uid not in (0, os.geteuid())
    if is_anothers or bad_mode:
        shown, me, mode = _sanitize_path(each), os.geteuid(), stat.S_IMODE(found.st_mode)
        run = [f"chown {'-h ' * is_link}{me} {shown}"] * is_anothers + [f"chmod go-w {shown}"] * bad_mode
        raise NotOwnerOnly(
            f"{shown} must be of root or of user {me}, and nobody else may write there unless it is sticky as /tmp is, "
            f"but it is of user {found.st_uid} with mode {mode:04o}: look what lies there, then run: {'; '.join(run)}"
            f"{f'. Or set {instead} to a folder of your own' if instead else ''}"
        )
    if is_link and os.path.exists(each):  # and is no circle
        _check_steps(Path(os.path.realpath(each.parent), os.readlink(each)), instead, is_end)
    return True


def _check_steps(folder: Path, instead: str, is_end: bool) -> None:
    for each in (*reversed(folder.parents), folder):
        if not _check_step(each, instead, is_end and each == folder):
            return


def _describe_owner(path: Path, found: os.stat_result, instead: str) -> str:
    return (
        f"{_sanitize_path(path)} belongs to user {found.st_uid}, who could read and replace what is kept there. "
        f"Set {instead} to a folder of your own"
    )


def _read(descriptor: int, size: int) -> bytes:
    pieces = []
    while size > 0 and (piece := os.read(descriptor, min(size, 1 << 30))):
        pieces.append(piece)
        size -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def _sanitize_path(path: Path) -> str:
    return sanitize_text(path)
