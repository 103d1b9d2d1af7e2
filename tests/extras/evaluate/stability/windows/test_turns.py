"""Windows come scene by scene, each with what was found in its scene of its photographs."""

from __future__ import annotations

from splatnode.extras.evaluate.dataset import EvaluationScene
from splatnode.extras.evaluate.stability.perturbations import TrialScene
from splatnode.extras.evaluate.stability.window_campaign import Job, WindowScheduler
from splatnode.extras.evaluate.stability.windows import Window

EAST, WEST = (TrialScene(EvaluationScene("pole", {}, {}), ("a", "b", "c", "d")) for _ in range(2))  # of one name, even


def job(place: TrialScene, start: int) -> Job:
    return Job(place, Window(place.name, 2, 1, start, place.names[start : start + 2], 5.0), "splatnode")


def test_each_window_gets_what_was_found_of_its_photographs(tmp_path):
    first, second, third = (job(EAST, start) for start in range(3))
    turns = WindowScheduler([first, second, third], tmp_path)
    assert turns.take_job() == (first, {})
    turns.finish_job(first, {("plain", "a"): b"1", ("plain", "b"): b"2", ("plain", "a", "b"): b"3"})
    assert turns.take_job() == (second, {("plain", "b"): b"2"})
    turns.finish_job(second, {})  # it failed
    assert turns.take_job() == (third, {})
    assert turns.take_job() is None and len(list(tmp_path.iterdir())) == 3
    turns.finish_job(third, {("plain", "d"): b"4"})
    assert list(tmp_path.iterdir()) == [], "nobody needs it any more"


def test_whoever_is_free_turns_to_another_scene_and_nobody_waits(tmp_path):
    east, west = [job(EAST, start) for start in range(3)], [job(WEST, 0)]
    turns = WindowScheduler([*east, *west], tmp_path)
    begun = [turns.take_job() for _ in range(3)]
    assert [each and each[0] for each in begun] == [east[0], west[0], east[1]]
    turns.finish_job(west[0], {("plain", "a"): b"1"})
    turns.finish_job(east[1], {("plain", "c"): b"1"})
    assert turns.take_job() == (east[2], {("plain", "c"): b"1"}), "and not what was found in the other scene"
