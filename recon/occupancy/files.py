"""The files of an occupancy map, all of them or none, each in the format of those who read it; and the verb map."""

from __future__ import annotations

import argparse
import io
import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.terminal import say, show_waiting
from splatnode.recon.occupancy import OccupancyMap, VoxelState, occupancy_map
from splatnode.recon.result.export import MAPS, OF_A_MAP, make_entries, read_digests
from splatnode.recon.result.export.staged import json_bytes, write_files
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.stored_snapshot import read_depths, read_result
from splatnode.recon.result.submap_index import is_map_set
from splatnode.recon.result.verdict import RELATIVE, Scale

# The surface of the occupied voxels, as triangles.

# A face's corners, as steps from the voxel's least corner, anticlockwise from outside; by axis, for the far side
_FAR_FACES = np.array(
    [
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
        [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    ]
)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, anticlockwise from outside, in the map's frame."""

    vertices: npt.NDArray[np.float32]  # (V, 3)
    triangles: npt.NDArray[np.uint32]  # (T, 3)


def surface_mesh(occupancy: OccupancyMap) -> Mesh:
    """The sides of occupied voxels that another state, or the map's end, lies at; what nobody saw has no surface."""
    occupied = np.pad(occupancy.states == VoxelState.OCCUPIED, 1)
    corners = [_corners(occupied, axis, sign) for axis in range(3) for sign in (-1, 1)]
    quads = np.concatenate(corners)  # (Q, 4, 3)
    numbers = np.array(occupied.shape) + 1
    flat = np.ravel_multi_index(tuple(quads.reshape(-1, 3).T), tuple(numbers)) if len(quads) else np.zeros(0, np.int64)
    used, index = np.unique(flat, return_inverse=True)
    vertices = np.stack(np.unravel_index(used, tuple(numbers)), 1) - 1  # without the padding
    first, second, third, fourth = index.reshape(-1, 4).T
    triangles = np.stack([first, second, third, first, third, fourth], 1).reshape(-1, 3)
    return Mesh(
        (occupancy.origin + vertices * occupancy.voxel).astype(np.float32),
        triangles.astype(np.uint32),
    )


def _corners(occupied: npt.NDArray[np.bool_], axis: int, sign: int) -> npt.NDArray[np.int64]:
    """(Q, 4, 3) corners of the faces on one side of the voxels."""
    voxels = np.argwhere(occupied & ~np.roll(occupied, -sign, axis))
    face = _FAR_FACES[axis]
    if sign < 0:
        face = face[::-1] * (np.arange(3) != axis)
    return voxels[:, None] + face


# collision.glb: the surface of the occupied voxels as binary glTF 2.0, for simulators and game engines.
#
# glTF's y axis is up: a node turns the map's frame, whose z is up. Lengths are in the unit of the result, which
# `extras` of `asset` states; glTF means metres, which they are only where the result is metric.

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32 = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_Z_UP = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]  # columns: x stays, y becomes -z, z becomes y


def encode_glb(mesh: Mesh, scale: Scale = RELATIVE) -> bytes:
    """The file's bytes; a scene without a mesh where there are no triangles, as glTF knows no empty ones."""
    positions, indices = mesh.vertices.astype("<f4").tobytes(), mesh.triangles.astype("<u4").tobytes()
    asset = {"version": "2.0", "generator": "splatnode", "extras": {"unit": scale.unit}}
    gltf: dict[str, object] = {"asset": asset, "scene": 0}
    if not len(mesh.triangles):
        return _file(gltf | {"scenes": [{}]}, b"")
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": len(positions), "target": _VERTICES},
        {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices), "target": _INDICES},
    ]
    least, most = (np.asarray(end, float).tolist() for end in (mesh.vertices.min(0), mesh.vertices.max(0)))
    accessors = [
        {
            "bufferView": 0,
            "componentType": _FLOAT,
            "count": len(mesh.vertices),
            "type": "VEC3",
            "min": least,
            "max": most,
        },
        {"bufferView": 1, "componentType": _UINT32, "count": mesh.triangles.size, "type": "SCALAR"},
    ]
    gltf |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": _Z_UP, "name": "occupied"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return _file(gltf, positions + indices)


def _file(gltf: dict[str, object], data: bytes) -> bytes:
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    if data:
        chunks += struct.pack("<II", len(data), _BIN) + data  # floats and 32-bit numbers: it ends on a fourth byte
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


# collision.ply: the surface of the occupied voxels as a binary PLY mesh, in the map's frame.


