"""Further keyframes are judged soon from what is known, and thoroughly as if nothing were known."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.config import Config
from splatnode.recon.estimation import FOR_NOW, Judging
from splatnode.recon.geometry import align_cameras
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import continuation, register
from splatnode.recon.verification import reflection
from tests.support.synthetic import photographs, places, view_graph

CONFIG = Config()
REGISTRATION = register.Config()


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return view_graph(photographs()[:4])


@pytest.fixture
def judging() -> Judging:
    return Judging(CONFIG)


def first(graph: ViewGraph, count: int) -> ViewGraph:
    return graph.without({keyframe.name for keyframe in graph.keyframes[count:]})


def test_cameras_of_further_keyframes_are_those_that_a_registration_of_all_finds(graph):
    known = register.register(*_of(first(graph, 3)), REGISTRATION)
    extended = continuation.extended(*_of(graph), known.cameras, REGISTRATION)
    anew = register.register(*_of(graph), REGISTRATION)
    assert [camera.index for camera in extended.cameras] == [camera.index for camera in anew.cameras] == [0, 1, 2, 3]
    Ts, expected = (np.stack([camera.T_world_camera for camera in found.cameras]) for found in (extended, anew))
    similarity = align_cameras(Ts, expected)
    moved = np.stack([similarity.camera(T) for T in Ts])
    spread = np.linalg.norm(expected[:, :3, 3] - expected[:, :3, 3].mean(0), axis=1).max()
    assert np.linalg.norm(moved[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.02 * spread
    assert np.abs(moved[:, :3, :3] - expected[:, :3, :3]).max() < np.radians(0.5)
    assert abs(np.log(extended.cameras[3].focal / anew.cameras[3].focal)) < 0.02


def test_a_lens_of_which_nothing_is_known_has_to_be_registered(graph):
    other = replace(graph.keyframes[3].frame, image=np.ascontiguousarray(graph.keyframes[3].frame.image[:, :150]))
    keyframes = [*graph.keyframes[:3], replace(graph.keyframes[3], frame=other)]
    known = register.register(*_of(first(graph, 3)), REGISTRATION)
    assert continuation.extended(keyframes, graph.pairs, known.cameras, REGISTRATION) is None


def test_a_further_keyframe_is_accepted_for_now_and_then_for_good(graph, judging):
    assert not judging.soon(first(graph, 3), []).verdict.provisional
    soon = judging.soon(graph, [])
    assert soon.verdict.publishable and soon.verdict.provisional and FOR_NOW in soon.verdict.message
    assert [camera.name for camera in soon.evidence.cameras] == [keyframe.name for keyframe in graph.keyframes]
    assert judging.proven == {keyframe.name for keyframe in graph.keyframes[:3]}
    thorough = judging.thorough(graph, [])
    assert thorough.verdict.publishable and not thorough.verdict.provisional
    assert judging.proven == {keyframe.name for keyframe in graph.keyframes}
    assert judging.soon(graph, []) is thorough


def test_a_mirrored_photograph_is_not_accepted_for_now(graph, judging):
    """Where a place is symmetric, the mirror image of a photograph fits to the pixel: only its details tell."""
    photograph = graph.keyframes[3]
    features = replace(
        photograph.features, descriptors=reflection.mirrored_descriptors(photograph.features.descriptors)
    )
    fitting = first(graph, 4)
    fitting.keyframes = [*graph.keyframes[:3], replace(photograph, features=features)]
    assert judging.soon(first(graph, 3), []).verdict.publishable
    assert judging.quickly(fitting, []) is None
    assert judging.quickly(graph, []).verdict.publishable  # the same photograph as it is


def test_another_place_is_not_accepted_for_now(judging):
    frames = places(seeds=(0, 1))
    here_and_there = view_graph([*frames[:3], frames[4]])
    assert judging.soon(first(here_and_there, 3), []).verdict.publishable
    assert not judging.soon(here_and_there, []).verdict.provisional


def test_work_that_is_abandoned_leaves_what_was_known(graph, judging):
    def pause() -> None:
        raise InterruptedError

    judging.soon(first(graph, 3), [])
    with pytest.raises(InterruptedError):
        judging.thorough(graph, [], pause)
    assert judging.soon(graph, []).verdict.provisional


def test_a_thorough_judgement_can_be_abandoned_at_any_of_its_stages(graph):
    whole, calls = Judging(CONFIG), []
    whole.thorough(_not_compared(graph), [], lambda: calls.append(None))
    assert len(calls) > 6 + 3  # pairs, attempts at a map, what speaks for it
    for moment in (1, len(calls) // 2, len(calls)):
        left = iter(range(moment - 1))

        def pause(left=left) -> None:
            if next(left, None) is None:
                raise InterruptedError

        judging = Judging(CONFIG)
        compared = _not_compared(graph)
        with pytest.raises(InterruptedError):
            judging.thorough(compared, [], pause)
        assert judging.proven == frozenset() and judging.thorough(compared, []).verdict.publishable


def test_what_was_refused_is_remembered_whatever_the_order(judging):
    frames = places(seeds=(0, 1))
    strange = view_graph([frames[0], frames[3]])
    assert not judging.thorough(strange, []).verdict.publishable
    names = [keyframe.name for keyframe in strange.keyframes]
    assert judging.refused(names[::-1]) and not judging.refused(names[:1])


def _not_compared(graph: ViewGraph) -> ViewGraph:
    """The same keyframes, nothing known of their pairs."""
    fresh = ViewGraph(CONFIG.matching)
    fresh.keyframes = list(graph.keyframes)
    fresh.pending = set(itertools.combinations(range(len(fresh.keyframes)), 2))
    return fresh


def _of(graph: ViewGraph):
    return graph.keyframes, graph.pairs
