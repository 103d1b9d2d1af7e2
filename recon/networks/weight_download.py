"""Fetches weights from their official source, and checks them against the digest that their publisher gives."""

from __future__ import annotations

import hashlib
import os
import shutil
import urllib.error
import urllib.request
from pathlib import Path
from typing import BinaryIO

from splatnode.capture.process.private import NotOwnerOnly, check_owner_only
from splatnode.capture.process.terminal import progress
from splatnode.recon.networks.weight_catalogue import Weights
from splatnode.recon.networks.weight_folder import WeightsError

_CHUNK = 1 << 20  # bytes that are read at once
_TIMEOUT_S = 20.0  # without an answer from the server
_PARTIAL_CONTENT = 206  # HTTP's status code
_ADD = os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW
_ANEW = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW


def fetch(weights: Weights, to: Path, source: Path | None = None) -> Path:
    """The file in folder `to`: from the folder `source` where given, else downloaded, going on where it stopped.

    Only a file with the right digest gets its name. One of which no digest is known is not downloaded: whoever has it
    from its publisher can give it by `source`. Raises WeightsError, and OSError where the disk does not take it.
    """
    target = to / weights.path
    if target.is_file() and not find_mismatch(weights, target):
        return target
    _make(target.parent, to)
    part = target.with_name(f"{target.name}.part")
    if source is not None:
        candidates = [source / weights.path, source / Path(weights.path).name]
        local = next((candidate for candidate in candidates if candidate.is_file()), None)
        if local is None:
            raise WeightsError(f"{source} holds no {Path(weights.path).name}: give the folder it was downloaded to")
        if wrong := find_mismatch(weights, local):
            raise WeightsError(f"{weights.name} from {local}: {wrong}; nothing was kept")
        part.unlink(missing_ok=True)
        shutil.copyfile(local, part)
    elif not weights.url:
        raise WeightsError(f"{weights.name} cannot be downloaded as it is: {weights.what}; then fetch --from FOLDER")
    elif weights.sha256 is None or weights.num_bytes is None:
        raise WeightsError(
            f"{weights.name} is not downloaded, because its publisher gives no digest to check it against: get it from "
            f"{weights.url} and use splatnode weights fetch {weights.name} --from FOLDER"
        )
    else:
        _download(weights, part, weights.num_bytes)
    wrong = find_mismatch(weights, part)
    if wrong:
        part.unlink()
        raise WeightsError(f"{weights.name} from {source or weights.url}: {wrong}; nothing was kept")
    os.replace(part, target)
    return target


def find_mismatch(weights: Weights, file: Path) -> str:
    """Returns what is wrong with `file`; empty if it is what its publisher gave out, as far as that can be told."""
    size = file.stat().st_size
    if weights.num_bytes is not None and size != weights.num_bytes:
        return f"it has {size} bytes instead of {weights.num_bytes}"
    if weights.sha256 is not None and (digest := _sha256(file)) != weights.sha256:
        return f"its sha256 is {digest} instead of {weights.sha256}"
    return "it is empty" if size == 0 else ""


def _make(folder: Path, top: Path) -> None:
    """The folder in `top`. Raises WeightsError where another user could change what lies in it."""
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    try:
        for each in (top, folder):
            check_owner_only(each)
    except NotOwnerOnly as error:
        raise WeightsError(f"{error}. Or set $SPLATNODE_WEIGHTS to another folder") from error


def _download(weights: Weights, part: Path, num_bytes: int) -> None:
    """Appends to `part` what it lacks, and no more than that."""
    have = _partial_size(part, num_bytes)
    if have == num_bytes:  # the digest decides
        return
    request = urllib.request.Request(weights.url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            goes_on = have > 0 and answer.status == _PARTIAL_CONTENT
            length = answer.headers.get("Content-Length")
            done = have if goes_on else 0
            if length is not None and length.isdecimal() and int(length) > num_bytes - done:
                raise WeightsError(_reject_oversized(weights, part, num_bytes))
            with open(os.open(part, _ADD if goes_on else _ANEW, 0o644), "ab") as file:
                fits = _copy(answer, file, weights.name, done, num_bytes)
    except urllib.error.HTTPError as error:
        raise WeightsError(f"{weights.url} answered {error.code} {error.reason}; try again later") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{weights.url} could not be reached ({reason}); download it on another machine and use "
            f"splatnode weights fetch {weights.name} --from FOLDER"
        ) from error
    if not fits:
        raise WeightsError(_reject_oversized(weights, part, num_bytes))
    if part.stat().st_size < num_bytes:
        raise WeightsError(f"{weights.url}: the connection ended early; fetch again goes on from there")


def _partial_size(part: Path, num_bytes: int) -> int:
    """Bytes of what an earlier download left, which is removed where it cannot be a part of the file."""
    if not os.path.lexists(part):
        return 0
    if part.is_file() and not part.is_symlink() and part.stat().st_size <= num_bytes:
        return part.stat().st_size
    part.unlink()
    return 0


def _reject_oversized(weights: Weights, part: Path, num_bytes: int) -> str:
    """Removes the partial file, and says that the source sends too much."""
    part.unlink(missing_ok=True)
    return f"{weights.url} sends more than the {num_bytes} bytes of {weights.name}; nothing was kept"


def _copy(source: BinaryIO, file: BinaryIO, name: str, done: int, num_bytes: int) -> bool:
    """Copies until the end; returns False, and writes no more, where the source sends more than `num_bytes`."""
    while chunk := source.read(min(_CHUNK, num_bytes - done + 1)):
        done += len(chunk)
        if done > num_bytes:
            return False
        file.write(chunk)
        progress(f"{name}: {done / 1e6:.1f} of {num_bytes / 1e6:.1f} MB")
    progress("")
    return True


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for chunk in iter(lambda: stream.read(_CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()
