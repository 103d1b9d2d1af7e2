"""The live map of free space: of the scene that is shown, as `splatnode occupancy` makes it; else it is taken back."""

from __future__ import annotations

import time
from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

import splatnode
from splatnode.recon.daemon import ReconState
from splatnode.recon.daemon.free_space import LOST, NOT_FINAL, OccupancyConfig, OccupancyMapper
from splatnode.recon.daemon.relocalization import FinalScene
from splatnode.recon.daemon.submap import Abandoned
from splatnode.recon.occupancy import OccupancyMap
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.threads import BACKGROUND, RunContext
from tests.recon.daemon.test_daemon import PATIENCE_S, Peer, config, finished, peer, running  # noqa: F401
from tests.support.occupied import room_snapshot
from tests.support.synthetic import photographs, places

LIVE = OccupancyConfig(live=True)


def map_when(peer: Peer, node: splatnode.Node, ready) -> splatnode.NodeMap:  # noqa: F811
    deadline = time.monotonic() + PATIENCE_S
    while not ready(node.map):
        assert time.monotonic() < deadline, node.map
        peer.server.serve(0.01)
        peer.client.poll(0.02)
    return node.map


def same(one: OccupancyMap, other: OccupancyMap) -> bool:
    numbers = all(
        np.allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-9)
        for name in ("voxel", "origin", "T_world_map")
    )
    return numbers and one.upright.source == other.upright.source and one.scale == other.scale


def test_the_map_is_sent_once_the_scene_is_final_and_goes_when_the_camera_is_lost(config, peer):  # noqa: F811
    frames = places(seeds=(0, 1))
    with (
        running(replace(config, occupancy=LIVE, new_submap_after=3)),
        splatnode.connect(config.network.directory) as node,
    ):
        assert node.wait_for_map(0.0).occupancy is None
        for frame in frames[:3]:
            peer.server.offer(frame)
        peer.wait(lambda scene: len(scene.snapshot.cameras) == 3, "a scene of three")
        assert node.map.occupancy is None
        scene = peer.wait(finished(3), "a final scene")
        told = map_when(peer, node, lambda told: told.occupancy is not None)
        assert told.scene_id == scene.scene_id == "scene-0001" and told.why == ""
        saved = splatnode.load(config.out / "scene-0001").map()
        assert np.array_equal(told.occupancy.states, saved.states) and same(told.occupancy, saved)
        assert told.occupancy.shares["free"] > 0.02
        peer.server.offer(frames[3])  # of another place: it does not fit
        lost = map_when(peer, node, lambda told: told.occupancy is None)
        assert lost.scene_id == "scene-0001" and lost.why
        for frame in frames[4:]:
            peer.server.offer(frame)
        other = map_when(peer, node, lambda told: told.occupancy is not None and told.scene_id != "scene-0001")
        assert np.array_equal(other.occupancy.states, splatnode.load(config.out / "scene-0002").map().states)


def test_a_restarted_node_sends_the_map_again_and_none_where_it_is_not_configured(config, peer):  # noqa: F811
    with splatnode.connect(config.network.directory) as node:
        with running(config):
            for frame in photographs()[:3]:
                peer.server.offer(frame)
            first = peer.wait(finished(3), "a final scene")
            peer.wait_for_acknowledgements()
            assert "occupancy.live" in node.wait_for_map(0.5).why
        with running(replace(config, occupancy=OccupancyConfig(live=True, voxel=0.05))):
            told = map_when(peer, node, lambda told: told.occupancy is not None)
            saved = splatnode.load(config.out / "scene-0001").map(voxel=0.05)
            assert told.scene_id == first.scene_id and np.array_equal(told.occupancy.states, saved.states)
        with running(config):
            gone = map_when(peer, node, lambda told: told.occupancy is None)
            assert "has changed" in gone.why


def test_a_refusal_is_told_with_its_reason(config, peer):  # noqa: F811
    with running(replace(config, occupancy=LIVE)), splatnode.connect(config.network.directory) as node:
        peer.server.offer(photographs()[0])
        told = map_when(peer, node, lambda told: "TOO_FEW_VIEWS" in told.why)
        assert told.occupancy is None and told.why.startswith("there is no scene: TOO_FEW_VIEWS")


def test_a_map_is_abandoned_for_a_keyframe_and_made_afterwards(tmp_path):
    scene, calls = FinalScene(room_snapshot(), ()), iter(range(100))

    def interrupted() -> None:
        if next(calls) == 2:
            raise Abandoned

    space, run = OccupancyMapper(LIVE), RunContext(interrupted)
    with pytest.raises(Abandoned):
        space.map_scene(scene, ReconState.IDLE, tmp_path, run)
    assert space.find_current_map(scene, ReconState.IDLE) == NOT_FINAL
    assert space.map_scene(scene, ReconState.IDLE, tmp_path, run)
    assert not space.map_scene(scene, ReconState.IDLE, tmp_path, run)
    found = space.find_current_map(scene, ReconState.IDLE)
    assert not isinstance(found, str) and found.occupancy is not None
    assert (
        space.find_current_map(scene, ReconState.LOST) == LOST
        and space.find_current_map(None, ReconState.GROWING) == NOT_FINAL
    )


def test_rough_cameras_and_voxels_that_are_too_many_give_no_map_but_a_reason(tmp_path):
    room = room_snapshot()
    rough = changed(room, verdict=Verdict(Code.OK_ROUGH, "Rough.", "Take more.", publishable=True))
    cases = ((rough, None, "could call free what is solid"), (room, 1e-6, "give a voxel of at least"))
    for snapshot, voxel, why in cases:
        space, scene = OccupancyMapper(OccupancyConfig(live=True, voxel=voxel)), FinalScene(snapshot, ())
        assert space.map_scene(scene, ReconState.IDLE, tmp_path, BACKGROUND)
        found = space.find_current_map(scene, ReconState.IDLE)
        assert not isinstance(found, str) and found.occupancy is None and why in found.why
