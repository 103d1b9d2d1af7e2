"""The map of a whole walk against the truth: `python -m tests.bench walk_occupancy FOLDER --out walk_occupancy.json`.

FOLDER is what `python -m tests.bench building --folder FOLDER` left. The scenes of its largest map are merged, and free
space is mapped through all of them; the rows are as those of the bench `occupancy`.
"""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import msgspec

from splatnode.extras.cameras import building
from splatnode.recon.merging import Submap, write_maps
from splatnode.recon.occupancy.files import read_to_map
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import apply_thread_limit
from tests.bench.quality.occupancy import room, row


def walked(folder: Path) -> building.Config:
    """Which building, and which way through it."""
    camera = msgspec.yaml.decode((folder / "node" / "capture.yaml").read_bytes())["camera"]
    return msgspec.convert({name: value for name, value in camera.items() if name != "kind"}, building.Config)


def merged(walk: Path) -> Snapshot:
    """The largest map of the walk in a folder of results, as one scene."""
    reports = write_maps(walk, walk, _without_limit, quiet=True)
    if not reports:
        raise SystemExit(f"{walk} holds no scene that can be merged")
    snapshots = [read_to_map(walk / name) for name in reports]
    return max(snapshots, key=lambda snapshot: len(snapshot.cameras))


def _without_limit(submaps: Sequence[Submap]) -> None:
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="that the bench `building` left")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    with apply_thread_limit(1):
        snapshot = merged(args.folder / "node" / "out")
        numbers = [building.frame_index(camera.name) for camera in snapshot.cameras]
        scenes = f"building, a walk in {len(snapshot.scenes)} scenes"
        place = room(scenes, numbers, config=walked(args.folder))
        found = row(place, snapshot, range(len(numbers)), len(numbers))
    command = shlex.join(["python", "-m", "tests.bench", "walk_occupancy", args.folder.name])
    args.out.write_text(json.dumps({"command": command, "rows": [asdict(found)]}, indent=1) + "\n")
    print(json.dumps(asdict(found)))


if __name__ == "__main__":
    main()
