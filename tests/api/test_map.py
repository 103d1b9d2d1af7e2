"""A map of free space from Python: of a result at hand or saved, and refusals."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

import splatnode
from tests.api.conftest import QUICK


def test_what_a_camera_looks_through_is_free_and_what_it_looks_at_is_not(result):
    made = result.map()
    assert made.upright.on_floor and 0.1 < made.shares["free"] < 0.6 and made.shares["not_seen"] > 0.3
    camera = result.cameras[1]
    assert made.at([camera.centre + 0.4 * camera.T_world_camera[:3, 2]]).tolist() == [1]
    assert (made.at(camera.centre + np.outer([1.6, 3.0], camera.T_world_camera[:3, 2])) != 1).all()
    assert np.array_equal(pickle.loads(pickle.dumps(made)).states, made.states)


def test_a_saved_result_has_the_same_map(result, tmp_path):
    saved = splatnode.load(result.save(tmp_path / "out"))
    one, other = result.map(voxel=0.03), saved.map(voxel=0.03)
    assert np.array_equal(one.states, other.states) and np.allclose(one.T_world_map, other.T_world_map)
    written = saved.map().save(tmp_path / "nav", band=(0.1, 0.3), relative=True)
    assert {"map.yaml", "occupancy.bt"} < {path.name for path in written}


def test_lengths_in_metres_scale_the_map(arrays, result):
    metric = splatnode.reconstruct(arrays, config=QUICK, scale=(0, 3, 3.0))
    ratio = np.linalg.norm(metric.cameras[3].centre - metric.cameras[0].centre) / np.linalg.norm(
        result.cameras[3].centre - result.cameras[0].centre
    )
    one, other = result.map(voxel=0.03), metric.map(voxel=0.03 * float(ratio))
    assert metric.map().scale.metric and metric.map().voxel in (0.05, 0.1)
    assert abs(one.shares["free"] - other.shares["free"]) < 0.01


def test_of_a_refusal_and_of_an_older_result_there_is_none(arrays, result):
    with pytest.raises(ValueError, match="TOO_FEW_VIEWS"):
        splatnode.reconstruct(arrays[:1], config=QUICK).map()
    older = replace(result, _snapshot=replace(result._snapshot, depths={}))
    with pytest.raises(ValueError, match="no depth.npz"):
        older.map()
