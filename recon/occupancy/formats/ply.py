"""collision.ply: the surface of the occupied voxels as a binary PLY mesh, in the map's frame."""

from __future__ import annotations

import numpy as np

from splatnode.recon.occupancy.mesh import Mesh
from splatnode.recon.result.verdict import Scale


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
