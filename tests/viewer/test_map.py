"""A folder of many scenes in the viewer: what is loaded, the graph, the list of places, and a walk through it."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from splatnode.command_line import main
from splatnode.recon.result.export import SceneFileError
from splatnode.recon.result.stored_snapshot import find_pieces
from splatnode.recon.result.submap_index import read_map_set
from splatnode.viewer import session
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import CHAIN_COLOUR, LOOP_COLOUR, RETRACTED_COLOUR, shapes
from splatnode.viewer.sources import FOCAL_PX, Extent, MapLoader, Maps, MapSource, choose_levels, map_moment
from splatnode.viewer.state import (
    FULL,
    NOTHING,
    Graph,
    GraphEdge,
    GraphNode,
    ViewerState,
    append_moment,
    edge_lines,
    node_marks,
    overview,
    place_lines,
    press,
)
from tests.support.walk import place, walk, write_walk

NONE = np.zeros(3)
LOOP = {"kind": "loop", "why": "seen again"}


def maps(folder, budget: int = 1_000_000) -> Maps:
    return Maps(folder, lambda cameras: {}, budget)


@pytest.fixture
def out(tmp_path):
    """Two linked scenes, a loop that was taken back, one place that was refused, and one scene that is alone."""
    write_walk(tmp_path, further=(place("scene-0003"), place("scene-0004", folder="scene-0002", publishable=True)))
    index = json.loads((tmp_path / "places.json").read_text())
    (link,) = index["links"]
    index["links"] += [{**link, **LOOP, "retracted": None}, {**link, **LOOP, "retracted": "the cycle does not close"}]
    (tmp_path / "places.json").write_text(json.dumps(index))
    return tmp_path


def test_the_near_is_full_the_far_is_coarse_and_the_budget_is_kept():
    near, far = Extent(0.0, 0.1, (1000, 100), (0.01,)), Extent(5.0, 5.1, (1000, 100), (0.01,))
    assert choose_levels([far, near], 5000) == (FULL, FULL)  # voxels of 10 pixels are seen
    assert choose_levels([far, near], 1100) == (1, FULL)
    assert choose_levels([far, near], 1050) == (1, 1)
    assert choose_levels([far, near], 150) == (NOTHING, 1)
    beyond = replace(far, away=FOCAL_PX * 0.01)
    assert choose_levels([beyond, near], 5000) == (1, FULL)  # now they are below a pixel
    assert choose_levels([], 10) == ()


@pytest.mark.parametrize("budget", [0, 40, 500, 2600, 10_000])
def test_no_choice_exceeds_the_budget(budget):
    rng = np.random.default_rng(budget)
    extents = []
    for _ in range(30):
        full = int(rng.integers(1, 900))
        extents.append(
            Extent(float(rng.uniform(0, 9)), float(rng.uniform(0, 9)), (full, full // 4, full // 16), (0.01, 0.02))
        )
    chosen = choose_levels(extents, budget)
    assert sum(extents[i].counts[level] for i, level in enumerate(chosen) if level != NOTHING) <= budget


def test_pieces_are_loaded_where_the_eye_is_and_forgotten_where_it_was(tmp_path):
    whole = read_map_set(write_walk(tmp_path, step=0.02))
    pieces = find_pieces(whole, whole.maps[0], tmp_path)
    full = [len(scene.gaussians) - int((scene.gaussians.source_frame == -1).sum()) for scene in walk(0.02)]
    budget = max(full) + max(full) // 3
    loader = MapLoader(pieces, budget)
    seen = []

    def watch() -> bool:
        seen.append(len(loader.gaussians()))
        return False

    assert loader.look_from(np.array([0.4, 0.0, 0.0]), watch)
    assert loader.shown["scene-0001"] == (FULL, full[0]) and loader.shown["scene-0002"][0] > FULL
    assert loader.look_from(np.array([2.4, 0.0, 0.2]), watch)
    assert loader.shown["scene-0002"] == (FULL, full[1]) and loader.shown["scene-0001"][0] > FULL
    assert not loader.look_from(np.array([2.4, 0.0, 0.2]), watch) and max(seen) <= budget


def test_loading_begins_anew_when_the_eye_goes_elsewhere(tmp_path):
    whole = read_map_set(write_walk(tmp_path))
    loader = MapLoader(find_pieces(whole, whole.maps[0], tmp_path), 1_000_000)
    assert loader.look_from(NONE, lambda: True)
    assert list(loader.shown) == ["scene-0001"]  # the nearest first


def test_the_whole_map_is_in_one_frame_with_its_graph(out):
    moment = map_moment(maps(out))
    graph = moment.graph
    assert [camera.name for camera in moment.snapshot.cameras] == [f"{n}.png" for n in range(6)]
    assert np.allclose(moment.snapshot.cameras[5].T_world_camera[:3, 3], [2.4, 0.0, 0.25], atol=1e-5)
    walls = moment.snapshot.gaussians.means
    assert np.allclose(walls[:, 2], 1.0, atol=1e-4)  # both, without the shells
    assert [(node.scene_id, node.good) for node in graph.nodes] == [
        ("scene-0001", True), ("scene-0002", True), ("scene-0003", False),
    ]  # fmt: skip
    assert (graph.which, graph.maps, graph.merged) == (0, 2, False)
    assert [(edge.loop, edge.retracted) for edge in graph.edges] == [
        (False, None), (True, None), (True, "the cycle does not close"),
    ]  # fmt: skip
    assert np.allclose(graph.edges[0].ends, [[1.0, 0.0, 0.0], [1.8, 0.0, 0.25]], atol=1e-5)
    assert map_moment(maps(out), 1).scene_id == "scene-0004"
    view = overview(moment)
    local = np.array([camera.T_world_camera[:3, 3] for camera in moment.snapshot.cameras]) - view.T_world_camera[:3, 3]
    assert ((local @ view.T_world_camera[:3, :3])[:, 2] > 0).all()


def test_links_are_drawn_by_kind_and_places_are_listed(out):
    moment = map_moment(maps(out))
    drawn = {
        lines.colour: len(lines.ends) for lines in shapes(moment, ViewerState(cameras=False, path=False), None).lines
    }
    assert drawn[CHAIN_COLOUR] == 1 and drawn[LOOP_COLOUR] == 1 and drawn[RETRACTED_COLOUR] > 4  # dashes
    hidden = shapes(moment, press(ViewerState(cameras=False, path=False), (), "8"), None)
    assert not hidden.lines
    said = "\n".join(session.place_lines(moment))
    for phrase in (
        "map 1 of 2", "splatnode merge", "scene-0001 OK: ", "full detail", "scene-0003 NO_PARALLAX: no scene",
        "loop scene-0001 to scene-0002, taken back: the cycle does not close",
    ):  # fmt: skip
        assert phrase in said
    assert "several scenes" in session.advice_line(None, moment)


def test_the_list_of_places_is_bounded_and_dashes_leave_gaps():
    nodes = tuple(GraphNode(f"scene-{n:04d}", "OK", True, np.ones(3) * n, 5, 2) for n in range(40))
    edge = GraphEdge("a", "b", np.array([[0.0, 0, 0], [1, 0, 0]]), True, "no")
    lines = place_lines(Graph(nodes, (edge,) * 20, 0, 1, True))
    assert len(lines) < 30 and "and 26 further away" in lines and "scene-0000 OK: 5 Gaussians, coarse, level 2" in lines
    dashes = edge_lines((edge,), loop=True, retracted=True)
    lengths = np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=1)
    assert np.allclose(dashes[0, 0], 0) and np.allclose(dashes[-1, 1], [1, 0, 0]) and 0.4 < lengths.sum() < 0.6
    assert not len(edge_lines((edge,), loop=False, retracted=False))
    assert node_marks(nodes, good=True).shape == (40 * 12, 2, 3) and not len(node_marks(nodes, good=False))


def wait_for(session: Session, until) -> None:
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        session.receive()
        if session.moment is not None and until(session.moment):
            return
        time.sleep(0.02)
    raise AssertionError("it did not come")


def test_a_person_walks_through_a_map_and_to_the_next_one(tmp_path, out):
    index = json.loads((out / "places.json").read_text())
    (out / "places.json").write_text(json.dumps(index))
    session = Session(MapSource(maps(out, 1200)), ViewerState())
    try:
        wait_for(session, lambda moment: any(node.level == FULL for node in moment.graph.nodes))
        assert session.analysis() is None and session.source.age_s is None
        far_away = replace(session.viewpoint(), T_world_camera=np.eye(4))
        far_away.T_world_camera[0, 3] = 2.6
        session.move(far_away)
        wait_for(session, lambda moment: moment.graph.nodes[0].scene_id == "scene-0002")
        assert len(session.history) == 1  # the parts of a map are no history
        picture = session.paint(120, 80)
        assert picture is not None and picture.std() > 5
        session.press("m")
        wait_for(session, lambda moment: moment.scene_id == "scene-0004")
        session.press("m")
        wait_for(session, lambda moment: moment.scene_id == "scene-0001")
    finally:
        session.close()


def test_a_map_has_no_history(out):
    moment = map_moment(maps(out))
    assert append_moment((moment, moment), moment) == (moment,)


def test_what_is_damaged_is_told_by_name(out, capsys):
    source = MapSource(maps(out))
    source.close()
    (out / "scene-0002" / "scene.ply").write_bytes(b"ply\n")
    with pytest.raises(SceneFileError, match="scene-0002"):
        map_moment(maps(out))
    session = Session(MapSource(maps(out)), ViewerState())
    with pytest.raises(SceneFileError, match="scene-0002"):
        wait_for(session, lambda moment: False)
    session.close()
    (out / "places.json").write_text("{}")
    assert main(["view", str(out), "--headless"]) == 2
    assert "places.json" in capsys.readouterr().err


def test_a_folder_without_any_scene_is_told(tmp_path):
    nothing = {"checkpoint": "0" * 32, "places": [place("scene-0001")], "links": []}
    (tmp_path / "places.json").write_text(json.dumps(nothing))
    with pytest.raises(SceneFileError, match="no scene yet"):
        map_moment(maps(tmp_path))


def test_pictures_of_a_map_need_no_window(out):
    assert (
        main(["view", str(out), "--headless", "--size", "160x120", "--num-frames", "1", "--max-gaussians", "3000"]) == 0
    )
    assert {path.name for path in (out / "view").iterdir()} >= {"overview.png", "camera_005.png", "turntable_000.png"}
