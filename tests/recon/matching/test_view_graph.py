"""The view graph: every pair is compared once, and its components are what verified pairs connect."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.pair_matching import MatchedPair
from splatnode.recon.matching.view_graph import FIRST_COMPARISONS, ViewGraph, match, match_newest, match_pending
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.threads import RunContext
from tests.support.synthetic import photographs, places, view_graph

NO_MATCHES = np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class Verified:
    """A pair as the view graph sees it: how many matches, of which frames in which order."""

    matches: range
    names: tuple[str, str]

    def swap(self) -> Verified:
        return replace(self, names=self.names[::-1])


def keyframe(name: str) -> SimpleNamespace:
    """Frames of one initial letter match firmly, those of one letter but another case weakly, others not at all."""
    frame = SimpleNamespace(image=None)
    return SimpleNamespace(name=name, frame=frame, features=name)


@pytest.fixture
def compared(monkeypatch) -> list[tuple[str, ...]]:
    """The names of the pairs that were compared, those by tilted features after a third word."""
    calls: list[tuple[str, ...]] = []

    def compare(first, second, config):
        calls.append((first.name, second.name))
        hint = -2.0 if first.name[0].lower() == second.name[0].lower() else 0.0
        firm = Verified(range(200), (first.name, second.name)) if first.name[0] == second.name[0] else None
        return MatchedPair(NO_MATCHES, firm, hint)

    def match_affine(first, second, plain, tilts, config):
        calls.append((first.name, second.name, "tilted"))
        weak = Verified(range(30), (first.name, second.name)) if plain.log10_nfa < 0.0 else None
        return MatchedPair(NO_MATCHES, weak, -20.0 if weak else 0.0)

    monkeypatch.setattr(pair_matching, "match_plain", compare)
    monkeypatch.setattr(pair_matching, "match_affine", match_affine)
    monkeypatch.setattr("splatnode.recon.matching.view_graph.content_key", lambda keyframe: keyframe.name)
    monkeypatch.setattr(
        "splatnode.recon.matching.view_graph._try_affine_features", lambda keyframe, tilts, config: keyframe
    )
    return calls


def graph_of(*names: str) -> Any:
    return match(map(keyframe, names), matching.MatchingConfig())  # pyright: ignore[reportArgumentType]


def complete(graph: Any) -> Any:
    *_, whole = match_pending(graph, None)
    return whole


def soon(graph: Any, name: str) -> Any:
    """With a further keyframe that is compared with a few others."""
    *_, later = match_newest(graph.add_keyframe(keyframe(name)), None)
    return later


def names_of(graph: Any) -> dict[tuple[str, str], tuple[str, str]]:
    """By the frames' names, what each pair says its frames are."""
    names = [keyframe.name for keyframe in graph.keyframes]
    return {(names[i], names[j]): pair.names for (i, j), pair in graph.pairs.items()}


def tilted(calls: list[tuple[str, ...]]) -> set[tuple[str, ...]]:
    return {call[:2] for call in calls if len(call) == 3}


def test_every_pair_is_compared_once_and_each_says_what_its_own_frames_are(compared):
    graph = graph_of("a2", "b1", "a1")
    assert sorted(call for call in compared if len(call) == 2) == [("a1", "a2"), ("a1", "b1"), ("a2", "b1")]
    assert set(graph.pairs) == {(0, 2)}
    assert graph.pairs[0, 2].names == ("a2", "a1")


def test_tilted_features_find_what_the_plain_ones_hint_at(compared):
    graph = graph_of("a1", "A1", "b1")
    assert ("A1", "a1") in tilted(compared)
    assert names_of(graph) == {("a1", "A1"): ("a1", "A1")}


