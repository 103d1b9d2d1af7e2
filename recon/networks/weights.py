"""Weights of the optional networks: where they lie, how they are fetched and checked (catalogue.py lists them).

Nothing here is needed for the default reconstruction. `splatnode weights list | fetch | verify`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from splatnode.capture.process.state_directory import home
from splatnode.recon.networks.catalogue import CATALOGUE, Weights

_CHUNK = 1 << 20
_TIMEOUT_S = 20.0


class WeightsError(ValueError):
    """Weights that are not there, or not what they should be; the message says what to do."""


def folder() -> Path:
    """Where `fetch` puts weights: $SPLATNODE_WEIGHTS, else splatnode/weights among the user's data."""
    named = os.environ.get("SPLATNODE_WEIGHTS")
    if named:
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or home("SPLATNODE_WEIGHTS") / ".local" / "share"
    return Path(data) / "splatnode" / "weights"


def located(path: str) -> Path | None:
    """The file `path` in `folder()`, or beside a checkout of the project where developers keep them; else None."""
    developers = Path(__file__).resolve().parents[3] / "shared" / "weights"
    places = [folder()] if "SPLATNODE_WEIGHTS" in os.environ else [folder(), developers]
    return next((place / path for place in places if (place / path).is_file()), None)


def find(path: str) -> Path:
    """The file `path`. Raises WeightsError where it is not there."""
    found = located(path)
    if found is None:
        name = Path(path).stem
        raise WeightsError(f"no weights {path} in {folder()}: splatnode weights fetch {name}, or list for its source")
    return found


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
            goes_on = have > 0 and answer.status == 206
            length = answer.headers.get("Content-Length")
            total = (have if goes_on else 0) + int(length) if length else None
            with part.open("ab" if goes_on else "wb") as file:
                _copy(answer, file, weights.name, file.tell(), total)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # nothing is left to send: the digest decides
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
    on_terminal = sys.stderr.isatty()
    for chunk in iter(lambda: source.read(_CHUNK), b""):
        file.write(chunk)
        done += len(chunk)
        if on_terminal:
            of = f" of {total / 1e6:.1f}" if total else ""
            print(f"\r{name}: {done / 1e6:.1f}{of} MB", end="", file=sys.stderr)
    if on_terminal:
        print(file=sys.stderr)


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for chunk in iter(lambda: stream.read(_CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()


def _named(names: Sequence[str]) -> list[Weights]:
    known = {weights.name: weights for weights in CATALOGUE}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise WeightsError(f"no weights called {unknown[0]!r}; there are: {', '.join(known)}")
    return [known[name] for name in names] if names else list(CATALOGUE)


def _listed(chosen: Sequence[Weights]) -> Iterator[dict[str, object]]:
    for weights in chosen:
        where = located(weights.path)
        yield {
            "name": weights.name,
            "what": weights.what,
            "licence": weights.licence,
            "source": weights.url or None,
            "sha256": weights.sha256,
            "bytes": weights.num_bytes,
            "found": None if where is None else str(where),
        }


def command(args: argparse.Namespace) -> int:
    """`splatnode weights`: 0; 75 where something is missing or could not be had."""
    chosen = _named(args.names)
    if args.action == "list":
        for entry in _listed(chosen):
            if args.json:
                print(json.dumps(entry))
            else:
                print(f"{entry['name']}: {entry['what']}\n    {entry['licence']}; {entry['found'] or 'not here'}")
        return 0
    if args.action == "fetch" and not args.names:
        raise WeightsError(f"say which to fetch: {', '.join(weights.name for weights in CATALOGUE)}")
    failed = False
    for weights in chosen:
        try:
            if args.action == "fetch":
                print(f"{weights.name}: {weights.licence}", file=sys.stderr)
                print(fetch(weights, folder(), args.source))
            else:
                wrong = complaint(weights, find(weights.path))
                failed |= bool(wrong)
                unknown = "" if weights.sha256 else " (its publisher gives no digest: checked when loaded)"
                print(f"{weights.name}: {wrong or 'as published' + unknown}")
        except WeightsError as error:
            failed = True
            print(f"{weights.name}: {error}", file=sys.stderr)
    return 75 if failed else 0
