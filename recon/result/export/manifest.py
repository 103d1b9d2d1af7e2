"""The list of the files that were written together, by which they are known again and removed together."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import msgspec

from splatnode.capture.process.foreign import guard_untrusted
from splatnode.capture.process.memory_shortage import raise_shortage
from splatnode.capture.process.printable import is_printable
from splatnode.capture.process.records import record_in
from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.limits import read_json_file

MANIFEST = "manifest.json"  # of a result
EXPORTS = "exports.json"  # of what was made of a result afterwards and put into its folder: exports, pictures
OF_A_MAP = "map.json"  # of a map of free space
MAPS = "occupancy"  # the folder in a result's own that its map is in, where nobody names another


LIVE_PICTURE = "live.png"  # which a viewer without a window keeps up to date while a scene is made


class _Entry(msgspec.Struct, frozen=True):
    sha256: str


class _Manifest(msgspec.Struct, frozen=True):
    files: dict[str, _Entry]


def make_entries(files: Mapping[str, bytes]) -> dict[str, dict[str, object]]:
    """Makes the manifest's entry for each of the files."""
    return {name: {"bytes": len(data), "sha256": sha256(data)} for name, data in files.items()}


def read_digests(path: Path) -> dict[str, str]:
    """SHA-256 by file of what the manifest `path` lists; empty where there is none that can be read.

    Raises what is_shortage tells.
    """
    try:
        with guard_untrusted(SceneFileError):
            manifest = record_in(read_json_file(path), _Manifest)
    except (OSError, SceneFileError) as error:
        raise_shortage(error)
        return {}
    return {name: entry.sha256 for name, entry in manifest.files.items() if is_printable(name)}


def read_derived_digests(folder: Path) -> dict[str, str]:
    """SHA-256 by file of what was made of the result in `folder`, and of the manifests: maps, exports and pictures."""
    found = {}
    for manifest in (OF_A_MAP, f"{MAPS}/{OF_A_MAP}", EXPORTS):
        within = manifest.removesuffix(OF_A_MAP).removesuffix(EXPORTS)
        listed = {f"{within}{name}": digest for name, digest in read_digests(folder / manifest).items()}
        try:
            listed |= {manifest: sha256((folder / manifest).read_bytes())} if listed else {}
        except OSError as error:
            raise_shortage(error)
        found |= listed
    return found


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
