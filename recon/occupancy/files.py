"""The files of a map in a folder: all of them, or none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatnode.recon.occupancy.formats.glb import encode_glb
from splatnode.recon.occupancy.formats.nav2 import encode_nav2
from splatnode.recon.occupancy.formats.npz import encode_npz
from splatnode.recon.occupancy.formats.octomap import encode_octomap
from splatnode.recon.occupancy.formats.ply import encode_ply_mesh
from splatnode.recon.occupancy.grid import OccupancyMap
from splatnode.recon.occupancy.mesh import surface_mesh
from splatnode.recon.result.export.result import OF_A_MAP, make_entries, read_digests
from splatnode.recon.result.export.staged import json_bytes, write_files


def save(occupancy: OccupancyMap, folder: Path, band: Sequence[float] | None, relative: bool = False) -> list[Path]:
    """As `OccupancyMap.save`. What an earlier map in the folder had, and this one has not, is removed."""
    mesh = surface_mesh(occupancy)
    files = {
        "occupancy.npz": encode_npz(occupancy),
        "occupancy.bt": encode_octomap(occupancy),
        "collision.ply": encode_ply_mesh(mesh, occupancy.scale),
        "collision.glb": encode_glb(mesh, occupancy.scale),
        **({} if band is None else encode_nav2(occupancy, band, relative)),
    }
    superseded = {name: digest for name, digest in read_digests(folder / OF_A_MAP).items() if name not in files}
    manifest = {**occupancy.scale.record(), "files": make_entries(files)}
    write_files(folder, files | {OF_A_MAP: json_bytes(manifest)}, superseded)
    return [folder / name for name in files]
