"""A scene that takes further views in, or lets views go, keeps what it has learnt to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatnode.capture.frame import ExposureSettings
from splatnode.recon.result.snapshot import decode_frame_id, encode_unconfirmed
from splatnode.recon.scene import background, exposure
from splatnode.recon.scene.growth import NUM_NEIGHBOURS, grow, limit_gaussians, remove_views
from splatnode.recon.scene.initialization import SceneInitializationConfig
from tests.support.row_of_views import STEP, WIDTH, graph_of, maps_of, registration_of, scene_of

CONFIG = SceneInitializationConfig()
LIGHT = exposure.ExposureConfig()


def test_growing_adds_a_further_views_gaussians_and_leaves_all_others_as_they_are():
    graph, before = graph_of(4), 3
    scene = scene_of(before, graph)
    grown = grow(scene, maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT)
    count = len(scene.gaussians)
    assert [view.name for view in grown.views] == ["00.png", "01.png", "02.png", "03.png"]
    assert torch.equal(grown.gaussians.means[:count], scene.gaussians.means)
    added = grown.gaussians.subset(torch.arange(count, len(grown.gaussians)))
    assert set(decode_frame_id(added.source_frame).tolist()) == {3}
    # Only what it sees to the right of the view before it is new: a step of 0.3 at depth 2 is 5.3 of 32 columns.
    visible_before = (STEP * 2) + 2.0 * (WIDTH / 2) / (1.1 * WIDTH)
    assert len(added) > 20 and float(added.means[:, 0].min()) > visible_before - 0.3


def test_a_further_view_is_compared_with_its_neighbours_only():
    count = NUM_NEIGHBOURS + 3
    graph = graph_of(count)
    near = maps_of(range(count - NUM_NEIGHBOURS - 1, count))  # growing does not ask for the maps of the others
    grown = grow(scene_of(count - 1, graph), near, graph, registration_of(count), CONFIG, LIGHT)
    assert len(grown.views) == count


def test_a_further_view_that_shares_too_little_has_the_light_that_its_camera_tells():
    told = {index: ExposureSettings(0.01 if index < 3 else 0.04, 100.0) for index in range(4)}
    gain = 4.0 ** (1.0 / 2.2)
    for exposures, expected in ((told, gain), ({}, None), ({3: told[3]}, None)):
        graph = graph_of(4, exposures)
        grown = grow(scene_of(3, graph), maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT)
        joined, image = grown.views[-1], graph.keyframes[3].image
        if expected is None:
            assert joined.exposure is None and np.array_equal(joined.image, image)
        else:
            assert joined.exposure is not None and joined.exposure.gains == pytest.approx((expected,) * 3, rel=0.05)
            assert joined.image.mean() == pytest.approx(image.mean() / expected, rel=0.05)


def test_guesses_where_a_further_camera_stands_go_and_what_two_views_saw_stays():
    graph = graph_of(4)
    scene = scene_of(3, graph)
    there = torch.tensor([3 * STEP, 0.0, 0.1])  # just before the camera that comes
    moved, guess = scene.gaussians.means.clone(), scene.gaussians.source_frame.clone()
    moved[:2], guess[0], guess[1] = there, encode_unconfirmed(0), 0
    scene = replace(scene, gaussians=replace(scene.gaussians, means=moved, source_frame=guess))
    grown = grow(scene, maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT)
    at = (grown.gaussians.means - there).norm(dim=1) < 1e-6
    assert grown.gaussians.source_frame[at].tolist() == [0]
    assert torch.equal(grown.gaussians.means[: len(moved) - 1], moved[1:])


def test_without_a_further_view_nothing_changes():
    graph = graph_of(3)
    scene = scene_of(3, graph)
    assert grow(scene, {}, graph, registration_of(3), CONFIG, LIGHT) is scene


def test_a_bound_on_gaussians_keeps_those_that_cover_most():
    graph = graph_of(4)
    scene = scene_of(3, graph)
    limit = len(scene.gaussians) // 2
    grown = limit_gaussians(grow(scene, maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT), limit)
    assert len(grown.gaussians) == limit
    assert int((grown.gaussians.source_frame == background.SHELL).sum()) > 0


def test_a_view_that_goes_takes_its_gaussians_along_and_the_next_becomes_the_world():
    graph = graph_of(3)
    scene = scene_of(3, graph)
    rest = remove_views(scene, {"00.png"})
    assert [view.name for view in rest.views] == ["01.png", "02.png"]
    assert 0 not in decode_frame_id(rest.gaussians.source_frame)
    np.testing.assert_allclose(rest.views[0].T_world_camera, np.eye(4), atol=1e-6)
    kept = scene.gaussians.subset(decode_frame_id(scene.gaussians.source_frame) != 0)
    torch.testing.assert_close(rest.gaussians.means, kept.means - torch.tensor([STEP, 0, 0]), rtol=0, atol=1e-5)
    assert remove_views(scene, {"00.png", "01.png", "02.png"}).views == ()


def test_growing_tells_how_much_of_the_depth_further_views_confirm_and_a_view_that_goes_takes_that_along():
    graph = graph_of(4)
    scene = scene_of(2, graph)
    scene = replace(scene, views=tuple(replace(view, consistent_depth=0.3) for view in scene.views))
    grown = grow(scene, maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT)
    first, second, third, fourth = (view.consistent_depth for view in grown.views)
    assert min(first, second, third, fourth) > 0.5  # the views overlap, and show one wall
    more = replace(grown.views[0], consistent_depth=0.999)  # by views that are no neighbours
    again = replace(grown, views=(more, *grown.views[1:3]))
    kept = grow(again, maps_of(range(4)), graph, registration_of(4), CONFIG, LIGHT)
    assert kept.views[0].consistent_depth == 0.999
    rest = remove_views(grown, {"03.png"})
    assert [view.consistent_depth for view in rest.views] == [None] * 3
