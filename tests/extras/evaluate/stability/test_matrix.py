"""The rows of the stability matrix: the photographs that each makes of its places."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.stability.campaign import ROWS, select_rows
from splatnode.extras.evaluate.stability.perturbations import (
    Sampler,
    ScenesByMotion,
    classify_motion,
    find_distant_views,
    find_neighbour_sets,
    find_parallel_sets,
    load_scenes_by_motion,
    load_trial_scenes,
)
from splatnode.extras.evaluate.stability.trial import Demand
from tests.support.stability_places import on_arc, three_places


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> ScenesByMotion:
    return three_places(tmp_path_factory.mktemp("places"))


def test_how_a_camera_moved():
    assert classify_motion(np.stack([on_arc(i) for i in range(4)])) == "walked"
    assert classify_motion(np.stack([on_arc(0, 3.0 + i) for i in range(4)])) == "forward"
    assert classify_motion(np.stack([on_arc(i, 0.0) for i in range(4)])) == "turned"


def test_neighbours_are_as_far_apart_as_they_may_be():
    every_3 = np.stack([on_arc(3.0 * i) for i in range(12)])
    assert find_neighbour_sets(every_3, 3, 12.5) == ([0, 1, 2, 3], 4)
    assert find_neighbour_sets(every_3, 3, 7.0)[1] == 2
    every_18 = np.stack([on_arc(18.0 * i) for i in range(5)])
    assert find_neighbour_sets(every_18, 4, 12.0) == ([0, 1], 1), "within what overlaps, where none are as close"
    assert find_neighbour_sets(np.stack([on_arc(30.0 * i) for i in range(5)]), 3, 12.0) == ([], 1)


def test_seeds_take_turns_through_the_places(places):
    stages = [Sampler(places, "a row", seed) for seed in range(3)]
    assert {sampler.load_images(3)[0].place for sampler in stages} == {"east", "south", "west"}
    for sampler in stages:
        here = sampler.load_images(3)
        (elsewhere,) = sampler.load_images(1, here)
        assert elsewhere.place != here[0].place
        assert len({photo.place for photo in sampler.load_one_per_scene(5)}) == 3
    with pytest.raises(ValueError, match="row 'a row' needs a place with 13 photographs"):
        stages[0].load_images(13)


def test_parallel_views_do_not_turn():
    def sideways(turn: float) -> np.ndarray:
        Ts_world_camera = np.stack([on_arc(turn * i) for i in range(6)])
        Ts_world_camera[:, :3, 3] = [[0.1 * i, 0.0, 0.0] for i in range(6)]
        return Ts_world_camera

    assert find_parallel_sets(sideways(1.0), 3) == ([0, 1], 2), "at a stride of 4 they do not fit in"
    assert find_neighbour_sets(sideways(1.0), 3, 12.0) == ([], 1)
    assert find_parallel_sets(sideways(9.0), 3) == ([], 1) and find_neighbour_sets(sideways(9.0), 3, 12.0)[0]


def test_views_far_apart(places):
    rng = np.random.default_rng(0)
    found = find_distant_views(places.walked[0], 3, 11.9, rng)
    assert found is not None and np.diff(found).min() >= 2
    assert find_distant_views(places.walked[0], 3, 60.0, rng) is None


def test_a_folder_that_is_no_scene_is_a_clear_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold the scene's images"):
        load_scenes_by_motion([tmp_path], tmp_path)


def test_two_scenes_of_one_name_are_a_clear_error(tmp_path):
    with pytest.raises(ValueError, match="a/room' and '.*b/room' are both called 'room'"):
        load_trial_scenes([tmp_path / "a" / "room", tmp_path / "b" / "room"], tmp_path)


def test_every_number_has_a_row_and_every_row_a_name_of_its_own():
    assert {row.number for row in ROWS} == set(range(1, 32))
    names = [(row.number, row.name) for row in ROWS]
    assert len(set(names)) == len(names)
    assert {row.number for row in select_rows((7, 14))} == {7, 14}
    assert select_rows(()) == ROWS
    with pytest.raises(ValueError, match="no row 32; there are 1 to 31"):
        select_rows((32,))


# Rows that photograph the built-in place at full size, or write large files, would take as long as all others.
SLOW = {"tiny baseline", "forward motion", "clean, parallel views", "a huge file"}


@pytest.mark.parametrize("row", [row for row in ROWS if row.name not in SLOW], ids=lambda r: r.name)
def test_rows_make_the_same_case_again(row, places):
    first, again = (row.make(Sampler(places, row.name, 1)) for _ in range(2))
    given, same = list(first.source()), list(again.source())
    assert len(given) > 0 and len({frame.name for frame in given}) == len(given)
    frames = [frame for frame in given if isinstance(frame, Frame)]
    for frame, twin in zip(given, same, strict=True):
        assert frame.name == twin.name and type(frame) is type(twin)
        if isinstance(frame, Frame) and isinstance(twin, Frame):
            assert np.array_equal(frame.image, twin.image)
    assert first.codes and first.note
    names = {frame.name for frame in frames}
    assert all(set(known) <= names for known in first.worlds)
    if first.demand is Demand.ACCEPT:
        assert sum(map(len, first.worlds)) >= 3
