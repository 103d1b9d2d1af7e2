"""collision.glb: the surface of the occupied voxels as binary glTF 2.0, for simulators and game engines.

glTF's y axis is up: a node turns the map's frame, whose z is up. Lengths are in the unit of the result, which
`extras` of `asset` states; glTF means metres, which they are only where the result is metric.
"""

from __future__ import annotations

import json
import struct

import numpy as np

from splatnode.recon.occupancy.mesh import Mesh
from splatnode.recon.result.verdict import RELATIVE, Scale

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
