"""Things that moved between photographs are found by their matches, and nothing else is taken for one."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
import pytest

from splatnode.recon.config import apply_changes, preset
from splatnode.recon.matching.view_graph import MovingObjectsConfig, ViewGraph, mask_moving_objects, moving_masks
from splatnode.recon.pipeline import reconstruct_stream, run
from splatnode.recon.result.report import build_report
from tests.support.moving import look_of, pasted
from tests.support.synthetic import SMALL, errors, photographs, view_graph

SHARE = 0.2
CONFIG = apply_changes(preset("preview"), {"size": 320})


@lru_cache(maxsize=1)
def with_thing():
    """The photographs with a thing pasted over each, and what it leaves free."""
    return [
        pasted(frame, SHARE, seed, look_of(7, SMALL.width, SMALL.height)) for seed, frame in enumerate(photographs())
    ]


@lru_cache(maxsize=2)
def graph_of(thing: bool) -> ViewGraph:
    return view_graph([frame for frame, _ in with_thing()] if thing else list(photographs()))


def test_a_thing_that_moved_is_found_in_every_photograph_and_little_else():
    masks = moving_masks(graph_of(True))
    for frame, free in with_thing():
        hidden = ~masks[frame.name]
        assert hidden[~free].mean() > 0.9, f"{hidden[~free].mean():.2f} of the thing in {frame.name}"
        assert hidden[free].mean() < 0.12, f"{hidden[free].mean():.2f} of the rest of {frame.name}"


def test_nothing_is_found_where_nothing_moved():
    graph = graph_of(False)
    assert moving_masks(graph) == {}
    assert mask_moving_objects(graph, None) is graph


def test_no_match_is_on_the_thing_afterwards():
    graph = mask_moving_objects(graph_of(True), None)
    free = {frame.name: mask for frame, mask in with_thing()}
    for (i, j), pair in graph.pairs.items():
        for side, index in enumerate((i, j)):
            keyframe = graph.keyframes[index]
            x, y = keyframe.features.points[pair.matches[:, side]].astype(int).T
            assert free[keyframe.name][y, x].mean() > 0.99
        assert 0.8 * SHARE < graph.keyframes[i].moving < 1.6 * SHARE


def test_the_scene_is_reconstructed_without_it_and_the_report_names_its_share():
    snapshot = run([frame for frame, _ in with_thing()], CONFIG)
    assert snapshot.verdict.publishable and len(snapshot.cameras) == SMALL.views
    assert errors(snapshot, SMALL).rotation_deg < 0.3
    report = build_report(snapshot, seed=0, preset="preview", peak_rss_mb=None)
    assert report["masked"] == {}
    assert report["moving"] == {frame.name: pytest.approx(SHARE, rel=0.6) for frame, _ in with_thing()}


def test_a_live_scene_leaves_it_out_once_it_is_final():
    frames = [frame for frame, _ in with_thing()]
    *_, live = reconstruct_stream(frames, CONFIG)
    offline = run(frames, CONFIG)
    assert live.final and live.verdict.publishable and live.moving == offline.moving
    placed = [{each.name: each.T_world_camera for each in snapshot.cameras} for snapshot in (live, offline)]
    assert placed[0].keys() == placed[1].keys() == {frame.name for frame in frames}
    for name, T_world_camera in placed[1].items():
        np.testing.assert_allclose(placed[0][name], T_world_camera, atol=1e-6)


def test_it_can_be_switched_off():
    graph = graph_of(True)
    off = replace(
        graph, config=msgspec.structs.replace(graph.config, dynamic_objects=MovingObjectsConfig(enabled=False))
    )
    assert moving_masks(off) == {} and moving_masks(graph) != {}
