"""The view graph and the scene come back from the checkpoint as they were."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from splatnode.capture.frame import Intrinsics
from splatnode.capture.messaging.messages import Message, decode, encode
from splatnode.recon.daemon.checkpoint import (
    GraphRecord,
    SceneRecord,
    make_graph_message,
    make_scene_message,
    parse_graph,
    parse_scene,
)
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.registration.registration import undistort_keyframe
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from splatnode.recon.scene import exposure as scene_exposure
from tests.support.synthetic import photographs, tiny_scene, view_graph


def over_the_disk(header, arrays) -> Message:
    return decode([bytes(part) for part in encode(header, arrays)], type(header))


@pytest.fixture(scope="module")
def graph():
    return view_graph(photographs()[:3])


@pytest.fixture(scope="module")
def scene(graph) -> Scene:
    tiny = tiny_scene()
    views = tuple(
        TrainingView(keyframe.name, keyframe.frame.frame_id, keyframe.image, T, K)
        for keyframe, T, K in zip(graph.keyframes, tiny.Ts_world_camera, tiny.Ks, strict=True)
    )
    return Scene(views, replace(tiny.gaussians, source_frame=torch.arange(64, dtype=torch.int32) % 3), 40)


def same(one, other) -> bool:
    """Whether two flat dataclasses are equal to the bit."""
    return all(np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))


def test_features_and_pairs_come_back_to_the_bit(graph):
    graph = replace(graph, pending=frozenset({(0, 2)}))
    found = parse_graph(over_the_disk(*make_graph_message(graph)))
    features, pairs = found.features, found.pairs
    names = [keyframe.name for keyframe in graph.keyframes]
    assert found.pending == [(names[0], names[2])]
    assert list(features) == names
    assert all(same(features[keyframe.name], keyframe.features) for keyframe in graph.keyframes)
    assert len(pairs) == len(graph.pairs) == 3
    for (i, j), pair in graph.pairs.items():
        assert isinstance(pairs[names[i], names[j]], TwoView) and same(pairs[names[i], names[j]], pair)
        assert pairs[names[i], names[j]].is_pure_rotation == pair.is_pure_rotation


def test_the_scene_comes_back_to_the_bit(graph, scene):
    keyframes = {keyframe.name: keyframe for keyframe in graph.keyframes}
    first, *others = scene.views
    scene = replace(scene, views=(replace(first, consistent_depth=0.625), *others))  # of the others it is not known
    found = parse_scene(over_the_disk(*make_scene_message(scene, final=True)), keyframes)
    assert found.iterations == 40
    for field in fields(Gaussians):
        assert torch.equal(getattr(found.gaussians, field.name), getattr(scene.gaussians, field.name))
    for one, other in zip(found.views, scene.views, strict=True):
        assert torch.equal(one.T_world_camera, other.T_world_camera) and torch.equal(one.K, other.K)
        assert (one.name, one.frame_id) == (other.name, other.frame_id)
        assert one.consistent_depth == other.consistent_depth
        assert np.array_equal(one.image, other.image)
    found.gaussians.means.add_(1)  # it can be optimised: its memory is its own


def test_straightened_photographs_are_straightened_again(graph, scene):
    keyframes = {keyframe.name: keyframe for keyframe in graph.keyframes}
    lens = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0, "estimated", (-0.2, 0.0, 0.0, 0.0))
    bent = undistort_keyframe(graph.keyframes[1], lens)
    first, second, third = scene.views
    views = first, replace(second, image=bent.image, lens=lens), third
    found = parse_scene(over_the_disk(*make_scene_message(replace(scene, views=views), final=False)), keyframes)
    assert [view.lens for view in found.views] == [None, lens, None]
    for one, other in zip(found.views, views, strict=True):
        assert np.array_equal(one.image, other.image)
    header, arrays = make_scene_message(scene, final=False)
    earlier = SceneRecord(header.views, header.iterations, header.final)  # of a version that knew no lenses
    assert all(view.lens is None for view in parse_scene(over_the_disk(earlier, arrays), keyframes).views)


def test_a_scene_of_which_a_frame_is_gone_is_made_anew(graph, scene):
    keyframes = {keyframe.name: keyframe for keyframe in graph.keyframes[1:]}
    assert parse_scene(over_the_disk(*make_scene_message(scene, final=False)), keyframes) is None


def test_what_another_version_wrote_is_told(graph, scene):
    header, arrays = make_graph_message(graph)
    strange = GraphRecord(header.names, [{"colour": 1.0}, *header.features[1:]], header.pairs, [])
    with pytest.raises(ValueError, match="Features with colour"):
        parse_graph(Message(strange, tuple(arrays)))
    with pytest.raises(ValueError, match="missing"):
        parse_graph(Message(header, tuple(arrays[:-1])))
    record, arrays = make_scene_message(scene, final=False)
    with pytest.raises(ValueError, match="arrays"):
        parse_scene(
            Message(SceneRecord(record.views, 1, False), tuple(arrays[1:])), {k.name: k for k in graph.keyframes}
        )


def test_the_gains_of_a_scenes_photographs_come_back(graph, scene):
    keyframes = {keyframe.name: keyframe for keyframe in graph.keyframes}
    image, exposure = scene_exposure.compensate_image(
        graph.keyframes[1].image, (2.0, 1.5, 0.5), 0.7, (0.01, 0.02, 0.03)
    )
    first, second, third = scene.views
    lit = replace(scene, views=(first, replace(second, image=image, exposure=exposure), third))
    header, arrays = make_scene_message(lit, final=False)
    found = parse_scene(over_the_disk(header, arrays), keyframes)
    assert [view.exposure and view.exposure.gains for view in found.views] == [None, (2.0, 1.5, 0.5), None]
    assert [view.exposure and view.exposure.falloff for view in found.views] == [None, 0.7, None]
    assert [view.exposure and view.exposure.sigmas for view in found.views] == [None, (0.01, 0.02, 0.03), None]
    assert np.array_equal(found.views[1].image, image) and found.headroom == 1.0
    darker = parse_scene(over_the_disk(*make_scene_message(replace(lit, headroom=1.25), final=False)), keyframes)
    assert darker.headroom == 1.25
    earlier = SceneRecord(header.views, header.iterations, header.final)  # of a version that knew no gains
    assert all(view.exposure is None for view in parse_scene(over_the_disk(earlier, arrays), keyframes).views)
