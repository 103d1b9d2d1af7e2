"""The view graph: every pair is compared once, and its components are what verified pairs connect."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from recon.registration import register
from recon.view_graph import ViewGraph
from tests.synthetic import photographs, places, view_graph


@pytest.fixture
def compared(monkeypatch) -> list[tuple[str, str]]:
    """The names of the pairs that were compared; those of one initial letter match."""
    calls: list[tuple[str, str]] = []

    def compare(first, second, config):
        first, second = (getattr(keyframe, "name", keyframe) for keyframe in (first, second))
        calls.append((first, second))
        return f"{first}{second}" if first[0] == second[0] else None

    monkeypatch.setattr(register, "compare", compare)
    return calls


def test_each_new_keyframe_is_compared_with_all_before_it(compared):
    graph = ViewGraph(register.Config(squeezes=()))
    for name in ("a1", "b1", "a2"):
        graph.add(name)
    assert compared == [("a1", "b1"), ("a1", "a2"), ("b1", "a2")]
    assert graph.pairs == {(0, 2): "a1a2"}
    assert graph.keyframes == ["a1", "b1", "a2"]


def test_components_are_the_largest_first(compared):
    graph = ViewGraph(register.Config(squeezes=()))
    assert graph.components() == []
    for name in ("c1", "a1", "b1", "a2", "b2", "a3"):
        graph.add(name)
    assert graph.components() == [[1, 3, 5], [2, 4], [0]]


def test_without_a_keyframe_the_pairs_of_the_others_stay_and_a_new_one_is_compared_with_them(compared):
    graph = ViewGraph(register.Config(squeezes=()))
    for name in ("a1", "a2", "b1", "a3"):
        graph.add(SimpleNamespace(name=name))
    rest = graph.without({"a1", "b1"})
    assert [keyframe.name for keyframe in rest.keyframes] == ["a2", "a3"]
    assert rest.pairs == {(0, 1): "a2a3"}
    rest.add(SimpleNamespace(name="a4"))
    assert set(rest.pairs) == {(0, 1), (0, 2), (1, 2)}
    assert len(graph.keyframes) == 4 and len(graph.pairs) == 3


@pytest.mark.parametrize("pairs", [[(0, 1), (1, 2), (2, 3)], [(2, 3), (0, 1), (1, 2)], [(0, 3), (2, 3), (1, 2)]])
def test_a_chain_is_one_component_in_whatever_order_its_pairs_were_found(pairs):
    graph = ViewGraph(register.Config(squeezes=()))
    graph.keyframes.extend(["a", "b", "c", "d", "e"])
    graph.pairs.update(dict.fromkeys(pairs))
    assert graph.components() == [[0, 1, 2, 3], [4]]


def test_photographs_of_one_place_are_a_pair_and_those_of_two_are_not():
    here, there = photographs()[2:4], places()[5:]
    graph = view_graph([*here, *there])
    assert set(graph.pairs) == {(0, 1)}
    assert len(graph.pairs[0, 1].matches) > 100 and not graph.pairs[0, 1].turned_only
