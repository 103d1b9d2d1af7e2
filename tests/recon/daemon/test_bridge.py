"""Two scenes of one place are bridged as they lie; two of different places are not; codes tell what looks alike."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.protocol import compare_cameras
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import loop_closure as module
from splatnode.recon.daemon.loop_closure import (
    LoopSide,
    VerifiedLoop,
    centre_descriptors,
    compute_global_descriptors,
    compute_mean_descriptor,
    make_descriptors_message,
    parse_descriptors,
    rank_similar_scenes,
    verify_loop,
)
from splatnode.recon.daemon.pose_graph import EdgeKind, make_loop_edge
from splatnode.recon.estimation import estimate_cameras, prepare
from splatnode.recon.geometry import Similarity
from splatnode.recon.matching.view_graph import ViewGraph, match
from splatnode.recon.result.verdict import Code
from splatnode.recon.threads import RunContext
from tests.support.synthetic import SMALL

VIEWS = msgspec.structs.replace(SMALL, views=7)
TRUE = synthetic.scene_cameras(VIEWS)
BETWEEN = synthetic.evaluation_cameras(VIEWS)


@pytest.fixture(scope="module")
def graphs() -> dict[str, ViewGraph]:
    """The place, the place again from between those photographs, some of the same photographs, and another place."""
    elsewhere = msgspec.structs.replace(VIEWS, seed=1)
    there = [synthetic.render_image(VIEWS, camera, index) for index, camera in enumerate(TRUE[:4])]
    again = [synthetic.render_image(VIEWS, camera, 10 + index) for index, camera in enumerate(BETWEEN[1:5])]
    other = [synthetic.render_image(elsewhere, camera, index)[:, ::-1].copy() for index, camera in enumerate(TRUE[:4])]
    numbers = itertools.count()
    sets = {"scene-0001": there, "scene-0002": again, "scene-0003": other, "scene-0004": there}
    config = ReconstructionConfig()
    return {
        scene: match(
            [prepare(Frame(next(numbers), f"{i}.png", 0, image, None), config) for i, image in enumerate(images)],
            config.matching,
        )
        for scene, images in sets.items()
    }


@pytest.fixture(scope="module")
def sides(graphs) -> dict[str, LoopSide]:
    codes = {scene: compute_global_descriptors(graph.keyframes) for scene, graph in graphs.items()}
    common = compute_mean_descriptor(codes)
    true = {"scene-0002": cameras(BETWEEN[1:5])}
    return {
        scene: LoopSide(scene, graph, true.get(scene, cameras(TRUE[:4])), centre_descriptors(codes[scene], common))
        for scene, graph in graphs.items()
    }


def cameras(given) -> dict[str, np.ndarray]:
    return {f"{index}.png": T for index, (T, _) in enumerate(given)}


MINE, THEIRS = cameras(TRUE[:4]), cameras(BETWEEN[1:5])


def test_a_place_seen_again_is_bridged_as_it_lies(sides):
    found = verify_loop(sides["scene-0001"], sides["scene-0002"], ReconstructionConfig(), None)
    assert isinstance(found, VerifiedLoop), found
    names = [*(f"there {name}" for name in found.one), *(f"again {name}" for name in found.other)]
    assert len(names) == 8
    true = [*cameras(TRUE[:4]).values(), *cameras(BETWEEN[1:5]).values()]
    K = np.stack([TRUE[0][1]] * len(names))
    errors = compare_cameras(np.stack([*found.one.values(), *found.other.values()]), np.stack(true), K, K)
    assert errors.rotation_deg < 0.5 and errors.centre_pct < 3
    link = make_loop_edge("scene-0001", "scene-0002", MINE, THEIRS, (found.one, found.other), "")
    assert link is not None and abs(link.scale - 1) < 0.05
    assert np.abs(np.array(link.rotation) - np.eye(3)).max() < 0.02


def test_the_link_carries_the_one_scene_onto_the_other():
    turned = Similarity(0.5, cv2.Rodrigues(np.array([0.1, -0.4, 0.2]))[0], np.array([1.0, 2.0, 3.0]))
    together = [{name: turned.camera(T) for name, T in each.items()} for each in (MINE, THEIRS)]
    link = make_loop_edge("scene-0001", "scene-0002", MINE, THEIRS, (together[0], together[1]), "for the test")
    assert link is not None and link.kind is EdgeKind.LOOP and link.why == "for the test"
    assert abs(link.scale - 1) < 1e-3 and np.abs(np.array(link.rotation) - np.eye(3)).max() < 1e-3
    moved = {name: T.copy() for name, T in THEIRS.items()}
    moved["1.png"][:3, 3] += 0.5
    assert make_loop_edge("scene-0001", "scene-0002", MINE, moved, (together[0], together[1]), "") is None


def test_the_same_photographs_have_the_same_cameras(sides):
    found = verify_loop(sides["scene-0001"], sides["scene-0004"], ReconstructionConfig(), None)
    assert isinstance(found, VerifiedLoop), found
    assert found.one.keys() == found.other.keys() and len(found.one) == 4
    for name, T_world_camera in found.one.items():
        np.testing.assert_array_equal(found.other[name], T_world_camera)


def test_different_places_are_not_bridged(sides):
    found = verify_loop(sides["scene-0001"], sides["scene-0003"], ReconstructionConfig(), None)
    assert isinstance(found, str) and "show the same" in found


def test_what_looks_most_alike_comes_first(graphs):
    codes = {scene: compute_global_descriptors(graph.keyframes) for scene, graph in graphs.items()}
    assert rank_similar_scenes("scene-0001", codes) == ["scene-0004", "scene-0002", "scene-0003"]


def test_codes_come_back_as_they_were_kept(graphs):
    keyframes = graphs["scene-0001"].keyframes
    header, arrays = make_descriptors_message(keyframes, codes := compute_global_descriptors(keyframes))
    message = SimpleNamespace(header=header, arrays=arrays)
    np.testing.assert_array_equal(parse_descriptors(message), codes)
    message.arrays = [arrays[0][:-1]]
    with pytest.raises(ValueError, match="another version"):
        parse_descriptors(message)


def test_what_pause_raises_ends_the_work(sides):
    def end() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        verify_loop(sides["scene-0001"], replace(sides["scene-0002"]), ReconstructionConfig(), None, RunContext(end))


@pytest.mark.parametrize(("code", "placed"), [(Code.AMBIGUOUS, 6), (Code.SPLIT, 6), (Code.AMBIGUOUS, 3)])
def test_where_a_few_photographs_do_not_suffice_but_join_both_more_are_asked(sides, monkeypatch, code, placed):
    asked: list[int] = []

    def refused_at_first(graph, *rest):
        estimate = estimate_cameras(graph, *rest)
        asked.append(len(graph.keyframes))
        if len(asked) > 1:
            return estimate
        assert estimate.registration is not None
        registration = replace(estimate.registration, cameras=estimate.registration.cameras[:placed])
        verdict = replace(estimate.verdict, code=code, publishable=False)
        return replace(estimate, registration=registration, verdict=verdict)

    monkeypatch.setattr(module, "VIEWS", (3, 4))
    monkeypatch.setattr(module, "estimate_cameras", refused_at_first)
    found = verify_loop(sides["scene-0001"], sides["scene-0002"], ReconstructionConfig(), None)
    if placed == 6:
        assert isinstance(found, VerifiedLoop), found
        assert asked == [6, 8]
    else:  # photographs of one scene alone have cameras
        assert isinstance(found, str) and asked == [6]
