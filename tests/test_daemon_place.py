"""Which key frames belong to the scene, and which of its views can be spared."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from recon.daemon import place
from recon.registration import register
from recon.verdict import Code, Verdict
from recon.view_graph import ViewGraph


def keyframe(name: str) -> SimpleNamespace:
    return SimpleNamespace(name=name)


class FakeReconstruction:
    """Frames called bad make everything unpublishable; those called far are not placed."""

    def __init__(self, names: list[str], scene: object | None) -> None:
        self.graph = SimpleNamespace(keyframes=[keyframe(name) for name in names])
        self.scene, self.proven = scene, frozenset(names)
        self.judgements = 0

    @property
    def names(self) -> list[str]:
        return [each.name for each in self.graph.keyframes]

    def add(self, added: SimpleNamespace) -> None:
        self.graph.keyframes.append(added)

    def retract(self, names: set[str]) -> None:
        self.graph.keyframes = [each for each in self.graph.keyframes if each.name not in names]

    def judge(self) -> SimpleNamespace:
        self.judgements += 1
        placed = [SimpleNamespace(index=i) for i, name in enumerate(self.names) if not name.startswith("far")]
        spoilt = any(name.startswith("bad") for name in self.names)
        verdict = Verdict(Code.OK, "", "", publishable=not spoilt)
        return SimpleNamespace(registration=SimpleNamespace(cameras=placed), verdict=verdict)

    def judge_thoroughly(self, pause=lambda: None) -> SimpleNamespace:
        """Finds what is wrong with the frames called worse, too."""
        pause()
        judged = self.judge()
        spoilt = any(name.startswith("worse") for name in self.names)
        verdict = replace(judged.verdict, publishable=judged.verdict.publishable and not spoilt)
        if verdict.publishable:
            self.proven = frozenset(self.names)
        return SimpleNamespace(registration=judged.registration, verdict=verdict)


def test_before_there_is_a_scene_every_keyframe_is_taken():
    work = FakeReconstruction(["a"], scene=None)
    assert place.add(work, [keyframe("bad"), keyframe("far")]) == set()
    assert work.names == ["a", "bad", "far"] and work.judgements == 0


def test_a_batch_that_fits_is_judged_once():
    work = FakeReconstruction(["a", "b", "c"], scene=object())
    assert place.add(work, [keyframe("d"), keyframe("e")]) == set()
    assert work.names == ["a", "b", "c", "d", "e"] and work.judgements == 1


def test_a_keyframe_that_is_not_placed_stays_for_a_later_one_may_connect_it():
    work = FakeReconstruction(["a", "b", "c"], scene=object())
    assert place.add(work, [keyframe("d"), keyframe("far")]) == {"far"}
    assert work.names == ["a", "b", "c", "d", "far"]


def test_of_a_batch_only_the_keyframe_that_spoils_the_scene_is_taken_back():
    work = FakeReconstruction(["a", "b", "c"], scene=object())
    assert place.add(work, [keyframe("d"), keyframe("bad"), keyframe("e")]) == {"bad"}
    assert work.names == ["a", "b", "c", "d", "e"]


def test_what_was_added_for_now_and_spoils_the_scene_is_found_when_all_is_proven():
    work = FakeReconstruction(["a", "b", "c"], scene=object())
    assert place.add(work, [keyframe("d"), keyframe("worse"), keyframe("e")]) == set()
    assert [stranger.name for stranger in place.prove(work)] == ["worse"]
    assert work.names == ["a", "b", "c", "d", "e"]
    assert place.prove(work) == []


def test_proof_that_is_abandoned_changes_nothing():
    def pause() -> None:
        raise InterruptedError

    work = FakeReconstruction(["a", "b", "c"], scene=object())
    place.add(work, [keyframe("worse")])
    with pytest.raises(InterruptedError):
        place.prove(work, pause)
    assert work.names == ["a", "b", "c", "worse"]


def test_a_scene_that_was_never_proven_is_not_taken_apart():
    work = FakeReconstruction([], scene=None)
    place.add(work, [keyframe("a"), keyframe("b"), keyframe("worse")])
    assert place.prove(work) == [] and work.names == ["a", "b", "worse"]


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
    graph = ViewGraph(register.Config())
    graph.keyframes.extend(keyframe(str(i)) for i in range(6))
    graph.pairs.update({pair: SimpleNamespace(matches=range(count)) for pair, count in matches.items()})
    assert place.most_redundant(graph) == spared
