"""Fetches weights from their official source, and checks them against the digest that their publisher gives."""

from __future__ import annotations

import hashlib
import os
import shutil
import urllib.error
import urllib.request
from pathlib import Path
from typing import BinaryIO

from splatnode.capture.process.terminal import progress
from splatnode.recon.networks.weight_catalogue import Weights
from splatnode.recon.networks.weight_folder import WeightsError

_CHUNK = 1 << 20  # bytes that are read at once
_TIMEOUT_S = 20.0  # without an answer from the server
_PARTIAL_CONTENT, _RANGE_NOT_SATISFIABLE = 206, 416  # HTTP's status codes


def fetch(weights: Weights, to: Path, source: Path | None = None) -> Path:
    """The file in folder `to`: from the folder `source` where given, else downloaded, going on where it stopped.

    Only a file with the right digest gets its name. Raises WeightsError.
    """
    target = to / weights.path
    if target.is_file() and not complaint(weights, target):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    if source is not None:
        candidates = [source / weights.path, source / Path(weights.path).name]
        local = next((candidate for candidate in candidates if candidate.is_file()), None)
        if local is None:
            raise WeightsError(f"{source} holds no {Path(weights.path).name}: give the folder it was downloaded to")
        shutil.copyfile(local, part)
    elif weights.url:
        _download(weights, part)
    else:
        raise WeightsError(f"{weights.name} cannot be downloaded as it is: {weights.what}; then fetch --from FOLDER")
    wrong = complaint(weights, part)
    if wrong:
        part.unlink()
        raise WeightsError(f"{weights.name} from {source or weights.url}: {wrong}; nothing was kept")
    os.replace(part, target)
    return target


def complaint(weights: Weights, file: Path) -> str:
    """What is wrong with `file`; empty if it is what its publisher gave out, as far as that can be told."""
    size = file.stat().st_size
    if weights.num_bytes is not None and size != weights.num_bytes:
        return f"it has {size} bytes instead of {weights.num_bytes}"
    if weights.sha256 is not None and (digest := _sha256(file)) != weights.sha256:
        return f"its sha256 is {digest} instead of {weights.sha256}"
    return "it is empty" if size == 0 else ""


def _download(weights: Weights, part: Path) -> None:
    """Appends to `part` what it lacks."""
    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(weights.url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            goes_on = have > 0 and answer.status == _PARTIAL_CONTENT
            length = answer.headers.get("Content-Length")
            total = (have if goes_on else 0) + int(length) if length else None
            with part.open("ab" if goes_on else "wb") as file:
                _copy(answer, file, weights.name, file.tell(), total)
    except urllib.error.HTTPError as error:
        if error.code == _RANGE_NOT_SATISFIABLE and have:  # nothing is left to send: the digest decides
            return
        raise WeightsError(f"{weights.url} answered {error.code} {error.reason}; try again later") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{weights.url} could not be reached ({reason}); download it on another machine and use "
            f"splatnode weights fetch {weights.name} --from FOLDER"
        ) from error
    if total is not None and part.stat().st_size < total:
        raise WeightsError(f"{weights.url}: the connection ended early; fetch again goes on from there")


def _copy(source: BinaryIO, file: BinaryIO, name: str, done: int, total: int | None) -> None:
    for chunk in iter(lambda: source.read(_CHUNK), b""):
        file.write(chunk)
        done += len(chunk)
        of = f" of {total / 1e6:.1f}" if total else ""
        progress(f"{name}: {done / 1e6:.1f}{of} MB")
    progress("")


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for chunk in iter(lambda: stream.read(_CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()
