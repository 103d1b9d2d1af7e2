"""The collision mesh: closed, turned outwards, and read from its files as it was."""

from __future__ import annotations

import json
import struct
from collections import Counter

import numpy as np
import pytest

from splatnode.recon.occupancy.files import Mesh, encode_glb, encode_ply_mesh, surface_mesh
from splatnode.recon.result.verdict import RELATIVE
from tests.support.occupied import small_map


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    states = np.zeros((4, 4, 4), np.uint8)
    states[1:3, 1, 1] = states[1, 1, 2] = 2  # an L of three voxels
    states[0, 0, 0] = 1
    return surface_mesh(small_map(states))


def test_it_is_closed_and_encloses_the_voxels(mesh):
    edges = Counter(
        (int(a), int(b)) for triangle in mesh.triangles for a, b in zip(triangle, np.roll(triangle, -1), strict=True)
    )
    assert all(edges[b, a] == count for (a, b), count in edges.items())
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2).astype(float)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(3 * 0.25**3)
    assert np.allclose(mesh.vertices.min(0), [-0.5, -0.25, 0.5]) and np.allclose(mesh.vertices.max(0), [0, 0, 1.0])
    assert len(mesh.triangles) == 28


def test_ply_is_read_as_it_was(mesh):
    header, _, body = encode_ply_mesh(mesh, RELATIVE).partition(b"end_header\n")
    assert f"element vertex {len(mesh.vertices)}\n".encode() in header and b"scale relative" in header
    end = 12 * len(mesh.vertices)
    assert np.array_equal(np.frombuffer(body[:end], "<f4").reshape(-1, 3), mesh.vertices)
    faces = [struct.unpack_from("<B3I", body, end + 13 * i) for i in range(len(mesh.triangles))]
    assert [face[1:] for face in faces] == [tuple(each) for each in mesh.triangles.tolist()]
    assert {face[0] for face in faces} == {3} and len(body) == end + 13 * len(faces)


def test_glb_is_read_as_it_was_and_y_is_up(mesh):
    data = encode_glb(mesh)
    magic, version, size, length, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), 0x4E4F534A) and length % 4 == 0
    gltf = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]
    assert struct.unpack_from("<II", data, 20 + length) == (gltf["buffers"][0]["byteLength"], 0x004E4942)
    views = [binary[view["byteOffset"] :][: view["byteLength"]] for view in gltf["bufferViews"]]
    positions = np.frombuffer(views[0], "<f4").reshape(-1, 3)
    assert np.array_equal(positions, mesh.vertices) and gltf["accessors"][0]["count"] == len(positions)
    assert np.array_equal(np.frombuffer(views[1], "<u4").reshape(-1, 3), mesh.triangles)
    assert gltf["accessors"][0]["min"] == positions.min(0).tolist()
    matrix = np.array(gltf["nodes"][0]["matrix"]).reshape(4, 4).T  # glTF writes columns
    assert np.array_equal(matrix @ [1, 2, 3, 1], [1, 3, -2, 1])


def test_of_nothing_there_are_files_without_triangles():
    nothing = surface_mesh(small_map(np.ones((2, 2, 2))))
    assert len(nothing.triangles) == 0 and b"element face 0" in encode_ply_mesh(nothing, RELATIVE)
    assert "meshes" not in json.loads(encode_glb(nothing)[20:])