def test_tilted_features_are_not_tried_between_frames_that_firm_pairs_connect(compared, monkeypatch):
    plain = pair_matching.match_plain

    def chained(first, second, config):
        apart = abs(int(first.name[1]) - int(second.name[1])) > 1
        found = plain(first, second, config)
        return MatchedPair(NO_MATCHES, None, 0.0) if apart else found

    monkeypatch.setattr(pair_matching, "match_plain", chained)
    graph_of("a1", "a2", "a3", "a4")
    # Two steps away along the chain they may still overlap, three steps away no more.
    assert tilted(compared) == {("a1", "a3"), ("a2", "a4")}


def test_frames_with_enough_firm_partners_need_no_tilted_features(compared):
    graph = graph_of(*(f"{letter}{number}" for number in range(5) for letter in "aA"))
    found = names_of(graph)
    assert {first[0] + second[0] for first, second in found} == {"aa", "AA"}
    assert len(found) == 20


def test_the_order_in_which_frames_come_does_not_matter(compared):
    names = ("a1", "A1", "a2", "A2", "a3")
    found = []
    for order in itertools.permutations(names):
        pairs = names_of(graph_of(*order))
        assert all(key == value for key, value in pairs.items())
        found.append({tuple(sorted(key)) for key in pairs})
    assert all(pairs == found[0] for pairs in found)


def test_components_are_the_largest_first(compared):
    assert graph_of().components() == []
    assert graph_of("c1", "a1", "b1", "a2", "b2", "a3").components() == [[1, 3, 5], [2, 4], [0]]


def test_without_a_keyframe_the_graph_is_that_of_the_others(compared):
    graph = graph_of("a1", "a2", "b1", "A1", "a3")
    made = len(compared)
    rest = graph.remove_keyframes({"a1", "b1"})
    assert rest.names == ["a2", "A1", "a3"] and len(compared) == made  # it is asked by what follows, which can pause
    # a2 and a3 had two firm partners before; now they have one, and tilted features are worth their time.
    rest = complete(rest)
    assert names_of(rest) == names_of(graph_of("a2", "A1", "a3"))
    assert ("a2", "a4") in names_of(complete(rest.add_keyframe(keyframe("a4"))))
    assert len(graph.keyframes) == 5 and ("a1", "a2") in names_of(graph)


def test_out_of_time_no_pair_is_matched_with_tilted_features(compared):
    graph: Any = ViewGraph(matching.MatchingConfig(), (keyframe("a1"),))
    *_, whole = match_pending(graph.add_keyframe(keyframe("A2")), None, RunContext(deadline=0.0))
    assert compared == [("A2", "a1")] and not whole.pending and not whole.tilted


def test_who_waits_hears_how_many_pairs_are_matched_and_how_many_weak_ones_again(compared):
    told = []
    match(
        [keyframe(name) for name in ("a", "b", "A")],
        matching.MatchingConfig(),
        run=RunContext(tell=lambda step: told.append(str(step))),
    )
    matched = [f"matching: {done} of 3 photograph pairs" for done in (1, 2, 3)]
    assert told[:3] == matched and told[-1] == "matching weak pairs again: 3 of 3 photograph pairs"
    assert all(line.startswith("matching weak pairs again") for line in told[3:])


def test_pairs_from_elsewhere_stay_when_a_keyframe_comes(compared):
    before = {(0, 1): Verified(range(77), ("a1", "a2"))}
    graph: Any = ViewGraph(matching.MatchingConfig(), (keyframe("a1"), keyframe("a2")), before)
    graph = complete(graph.add_keyframe(keyframe("b1")))
    assert graph.pairs == before


@pytest.mark.parametrize("pairs", [[(0, 1), (1, 2), (2, 3)], [(2, 3), (0, 1), (1, 2)], [(0, 3), (2, 3), (1, 2)]])
def test_a_chain_is_one_component_in_whatever_order_its_pairs_were_found(pairs):
    graph: Any = ViewGraph(
        matching.MatchingConfig(tilting=pair_matching.AffineSimulationConfig(tilts=())),
        ("a", "b", "c", "d", "e"),
        dict.fromkeys(pairs),
    )
    assert graph.components() == [[0, 1, 2, 3], [4]]


