"""Given cameras and points as other recipes get them, and rows of what has no scores."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="rivals need pycolmap (pip install 'splatnode[bench]')")

from splatnode.extras.evaluate.methods import Start
from splatnode.extras.evaluate.protocol import create_empty_networks
from splatnode.extras.evaluate.rivals import colmap_3dgs, colmap_fsgs
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.threads import Clock
from tests.bench.quality import given_scenes
from tests.bench.quality.held_out import Scoring
from tests.support.row_of_views import graph_of, registration_of

SCORING = Scoring(create_empty_networks(), given_scenes.SETTINGS)
# Of two points: the first is seen by views 0 and 2, the other by view 1
SEEN_BY, SEEN, PIXELS = [0, 2, 1], [0, 0, 1], [[3.5, 4.5], [10.2, 5.9], [31.9, 23.9]]


def estimate_of(points: list[list[float]]) -> Reconstruction:
    count = 3 if points else 0
    found = replace(
        registration_of(3),
        points=np.array(points).reshape(-1, 3),
        observed_by=np.array(SEEN_BY[:count], np.int64),
        observed_point=np.array(SEEN[:count], np.int64),
        observed_pixels=np.array(PIXELS[:count]).reshape(-1, 2),
    )
    return Reconstruction(graph_of(3), found, None, Verdict(Code.OK, "", "", (), publishable=True))


def test_recipes_get_the_cameras_and_points_of_the_given_poses():
    estimate = estimate_of([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    model = given_scenes.make_sparse_model(estimate)
    assert model is not None and estimate.registration is not None
    assert np.array_equal(model.points, estimate.registration.points)
    assert [each.tolist() for each in model.observed] == [[0], [1], [0]]
    images = [keyframe.frame.image.astype(float) for keyframe in estimate.graph.keyframes]
    colours = [(images[0][4, 3] + images[2][5, 10]) / 2, images[1][23, 31]]
    assert np.abs(model.colours - np.array(colours)).max() <= 0.5
    scene = colmap_3dgs.initialize_scene(model, 0)
    assert len(scene.gaussians) == 2
    for view, camera in zip(scene.views, estimate.registration.cameras, strict=True):
        assert np.allclose(view.T_world_camera, camera.T_world_camera)
        scale = max(view.image.shape) / 32
        assert view.K[0, 0] == pytest.approx(scale * camera.focal) and view.lens is None


def test_fsgs_knows_the_range_of_a_view_that_observes_no_point():
    model = given_scenes.make_sparse_model(estimate_of([[0.1 * x, 0.0, 1.0] for x in range(4)]))
    assert model is not None and max(map(len, model.observed)) < 3
    scene = colmap_fsgs.initialize_scene_with_depth(model, 0)
    assert all(view.pointmap is not None for view in scene.views)


def test_a_recipe_without_points_is_a_row_that_says_why():
    case = SimpleNamespace(scene=SimpleNamespace(name="s"), split=SimpleNamespace(train=("a", "b", "c")))
    start = Start(estimate_of([]), [], Clock(), None)
    row = given_scenes.measure(case, start, "3dgs", 1, SCORING)
    assert (row.psnr, row.num_gaussians, row.points, row.placed) == (None, 0, 0, 3)
    assert row.why == "there is no point to start from" and row.why in given_scenes.describe_row(row)


def test_a_file_names_the_sets_that_it_lacks(tmp_path):
    case = SimpleNamespace(scene=SimpleNamespace(name="kitchen"), split=SimpleNamespace(train=("a", "b", "c")))
    row = given_scenes.measure(case, Start(estimate_of([]), [], Clock(), None), "3dgs", 1, SCORING)
    rows = [replace(row, method=name) for name in given_scenes.METHODS]
    given_scenes.write(rows, SCORING, tmp_path / "rows.json")
    written = json.loads((tmp_path / "rows.json").read_text())
    assert [given_scenes.Row(**each) for each in written["rows"]] == rows
    assert "kitchen:3" not in written["note"] and "kitchen:6" in written["note"]
    given_scenes.write(rows[1:], SCORING, tmp_path / "rows.json")
    assert "kitchen:3" in json.loads((tmp_path / "rows.json").read_text())["note"]
