"""map.pgm and map.yaml say what map_server reads of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from splatnode.recon.occupancy.files import encode_nav2
from splatnode.recon.result.verdict import Scale
from tests.support.occupied import small_map


def read_as_map_server(files: dict[str, bytes]) -> tuple[np.ndarray, dict]:
    """(H, W) -1 not seen, 0 free, 100 occupied, the first row that of the least y: nav2_map_server's trinary mode."""
    told = yaml.safe_load(files["map.yaml"])
    magic, comment, size, most, pixels = files[told["image"]].split(b"\n", 4)
    assert comment.startswith(b"# splatnode: unit ")  # as map_saver's, which map_server skips
    width, height = map(int, size.split())
    assert (magic, most, len(pixels)) == (b"P5", b"255", width * height) and told["mode"] == "trinary"
    grey = np.frombuffer(pixels, np.uint8).reshape(height, width)[::-1]
    occupancy = (grey if told["negate"] else 255.0 - grey) / 255.0
    found = np.full(grey.shape, -1)
    found[occupancy > told["occupied_thresh"]] = 100
    found[occupancy < told["free_thresh"]] = 0
    return found, told


def test_a_cell_is_free_where_the_whole_band_is():
    states = np.ones((3, 2, 4), np.uint8)  # voxels of .25 from z = .25 on
    states[0, 0, 1] = 2  # occupied in the band
    states[1, 1, 2] = 0  # not seen in the band
    states[2, 0, 0] = states[2, 0, 3] = 2  # below and above it
    cells, told = read_as_map_server(encode_nav2(small_map(states), (0.5, 1.0), relative=True))
    assert cells.tolist() == [[100, 0, 0], [0, -1, 0]]  # rows by y, columns by x
    assert told["resolution"] == 0.25 and told["origin"] == [-0.75, -0.5, 0.0]


def test_a_band_takes_the_voxels_that_it_cuts():
    states = np.ones((1, 1, 4), np.uint8)
    states[0, 0, 3] = 2
    assert read_as_map_server(encode_nav2(small_map(states), (0.5, 1.01), relative=True))[0].tolist() == [[100]]
    assert read_as_map_server(encode_nav2(small_map(states), (0.3, 1.0), relative=True))[0].tolist() == [[0]]


@pytest.mark.parametrize(
    ("band", "said"),
    [((1.0, 0.5), "lower one first"), ((0.5, float("nan")), "two heights"), ((0.0, 1.0), "the map reaches from 0.25")],
)
def test_what_is_no_band_is_told(band, said):
    with pytest.raises(ValueError, match=said):
        encode_nav2(small_map(np.ones((1, 1, 4))), band, relative=True)


def test_a_map_without_metres_is_written_where_it_is_asked_for_alone():
    occupancy = small_map(np.ones((1, 1, 4)))
    with pytest.raises(ValueError, match="must be in metres.*--relative"):
        encode_nav2(occupancy, (0.5, 1.0))
    asked = encode_nav2(occupancy, (0.5, 1.0), relative=True)
    assert b"# unit: relative\n" in asked["map.yaml"] and b"\n# splatnode: unit relative," in asked["map.pgm"]
    metric = encode_nav2(replace(occupancy, scale=Scale(True, "a marker")), (0.5, 1.0))
    assert b"# unit: metres\n" in metric["map.yaml"] and b"\n# splatnode: unit metres," in metric["map.pgm"]
