"""The verb map: a saved result as a map of free, occupied and unseen space."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatnode.capture.process.terminal import say, show_waiting
from splatnode.recon.occupancy.grid import occupancy_map
from splatnode.recon.result.export.result import MAPS
from splatnode.recon.result.npz_files import read_depths
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.stored_snapshot import read_result
from splatnode.recon.result.submap_index import is_map_set


def map_result(args: argparse.Namespace) -> int:
    """Says what is known and how up was found; raises NoMap, with the exit code of a refusal, where there is no map."""
    snapshot = read_to_map(args.result)
    with show_waiting("looking through the place"):
        folder = args.out or _find_maps_folder(args.result)
        made = occupancy_map(snapshot, args.voxel, None if args.up is None else np.array(args.up))
        written = made.save(folder, args.band, relative=args.relative)
    x, y, z = made.states.shape
    shares = ", ".join(f"{100 * share:.1f} % {name.replace('_', ' ')}" for name, share in made.shares.items())
    say(f"{x} x {y} x {z} voxels of {made.voxel:.3g}, {made.scale.sentence}: {shares}")
    say(f"up: {made.upright.source}; {made.upright.height}")
    if args.band is None:
        say("no map.pgm for nav2: give two heights with --band LOW HIGH")
    for path in written:
        say(path)
    return 0


def _find_maps_folder(result: Path) -> Path:
    """The folder of maps in a result. Raises ValueError for a link, which may be of whoever made the result."""
    if (folder := result / MAPS).is_symlink():
        raise ValueError(f"{folder} must be no link; remove it, or name a folder with --out")
    return folder


def read_to_map(folder: Path) -> Snapshot:
    """The result in `folder` with its confirmed depths. Raises FileNotFoundError, ValueError."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; give one that splatnode replay --out wrote")
    if is_map_set(folder):
        scenes = ", ".join(sorted(path.parent.name for path in folder.glob("*/report.json")))
        raise ValueError(f"{folder} holds several results; give one of its folders: {scenes}")
    return replace(read_result(folder)[0], depths=read_depths(folder))