def encode_ply_mesh(mesh: Mesh, scale: Scale) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment splatnode: scale {scale.word}, unit {scale.unit}, frame of the map, z up\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.triangles)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.triangles), np.dtype([("count", "u1"), ("corners", "<u4", (3,))]))
    faces["count"], faces["corners"] = 3, mesh.triangles
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


# map.pgm and map.yaml: a band of heights, seen from above, as nav2's map_server and ROS 1's read it.

# What map_saver writes. 205 is not seen only with a threshold of .196; of nav2's default, .25, it would be free.
_GREY = {VoxelState.NOT_SEEN: 205, VoxelState.FREE: 254, VoxelState.OCCUPIED: 0}
_FREE_BELOW, _OCCUPIED_ABOVE = 0.196, 0.65


def encode_nav2(occupancy: OccupancyMap, band: Sequence[float], relative: bool = False) -> dict[str, bytes]:
    """map.pgm and map.yaml of the voxels that reach into the band of heights (low, high) in the map's frame.

    A cell is occupied where any of these voxels is, free where all of them are. Raises ValueError for a band that is
    none, or that the map does not reach, and, unless `relative`, for a map without metres: nav2 takes every length for
    metres.
    """
    if not (occupancy.scale.metric or relative):
        raise ValueError(
            "a map for nav2 must be in metres, which nav2 takes every length for; this result is "
            f"{occupancy.scale.sentence}. Reconstruct with something that gives metres, as --marker 100mm or --poses "
            "FILE, leave out --band for the other files, or ask for a map without a unit: --relative"
        )
    cells = project_band(occupancy, band)
    x, y = occupancy.origin[:2].tolist()
    low, high = band
    yaml = (
        f"# seen from above: heights {low:g} to {high:g}, {occupancy.scale.sentence}\n"
        f"# unit: {occupancy.scale.unit}\n"
        f"# {occupancy.upright.height}\n"
        f"# {_describe_axes(occupancy)}\n"
        "image: map.pgm\n"
        "mode: trinary\n"
        f"resolution: {occupancy.voxel!r}\n"
        f"origin: [{x!r}, {y!r}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {_OCCUPIED_ABOVE}\n"
        f"free_thresh: {_FREE_BELOW}\n"
    )
    grey = np.vectorize(_GREY.__getitem__, otypes=[np.uint8])(cells)
    rows = np.ascontiguousarray(grey.T[::-1])  # the first row is that of the largest y
    stated = f"# splatnode: unit {occupancy.scale.unit}, {occupancy.voxel!r} a pixel\n"
    header = f"P5\n{stated}{rows.shape[1]} {rows.shape[0]}\n255\n"
    return {"map.pgm": header.encode() + rows.tobytes(), "map.yaml": yaml.encode()}


def _describe_axes(occupancy: OccupancyMap) -> str:
    """Says what the origin is in."""
    if occupancy.upright.is_of_result:
        return f"x and y are of the result's frame: {occupancy.scale.frame.name.value}"
    return "x is forward of the first camera, y to its left"


def project_band(occupancy: OccupancyMap, band: Sequence[float]) -> npt.NDArray[np.uint8]:
    """(X, Y) the states of a band of heights, as `encode_nav2` has them. Raises ValueError."""
    if len(band) != 2 or not all(math.isfinite(height) for height in band) or not band[0] < band[1]:
        raise ValueError(f"a band must be two heights, the lower one first, got {list(band)}")
    bottom, voxel, layers = float(occupancy.origin[2]), occupancy.voxel, occupancy.states.shape[2]
    first, last = (round((band[0] - bottom) / voxel, 6), round((band[1] - bottom) / voxel, 6))
    if first < 0 or last > layers:
        raise ValueError(
            f"the map reaches from {bottom:.3g} to {bottom + layers * voxel:.3g}; the band {band[0]:g} to {band[1]:g} "
            "is not within"
        )
    part = occupancy.states[:, :, math.floor(first) : math.ceil(last)]
    free, occupied = (part == VoxelState.FREE).all(2), (part == VoxelState.OCCUPIED).any(2)
    return np.select([occupied, free], [VoxelState.OCCUPIED, VoxelState.FREE], VoxelState.NOT_SEEN).astype(np.uint8)


# occupancy.npz: the map as NumPy arrays, which `numpy.load(..., allow_pickle=False)` reads.

AXES = "states[i, j, k] along x, y, z of the map: x forward of the first camera, y to its left, z up"
AXES_OF_RESULT = "states[i, j, k] along x, y, z of the map: x and y of the result's frame, z up"


