"""The benchmark of the building: what it computes of a walk whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.extras.cameras import building
from splatnode.recon.geometry import Similarity
from tests.bench.node.building_cost import Sample, cost_row, per_keyframe
from tests.bench.node.building_score import camera_rows, loop_row, maps

CONFIG = building.Config(width=96, height=72, keyframes=200)
SCENES = {"scene-0001": range(0, 20), "scene-0002": range(60, 80), "scene-0003": range(124, 144)}


def truth(keyframe: int) -> np.ndarray:
    return building.scene_camera(CONFIG, keyframe)[0]


def _turned(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


FROM_WORLD = {
    scene: Similarity(0.3 + 0.2 * i, _turned(0.7 * i), np.array([i, 2.0, -i])) for i, scene in enumerate(SCENES)
}
FOUND = {
    scene: {keyframe: FROM_WORLD[scene].camera(truth(keyframe)) for keyframe in part} for scene, part in SCENES.items()
}


def link(scene: str, other: str, kind: str, turned: float = 0.0) -> dict:
    step = FROM_WORLD[scene].after(FROM_WORLD[other].inverse())
    return {
        "kind": kind, "scene": scene, "other": other, "scale": step.scale, "retracted": None,
        "rotation": (_turned(turned) @ step.rotation).tolist(), "translation": step.translation.tolist(),
    }  # fmt: skip


def pose(scene: str) -> dict:
    step = FROM_WORLD["scene-0001"].after(FROM_WORLD[scene].inverse())
    told = {"scale": step.scale, "rotation": step.rotation.tolist(), "translation": step.translation.tolist()}
    return {"scene": scene, "map": "scene-0001", **told}


def shows_the_same(first: int, second: int) -> bool:
    """The third scene is a second tour of the first one's room."""
    return (first < 20) == (second < 20 or second >= 124) and abs(first + 124 - second) < 4


def test_without_poses_scenes_are_joined_by_their_links():
    chain = [link("scene-0002", "scene-0001", "chain"), link("scene-0003", "scene-0002", "chain")]
    joined = maps({"links": chain}, list(FOUND))
    assert {name for name, _ in joined.of.values()} == {"scene-0001"}
    (row,) = camera_rows(FOUND, joined, truth)
    assert (row["scenes"], row["keyframes"]) == (3, 60)
    assert row["position_m_most"] < 1e-6 and row["rotation_deg_most"] < 1e-4
    apart = maps({"links": [{**chain[0], "retracted": "it was wrong"}]}, list(FOUND))
    assert len({name for name, _ in apart.of.values()}) == 3


def test_poses_join_scenes_and_a_wrong_one_is_seen():
    poses = [pose(scene) for scene in FOUND]
    (row,) = camera_rows(FOUND, maps({"links": [], "poses": poses}, list(FOUND)), truth)
    assert row["position_percent_of_path"] < 1e-6
    poses[2]["translation"][0] += 0.2
    (row,) = camera_rows(FOUND, maps({"links": [], "poses": poses}, list(FOUND)), truth)
    assert row["position_percent_of_path"] > 0.1 and row["position_m_most"] > 0.2


@pytest.mark.parametrize("turned, wrong", [(0.0, 0), (np.radians(4.0), 1)])
def test_a_revisit_is_found_by_its_link_and_a_wrong_link_is_named(turned, wrong):
    links = [link("scene-0003", "scene-0001", "loop", turned)]
    joined = maps({"links": links}, list(FOUND))
    row = loop_row(FOUND, joined, links, truth, shows_the_same)
    assert (row["revisits"], row["linked"], row["loop_links"], row["missed"]) == (1, 1, 1, [])
    assert row["wrong_loop_links"] == wrong and row["loop_links_that_are_no_revisit"] == 0
    missed = loop_row(FOUND, maps({"links": []}, list(FOUND)), [], truth, shows_the_same)
    assert (missed["linked_or_in_one_map"], missed["missed"]) == (0, [["scene-0001", "scene-0003"]])


def test_the_truth_knows_the_second_tour_of_a_room():
    same = building.same_place
    row = loop_row(FOUND, maps({"links": []}, list(FOUND)), [], truth, lambda a, b: same(CONFIG, a, b))
    assert row["missed"] == [["scene-0001", "scene-0003"]]


def test_costs_are_shared_out_to_the_keyframes_between_two_samples():
    samples = [Sample(2.0 * k, k, k, k + 0.005 * k * k, 500.0 + k, 0.0, 0.1 * k) for k in range(0, 300, 2)]
    numbers, seconds = per_keyframe(samples, "processor_s")
    assert numbers.tolist() == list(range(298)) and seconds[0] == pytest.approx(1.01)
    row = cost_row(samples)
    assert row["processor_s"]["slope_of_median_per_100"] == pytest.approx(1.0, rel=0.02)
    assert row["second"]["slope_of_median_per_100"] == pytest.approx(0.0, abs=1e-9)
    assert row["rss_mb"]["growth_per_keyframe"] == pytest.approx(1.0)
    assert row["checkpoint_mb"]["growth_per_keyframe"] == pytest.approx(0.1)
    assert row["delay_s"] == {"median": None, "most": 0.0}