def test_photographs_of_one_place_are_a_pair_and_those_of_two_are_not():
    here, there = photographs()[2:4], places()[5:]
    graph = view_graph([*here, *there])
    assert set(graph.pairs) == {(0, 1)}
    assert len(graph.pairs[0, 1].matches) > 100 and not graph.pairs[0, 1].is_pure_rotation


def test_cameras_do_not_depend_on_the_order_of_the_photographs():
    frames = photographs()[1:4]
    config = matching.MatchingConfig(features=features.FeatureConfig(max_num_features=1500))
    found = {}
    for order in ((0, 1, 2), (2, 0, 1)):
        images = [frames[index].image for index in order]
        found_in = [features.extract(image, config.features) for image in images]
        graph = match(map(Keyframe, [frames[index] for index in order], images, found_in), config)
        registration = registration_registration.register(
            graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
        )
        assert registration is not None and len(registration.cameras) == 3
        found[order] = {graph.keyframes[camera.index].name: camera for camera in registration.cameras}
    relative = []
    for cameras in found.values():
        first, *others = (cameras[frame.name] for frame in frames)
        relative.append([np.linalg.inv(first.T_world_camera) @ camera.T_world_camera for camera in others])
        assert cameras[frames[0].name].focal == pytest.approx(found[0, 1, 2][frames[0].name].focal, rel=1e-12)
    np.testing.assert_allclose(relative[0], relative[1], atol=1e-9)


def test_a_keyframe_added_soon_is_compared_with_a_few_first_and_in_the_end_with_all(compared):
    names = [f"a{number}" for number in range(8)]
    graph = graph_of(*names[:7])
    compared.clear()
    graph = soon(graph, "a7")
    assert len(compared) == FIRST_COMPARISONS and not tilted(compared)
    assert {i for i, j in graph.pending if j == 7} == {i for i in range(7) if (i, 7) not in graph.pairs}
    graph = complete(graph)
    assert not graph.pending
    assert names_of(graph) == names_of(graph_of(*names))


def test_what_shares_most_with_the_partners_of_a_keyframe_is_looked_at_before_the_rest(compared):
    graph = graph_of("a1", "a2", "a3", "a4", "b1", "b2", "b3")
    compared.clear()
    graph = soon(graph, "a5")
    # The latest tell nothing, one after the other, until one of the a's is met.
    assert compared[:FIRST_COMPARISONS] == [("a5", "b3"), ("a5", "b2"), ("a5", "b1"), ("a4", "a5")]
    # One partner is too little to be used: then all is compared.
    assert not graph.pending and len(names_of(graph)) == len(names_of(graph_of("a1", "a2", "a3", "a4", "a5"))) + 3


def test_what_is_pending_stays_so_without_another_keyframe(compared):
    graph = graph_of(*(f"a{number}" for number in range(7)))
    graph = soon(graph, "a7")
    (later,) = {i for i, _ in graph.pending} & {0}
    rest = graph.remove_keyframes({"a6"})
    assert (later, 6) in rest.pending and len(rest.keyframes) == 7


def test_a_joined_graph_knows_what_either_knew_and_what_is_left_to_compare():
    graph = view_graph(photographs()[3::-1])  # the last came first
    names = [keyframe.name for keyframe in graph.keyframes]
    joined = graph.remove_keyframes({names[0]}).merge(graph.remove_keyframes({names[3]}))
    assert [keyframe.name for keyframe in joined.keyframes] == names[::-1]
    assert joined.pending == {(0, 3)} and set(joined.pairs) == set(itertools.combinations(range(4), 2)) - {(0, 3)}
    assert np.array_equal(joined.pairs[0, 1].points1, graph.pairs[2, 3].points2)  # swapped with their keyframes
    joined = complete(joined)
    assert len(joined.pairs[0, 3].matches) == len(graph.pairs[0, 3].matches)