def encode_npz(occupancy: OccupancyMap, further: Mapping[str, npt.NDArray] | None = None) -> bytes:
    """`states` (X, Y, Z) uint8, `origin` (3,), `voxel` (), `T_world_map` (4, 4), and texts that say what they mean.

    `further` are arrays beside these.
    """
    file = io.BytesIO()
    np.savez_compressed(
        file,
        states=occupancy.states,
        origin=occupancy.origin,
        voxel=np.float64(occupancy.voxel),
        T_world_map=occupancy.T_world_map,
        axes=np.array(AXES_OF_RESULT if occupancy.upright.is_of_result else AXES),
        meaning=np.array(", ".join(f"{state.value}: {state.name.lower()}" for state in VoxelState)),
        unit=np.array(occupancy.scale.unit),
        scale=np.array(occupancy.scale.sentence),
        world=np.array(occupancy.scale.frame.sentence),
        up=np.array(occupancy.upright.source),
        height=np.array(occupancy.upright.height),
        **(further or {}),  # pyright: ignore[reportArgumentType]
    )
    return file.getvalue()


# occupancy.bt: OctoMap's binary tree (Hornung et al., OctoMap, 2013), for octomap_server, MoveIt and octovis.
#
# A text header, then every inner node from the root on, in depth-first order: two bytes with two bits for each of its
# eight children, 0 not known, 1 free, 2 occupied, 3 a node with children. Child 0 is the least along x, y and z; x
# counts 1, y 2, z 4. The tree has 16 levels; its middle is the map's origin. Eight children alike are one leaf.

LEVELS = 16
_MIDDLE = 1 << (LEVELS - 1)
_MIXED = 3
_EVERY_THIRD = np.arange(LEVELS, dtype=np.uint64)


class _Level(NamedTuple):
    """The nodes of one level in a box: `codes` (X, Y, Z) as in the file, and the number (3,) of the first of them."""

    codes: npt.NDArray[np.uint8]
    first: npt.NDArray[np.int64]


def encode_octomap(occupancy: OccupancyMap) -> bytes:
    """The file's bytes. Its frame is the map's, its unit that of the result."""
    level = _Level(occupancy.states, np.rint(occupancy.origin / occupancy.voxel).astype(np.int64) + _MIDDLE)
    words, paths, heights = [], [], []
    count = 1  # the root
    for height in range(1, LEVELS + 1):
        children, first = _children(level)
        level = _Level(_parents(children), first)
        inner = np.argwhere(level.codes == _MIXED) if height < LEVELS else np.zeros((1, 3), np.int64)
        bits = children[tuple(inner.T)].astype(np.uint32)
        words.append((bits << (2 * np.arange(8, dtype=np.uint32))).sum(1).astype("<u2"))
        paths.append(_interleave_bits(inner + first) << np.uint64(3 * height))
        heights.append(np.full(len(inner), height))
        count += int((bits > 0).sum())
    order = np.lexsort([-np.concatenate(heights), np.concatenate(paths)])
    head = f"# Octomap OcTree binary file\n# unit: {occupancy.scale.unit}\n"  # OctoMap skips further comments
    header = f"{head}id OcTree\nsize {count}\nres {occupancy.voxel!r}\ndata\n"
    return header.encode() + np.concatenate(words)[order].tobytes()


def _children(level: _Level) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """(X', Y', Z', 8) the codes of the children of each node of the next level, and the number (3,) of the first."""
    before = level.first % 2
    after = (level.first + level.codes.shape) % 2
    even = np.pad(level.codes, list(zip(before, after, strict=True)))
    x, y, z = (side // 2 for side in even.shape)
    eight = even.reshape(x, 2, y, 2, z, 2).transpose(0, 2, 4, 5, 3, 1).reshape(x, y, z, 8)
    return eight, level.first // 2


def _parents(children: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(X, Y, Z) the code of each node: that of its children where all have the same, else _MIXED."""
    first = children[..., 0]
    return np.where((children == first[..., None]).all(-1), first, np.uint8(_MIXED))


def _interleave_bits(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.uint64]:
    """(M,) the bits of numbers (M, 3) in turn, x the lowest: nodes in this order are in that of their paths."""
    bits = (numbers[:, :, None].astype(np.uint64) >> _EVERY_THIRD) & np.uint64(1)
    return (bits << (3 * _EVERY_THIRD + np.arange(3, dtype=np.uint64)[:, None])).sum((1, 2), dtype=np.uint64)


# The files of a map in a folder: all of them, or none.


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


# The verb map: a saved result as a map of free, occupied and unseen space.


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
