"""occupancy.bt is what OctoMap reads: checked by a decoder of its own, after OctoMap's readBinaryNode."""

from __future__ import annotations

import io

import numpy as np
import pytest

from splatnode.recon.occupancy.files import encode_octomap
from tests.support.occupied import small_map

LEVELS, MIDDLE = 16, 32768
FREE, OCCUPIED, INNER = 1, 2, 3  # two bits a child


class Tree:
    """The leaves of a file, each a box of voxels, and how many nodes there are."""

    def __init__(self, data: bytes) -> None:
        stream = io.BytesIO(data)
        assert stream.readline() == b"# Octomap OcTree binary file\n"
        rows = list(iter(lambda: stream.readline().decode().strip(), "data"))
        self.header = dict(row.partition(" ")[::2] for row in rows if not row.startswith("#"))  # as readHeader does
        self.comments = [row for row in rows if row.startswith("#")]
        self.leaves: list[tuple[tuple[int, int, int], int, int]] = []  # least key, side, state
        self.nodes = 1
        self._node(stream, (0, 0, 0), 1 << LEVELS)
        assert stream.read() == b""

    def _node(self, stream: io.BytesIO, least: tuple[int, int, int], side: int) -> None:
        low, high = stream.read(1)[0], stream.read(1)[0]
        codes = [(low >> (2 * i)) & 3 for i in range(4)] + [(high >> (2 * i)) & 3 for i in range(4)]
        self.nodes += sum(code > 0 for code in codes)
        half, inner = side // 2, []
        for child, code in enumerate(codes):
            corner = tuple(key + half * (child >> axis & 1) for axis, key in enumerate(least))
            if code == INNER:
                inner.append(corner)
            elif code:
                self.leaves.append((corner, half, code))
        for corner in inner:
            self._node(stream, corner, half)

    def states(self, first, shape) -> np.ndarray:
        """Of the voxels from number `first` on."""
        found = np.zeros(shape, np.uint8)
        for least, side, state in self.leaves:
            begin = np.array(least) - MIDDLE - first
            assert (begin >= 0).all() and (begin + side <= shape).all(), "a leaf reaches out of the map"
            found[tuple(slice(a, a + side) for a in begin)] = state
        return found


@pytest.mark.parametrize(
    ("first", "shape"), [((-3, -2, 1), (7, 5, 9)), ((0, 0, 0), (8, 8, 8)), ((-40, -1, -17), (64, 3, 31))]
)
def test_every_voxel_is_read_as_it_was(first, shape):
    states = np.random.default_rng(0).choice([0, 1, 2], p=[0.5, 0.3, 0.2], size=shape).astype(np.uint8)
    states[: shape[0] // 2] = 1  # what is alike is one leaf
    tree = Tree(encode_octomap(small_map(states, 0.05, first)))
    assert tree.header == {"id": "OcTree", "size": str(tree.nodes), "res": "0.05"}
    assert tree.comments == ["# unit: relative"]
    assert np.array_equal(tree.states(np.array(first), shape), states)


def test_alike_children_are_one_leaf():
    tree = Tree(encode_octomap(small_map(np.full((8, 8, 8), 2), 0.1, (0, 0, 0))))
    assert tree.leaves == [((MIDDLE,) * 3, 8, OCCUPIED)]


def test_a_map_of_nothing_is_a_root_without_children():
    tree = Tree(encode_octomap(small_map(np.zeros((3, 3, 3)))))
    assert tree.leaves == [] and tree.header["size"] == "1"


def test_bytes_of_a_single_voxel():
    """A free voxel at the least corner of the middle: the last child of the root, then the first child of each."""
    data = encode_octomap(small_map(np.ones((1, 1, 1)), 1.0, (0, 0, 0)))
    body = data.partition(b"data\n")[2]
    assert body == bytes([0, 0b11000000]) + bytes([0b11, 0]) * 14 + bytes([0b01, 0])
