"""Further keyframes are judged soon from what is known, and thoroughly as if nothing were known."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import PROVISIONAL, extend_reconstruction
from splatnode.recon.geometry import align_cameras
from splatnode.recon.incremental import IncrementalReconstruction, ReconstructionCache, StreamState
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import registration
from splatnode.recon.threads import RunContext
from splatnode.recon.verification import evidence
from tests.support.synthetic import photographs, places, view_graph

CONFIG = ReconstructionConfig()
REGISTRATION = registration.RegistrationConfig()


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return view_graph(photographs()[:4])


def holding(graph: ViewGraph, memory: ReconstructionCache | None = None) -> IncrementalReconstruction:
    """A reconstruction that has the keyframes of `graph`, and remembers these estimates."""
    known = StreamState(graph, ViewGraph(graph.config), memory=memory or ReconstructionCache())
    return IncrementalReconstruction(CONFIG, known)


def first(graph: ViewGraph, count: int) -> ViewGraph:
    return graph.remove_keyframes({keyframe.name for keyframe in graph.keyframes[count:]})


def test_cameras_of_further_keyframes_are_those_that_a_registration_of_all_finds(graph):
    known = registration.register(*_of(first(graph, 3)), REGISTRATION)
    extended = registration.extend_registration(*_of(graph), known.cameras, REGISTRATION)
    anew = registration.register(*_of(graph), REGISTRATION)
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
    known = registration.register(*_of(first(graph, 3)), REGISTRATION)
    assert registration.extend_registration(keyframes, graph.pairs, known.cameras, REGISTRATION) is None


def test_a_further_keyframe_is_accepted_provisionally_and_then_for_good(graph):
    before = holding(first(graph, 3))
    assert not before.estimate_soon().verdict.provisional
    work = holding(graph, before.state.memory)
    soon = work.estimate_soon()
    assert soon.verdict.publishable and soon.verdict.provisional and PROVISIONAL in soon.verdict.message
    assert [camera.name for camera in soon.evidence.cameras] == graph.names
    assert work.publishable_names == set(graph.names[:3])
    claimed = soon.bounds
    thorough = work.estimate_thoroughly()
    for name, bounds in thorough.bounds.items():
        assert bounds.rotation_deg <= claimed[name].rotation_deg
        assert bounds.centre_percent <= claimed[name].centre_percent
        assert bounds.focal_percent <= claimed[name].focal_percent
    assert thorough.publishable and not thorough.verdict.provisional and work.publishable_names == set(graph.names)
    assert work.estimate_soon() is thorough


def test_two_keyframes_are_no_start_for_a_quick_estimate(graph):
    pair = holding(first(graph, 2)).estimate_soon()
    assert (
        len(pair.graph.keyframes) == 2 and extend_reconstruction(pair, first(graph, 3), ReconstructionConfig()) is None
    )


def test_a_mirrored_photograph_is_not_accepted_provisionally(graph):
    """Where a place is symmetric, the mirror image of a photograph fits to the pixel: only its details tell."""
    photograph = graph.keyframes[3]
    features = replace(photograph.features, descriptors=evidence.mirror_descriptors(photograph.features.descriptors))
    fitting = replace(graph, keyframes=(*graph.keyframes[:3], replace(photograph, features=features)))
    before = holding(first(graph, 3))
    assert before.estimate_soon().publishable
    assert holding(fitting, before.state.memory).estimate_quickly() is None
    assert holding(graph, before.state.memory).estimate_quickly().publishable  # the same photograph as it is


def test_another_place_is_not_accepted_provisionally():
    frames = places(seeds=(0, 1))
    here_and_there = view_graph([*frames[:3], frames[4]])
    before = holding(first(here_and_there, 3))
    assert before.estimate_soon().publishable
    assert not holding(here_and_there, before.state.memory).estimate_soon().verdict.provisional


def test_work_that_is_abandoned_leaves_what_was_known(graph):
    def pause() -> None:
        raise InterruptedError

    before = holding(first(graph, 3))
    before.estimate_soon()
    work = holding(graph, before.state.memory)
    with pytest.raises(InterruptedError):
        work.estimate_thoroughly(RunContext(pause))
    assert work.state.memory is before.state.memory and work.estimate_soon().verdict.provisional


def test_a_thorough_estimate_can_be_abandoned_at_any_of_its_stages(graph):
    fresh, calls = match_later(graph), []
    holding(fresh).estimate_thoroughly(RunContext(lambda: calls.append(None)))
    assert len(calls) > 6 + 3  # pairs, attempts at a map, what speaks for it
    for moment in (1, len(calls) // 2, len(calls)):
        left = iter(range(moment - 1))

        def pause(left=left) -> None:
            if next(left, None) is None:
                raise InterruptedError

        work = holding(fresh)
        with pytest.raises(InterruptedError):
            work.estimate_thoroughly(RunContext(pause))
        assert work.publishable_names == frozenset() and work.find_reconstruction() is None
        assert len(work.graph.pending) == max(6 - moment, 0)  # what was compared by then is kept
        assert work.estimate_thoroughly().publishable


def test_what_was_refused_is_remembered_whatever_the_order():
    frames = places(seeds=(0, 1))
    work = holding(view_graph([frames[0], frames[3]]))
    assert not work.estimate_thoroughly().publishable
    assert work.is_rejected(work.names[::-1]) and not work.is_rejected(work.names[:1])


def test_a_snapshot_computes_nothing(graph):
    work = holding(graph)
    with pytest.raises(RuntimeError, match="estimate_soon"):
        work.snapshot()
    work.estimate_soon()
    assert work.snapshot().verdict.publishable
    work.remove_keyframes({graph.names[0]})
    with pytest.raises(RuntimeError, match="estimate_soon"):
        work.snapshot()


def match_later(graph: ViewGraph) -> ViewGraph:
    """The same keyframes, nothing known of their pairs."""
    pending = frozenset(itertools.combinations(range(len(graph.keyframes)), 2))
    return ViewGraph(CONFIG.matching, graph.keyframes, pending=pending)


def _of(graph: ViewGraph):
    return graph.keyframes, graph.pairs
