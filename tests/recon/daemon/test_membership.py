"""Which keyframes belong to the scene, and which of its views can be spared."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from types import SimpleNamespace
from typing import Any

import pytest

from splatnode.capture.frame import Clock, Stamp
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import submap
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.threads import BACKGROUND, RunContext


def keyframe(name: str) -> SimpleNamespace:
    return SimpleNamespace(name=name, frame=SimpleNamespace(frame_id=int(name.partition("-")[0])))


class FakeReconstruction:
    """Frames are called by when they come and what is the matter with them.

    With a bad one nothing can be published, with a worse one this is found thoroughly only. Late ones are placed when
    there are two of them, thoroughly only. Far ones are not placed, nor are others, to which no pair leads.
    """

    def __init__(self, *names: str) -> None:
        self._all = [keyframe(name) for name in names]
        self.names = list(names)
        self.scene = object() if names else None
        self.publishable_names = frozenset(names)
        self.refusals: list[frozenset[str]] = []

    @property
    def graph(self) -> Any:
        keyframes = [each for each in self._all if each.name in self.names]
        return SimpleNamespace(keyframes=keyframes, components=self._components)

    @property
    def keyframes_deferred(self) -> list[SimpleNamespace]:
        return [each for each in self._all if each.name not in self.names]

    def match_pending_pairs(self, run: RunContext) -> None:
        run.pause()

    def add_keyframe(self, added: SimpleNamespace, run: RunContext) -> None:
        self._all.append(added)
        self.names.append(added.name)

    def defer_keyframes(self, names: Collection[str]) -> None:
        self.names = [name for name in self.names if name not in names]

    def restore_keyframes(self, names: Collection[str]) -> None:
        self.names = [each.name for each in self._all if each.name in {*self.names, *names}]

    def is_rejected(self, names: Collection[str]) -> bool:
        return frozenset(names) in self.refusals

    def estimate_soon(self, run: RunContext) -> Any:
        return self.estimate_quickly() or self.estimate_thoroughly(run)

    def estimate_quickly(self) -> Any:
        if self.publishable_names == frozenset(self.names):
            return self._estimated(("late", "far", "other") if self._called("late") < 2 else ("far", "other"))
        estimated = self._estimated(("late", "far", "other"))
        all_placed = len(estimated.publishable_camera_names) == len(self.names)
        return estimated if estimated.verdict.publishable and all_placed else None

    def estimate_thoroughly(self, run: RunContext = BACKGROUND) -> Any:
        run.pause()
        estimated = self._estimated(("late", "far", "other") if self._called("late") < 2 else ("far", "other"), "worse")
        if estimated.verdict.publishable:
            self.publishable_names = frozenset(self.names)
        else:
            self.refusals.append(frozenset(self.names))
        return estimated

    def _called(self, word: str) -> int:
        return sum(word in name for name in self.names)

    def _estimated(self, not_placed: tuple[str, ...], *spoiling: str) -> Any:
        verdict = Verdict(Code.OK, "", "", publishable=not any(map(self._called, ("bad", *spoiling))))
        placed = {name for name in self.names if not name.endswith(not_placed)} if verdict.publishable else set()
        return SimpleNamespace(publishable_camera_names=placed, verdict=verdict)

    def _components(self) -> list[list[int]]:
        others = [index for index, name in enumerate(self.names) if "other" in name]
        return [[index for index in range(len(self.names)) if index not in others], others]


def reconstruction(*names: str) -> Any:
    return FakeReconstruction(*names)


def named(keyframes: Iterable[SimpleNamespace]) -> list[str]:
    return [each.name for each in keyframes]


def come(work: Any, *names: str) -> set[str]:
    return submap.add(work, [keyframe(name) for name in names])  # pyright: ignore[reportArgumentType]


def test_before_there_is_a_scene_every_keyframe_is_taken():
    work = reconstruction()
    assert come(work, "0", "1-bad", "2-far") == set() and work.names == ["0", "1-bad", "2-far"]


def test_of_a_batch_only_the_keyframe_that_does_not_fit_at_once_is_set_aside():
    work = reconstruction("0", "1", "2")
    assert come(work, "3", "4-bad", "5", "6-far") == {"4-bad", "6-far"}
    assert work.names == ["0", "1", "2", "3", "5"] and named(work.keyframes_deferred) == ["4-bad", "6-far"]


def test_keyframes_that_only_all_together_have_a_place_join_the_scene():
    work = reconstruction("0", "1", "2")
    assert come(work, "3-late") == {"3-late"} and submap.has_links_to_deferred(work)
    assert submap.join(work, ["3-late"]) and named(submap.find_untracked(work)) == ["3-late"]
    assert come(work, "4-late") == {"4-late"} and named(submap.find_untracked(work)) == ["3-late", "4-late"]
    assert submap.join(work, named(work.keyframes_deferred))
    assert work.names == ["0", "1", "2", "3-late", "4-late"] and submap.find_untracked(work) == []


def test_what_was_refused_once_is_not_estimated_again_and_stays_aside():
    work = reconstruction("0", "1", "2")
    come(work, "3-bad")
    assert not submap.join(work, ["3-bad"]) and len(work.refusals) == 1
    assert not submap.join(work, ["3-bad"]) and len(work.refusals) == 1
    assert named(work.keyframes_deferred) == ["3-bad"] and work.names == ["0", "1", "2"]


def test_frames_with_which_most_of_the_scene_has_no_place_do_not_join_it():
    work = reconstruction("0", "1", "2")
    come(work, "3-far")
    work.estimate_thoroughly = lambda run: work._estimated(("0", "1"))  # of the scene, one of three is left
    assert not submap.join(work, ["3-far"]) and named(work.keyframes_deferred) == ["3-far"]
    work.estimate_thoroughly = lambda run: work._estimated(("0",))
    assert submap.join(work, ["3-far"])


def test_only_the_last_strangers_in_a_row_count_and_those_before_contradict_the_scene():
    work = reconstruction("0", "1", "2")
    come(work, "3-bad")
    come(work, "4")
    come(work, "5-other")
    assert named(submap.find_untracked(work)) == ["5-other"] and named(submap.find_contradicting(work)) == ["3-bad"]


def test_no_pair_leads_to_another_place():
    work = reconstruction("0", "1", "2")
    come(work, "3-other")
    assert not submap.has_links_to_deferred(work) and named(work.keyframes_deferred) == ["3-other"]
    come(work, "4-bad")
    assert submap.has_links_to_deferred(work)


def test_what_was_added_for_now_and_spoils_the_scene_is_found_when_all_is_proven():
    work = reconstruction("0", "1", "2")
    assert come(work, "3", "4-worse", "5") == set()
    submap.verify_provisional(work)
    assert work.names == ["0", "1", "2", "3", "5"] and named(work.keyframes_deferred) == ["4-worse"]
    assert named(submap.find_contradicting(work)) == ["4-worse"]


def test_proof_brings_in_what_only_all_together_have_a_place_for():
    work = reconstruction("0", "1", "2")
    come(work, "3-late")
    come(work, "4-late")
    submap.verify_provisional(work)
    assert submap.find_untracked(work) == [] and not work.keyframes_deferred


def test_proof_that_is_abandoned_changes_nothing():
    def pause() -> None:
        raise InterruptedError

    work = reconstruction("0", "1", "2")
    come(work, "3-worse")
    come(work, "4-bad")
    with pytest.raises(InterruptedError):
        submap.verify_provisional(work, RunContext(pause))
    assert work.names == ["0", "1", "2", "3-worse"] and named(work.keyframes_deferred) == ["4-bad"]


def test_a_scene_that_was_never_proven_is_not_taken_apart():
    work = reconstruction()
    come(work, "0", "1", "2-worse")
    submap.verify_provisional(work)
    assert work.names == ["0", "1", "2-worse"]


@pytest.mark.parametrize(
    ("matches", "spared"),
    [
        ({(0, 1): 50, (1, 2): 400, (2, 3): 90}, "1"),  # 1 and 2 show the same: the older goes
        ({(0, 1): 400, (1, 2): 400}, "0"),
        ({(3, 4): 900, (4, 5): 900, (0, 3): 60}, "0"),  # the newest three stay, whatever they share
        ({}, "0"),
    ],
)
def test_the_older_of_the_two_most_alike_is_given_up(matches, spared):
    pairs: Any = {pair: SimpleNamespace(matches=range(count)) for pair, count in matches.items()}
    graph = ViewGraph(matching.MatchingConfig(), tuple(keyframe(str(i)) for i in range(6)), pairs)
    assert submap.find_most_redundant(graph) == spared


def of_rig(number: int) -> SimpleNamespace:
    """Three cameras take a photograph each, every second."""
    second, camera = divmod(number, 3)
    at = Stamp(second * 10**9 + camera, Clock.UTC)
    return SimpleNamespace(
        name=str(number), frame=SimpleNamespace(frame_id=number, camera_id="abc"[camera], captured_at=at)
    )


def test_frame_sets_are_shared_with_the_next_scene_and_given_up_as_one():
    keyframes, forgotten = [of_rig(number) for number in range(12)], []
    pairs: Any = {(1, 4): SimpleNamespace(matches=range(400))}
    work: Any = SimpleNamespace(config=ReconstructionConfig(), names=[each.name for each in keyframes])
    work.graph = ViewGraph(matching.MatchingConfig(), tuple(keyframes), pairs)  # pyright: ignore[reportArgumentType]
    assert [each.name for each in submap.select_newest(work, 4)] == ["6", "7", "8", "9", "10", "11"]
    work.remove_keyframes = lambda names: setattr(work, "names", [each for each in work.names if each not in names])
    full: Any = SimpleNamespace(
        _work=work, _config=SimpleNamespace(max_views=11), _begin_overlapping_submap=lambda: None,
        _store=SimpleNamespace(forget_frames=lambda names, reason: forgotten.append(sorted(names))),
    )  # fmt: skip
    submap.ActiveSubmap._limit_views(full)
    assert forgotten == [["0", "1", "2"]] and work.names == [str(number) for number in range(3, 12)]


def test_keyframes_that_only_each_other_join_are_a_place_of_their_own():
    work = reconstruction("0", "1", "2", "3-other", "4-other", "5-other")
    assert [named(group) for group in submap.find_separate_groups(work)] == [["3-other", "4-other", "5-other"]]
    assert submap.find_separate_groups(reconstruction("0", "1", "2", "3-other", "4-other")) == []


def test_of_those_that_were_set_aside_too():
    work = reconstruction("0", "1", "2", "3-other", "4-other", "5-other")
    work.defer_keyframes(["4-other", "5-other"])
    assert [named(group) for group in submap.find_separate_groups(work)] == [["3-other", "4-other", "5-other"]]
    assert work.names == ["0", "1", "2", "3-other"]


def test_without_a_scene_what_most_keyframes_show_stays():
    work = reconstruction("0-bad", "1", "2", "3-other", "4-other", "5-other", "6")
    assert [named(group) for group in submap.find_separate_groups(work)] == [["3-other", "4-other", "5-other"]]
