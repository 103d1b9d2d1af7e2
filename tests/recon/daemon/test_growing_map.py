"""Free space of a scene that grows: marked provisional, with bounds, replaced by the final map, withdrawn with it."""

from __future__ import annotations

import threading
import time
from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

import splatnode
from splatnode.capture.cameras import synthetic
from splatnode.capture.messaging.messages import Numbering, decode, encode
from splatnode.capture.process.terminal import Problems
from splatnode.recon.daemon import free_space
from splatnode.recon.daemon.free_space import (
    LOST,
    NOT_FINAL,
    OLD_DEPTHS,
    GrowingMapper,
    GrowingScene,
    OccupancyConfig,
    ProvisionalMap,
    add_growing_depths,
    drop_normals,
    map_growing_scene,
)
from splatnode.recon.daemon.output import PublishedSnapshot, _match_shown_scene
from splatnode.recon.geometry import align_cameras
from splatnode.recon.occupancy import MapHeader, VoxelState, encode_map, make_provisional_record, occupancy_map
from splatnode.recon.priors import Pointmap
from splatnode.recon.result.verdict import Bounds, Code, Verdict, make_ball
from tests.bench.quality.solid import inside
from tests.recon.daemon.test_daemon import PATIENCE_S, config, finished, peer, running  # noqa: F401
from tests.recon.daemon.test_free_space import map_when
from tests.support.occupied import HEIGHT, WIDTH, K, room_snapshot, seen_depth, small_map
from tests.support.synthetic import SMALL, photographs

GROWING = OccupancyConfig(live=True, provisional=True)


def room_pointmaps(scale: float = 1.0, shift: float = 0.0) -> dict[str, Pointmap]:
    """What the room's cameras see, in a world `scale` times as large; the last camera is off by `shift`."""
    found = {}
    for camera in room_snapshot().cameras:
        depth = np.kron(seen_depth(camera.T_world_camera), np.ones((2, 2), np.float32))
        T = camera.T_world_camera.copy()
        T[:3, 3] *= scale
        found[camera.name] = Pointmap(
            camera.name, camera.frame_id, np.where(np.isfinite(depth), scale * depth, 0).astype(np.float32),
            np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float32), T, K,
        )  # fmt: skip
    last = max(found)
    T = found[last].T_world_camera.copy()
    T[0, 3] += shift
    return found | {last: changed(found[last], T_world_camera=T)}


def growing(**other) -> GrowingScene:
    snapshot = changed(room_snapshot(), depths={}, final=False)
    known = {"snapshot": snapshot, "scene_id": "a", "sequence": 1, "revision": 1, "pointmaps": room_pointmaps()}
    return GrowingScene(**(known | {"shown_s": 0.0} | other))


def no_pause() -> None:
    pass


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_depths_of_a_growing_scene_come_in_the_unit_of_what_is_shown(scale):
    snapshot = add_growing_depths(growing().snapshot, room_pointmaps(scale))
    assert snapshot is not None
    for camera in snapshot.cameras:
        found, true = snapshot.depths[camera.name].astype(float), seen_depth(camera.T_world_camera)
        assert (found > 0).mean() > 0.3
        assert np.median(np.abs(found / true - 1)[found > 0]) < 0.01


def test_a_growing_room_is_mapped_as_a_final_one_and_nothing_solid_is_free():
    made = map_growing_scene(growing(), 0.05, no_pause).occupancy
    final = occupancy_map(room_snapshot(), 0.05)
    assert made is not None and made.voxel == final.voxel
    less = map_growing_scene(growing(pointmaps=drop_normals(room_pointmaps())), 0.05, no_pause).occupancy
    assert less is not None and np.array_equal(less.states, made.states)
    assert abs(made.shares["free"] - final.shares["free"]) < 0.05
    index = np.argwhere(made.states == VoxelState.FREE)
    centres = (made.origin + (index + 0.5) * made.voxel) @ made.T_world_map[:3, :3].T + made.T_world_map[:3, 3]
    assert len(centres) > 100 and centres[:, 0].max() < 2.0 and centres[:, 2].min() > 0.0


def test_depths_of_other_cameras_than_those_shown_and_rough_verdicts_give_a_reason():
    moved = map_growing_scene(growing(pointmaps=room_pointmaps(shift=0.5)), None, no_pause)
    assert moved.occupancy is None and moved.why == OLD_DEPTHS
    assert map_growing_scene(growing(pointmaps={}), None, no_pause).why == OLD_DEPTHS
    rough = Verdict(Code.OK_ROUGH, "Rough.", "Take more.", publishable=True, provisional=True)
    refused = map_growing_scene(growing(snapshot=changed(growing().snapshot, verdict=rough)), None, no_pause)
    assert refused.occupancy is None and "could call free what is solid" in refused.why


def test_the_newest_scene_is_mapped_and_a_scene_that_fails_keeps_none_from_the_next(monkeypatch):
    stopping, problems = threading.Event(), Problems()
    mapper = GrowingMapper(0.1, problems, stopping)
    thread = threading.Thread(target=mapper.run)
    fails = growing(revision=7)
    whole = map_growing_scene

    def fail_once(scene, *rest):
        if scene is fails:
            raise ZeroDivisionError
        return whole(scene, *rest)

    monkeypatch.setattr(free_space, "map_growing_scene", fail_once)
    thread.start()
    try:
        for scene in (fails, growing(revision=8)):
            mapper.show(scene)
            deadline = time.monotonic() + 30.0
            while mapper.made is None or mapper.made.of is not scene:
                assert time.monotonic() < deadline
                time.sleep(0.01)
    finally:
        stopping.set()
        thread.join()
    assert mapper.made.occupancy is not None and "ZeroDivisionError" in str(problems)


def test_viewers_get_the_growing_map_unless_the_camera_is_lost_or_the_scene_is_refused():
    made, shown = ProvisionalMap(growing(), None, "why"), PublishedSnapshot(growing().snapshot, "a")
    assert _match_shown_scene(NOT_FINAL, shown, made) is made
    assert _match_shown_scene(LOST, shown, made) == LOST and _match_shown_scene(NOT_FINAL, shown, None) == NOT_FINAL
    refused = changed(growing().snapshot, verdict=Verdict(Code.AMBIGUOUS, "Two fit.", "Take more."))
    assert "AMBIGUOUS" in str(_match_shown_scene(NOT_FINAL, PublishedSnapshot(refused, "a"), made))


def test_a_provisional_map_tells_its_bounds_and_a_final_one_is_the_message_that_it_was():
    first, *rest = room_snapshot().cameras
    cameras = [changed(first, bounds=Bounds(2.0, 0.1, 5.0, 1.0, make_ball(0.1))), *rest]
    record = make_provisional_record(3, cameras)
    header, arrays = encode_map(small_map(np.ones((1, 1, 1))), "a", 7, Numbering().next(), record)
    told = decode(encode(header, arrays), MapHeader).header.map.provisional
    assert (told.revision, told.views, told.rotation_deg, told.centre_percent) == (3, 3, 2.0, 5.0)
    assert make_provisional_record(3, rest).rotation_deg is None
    header, arrays = encode_map(small_map(np.ones((1, 1, 1))), "a", 7, Numbering().next())
    assert b"provisional" not in bytes(encode(header, arrays)[1])


def test_a_node_maps_while_it_grows_and_the_final_map_replaces_that(config, peer):  # noqa: F811
    """The map is of a scene of quick cameras: what it calls free is air, but for a few voxels."""
    frames = photographs()
    slow = replace(config, occupancy=GROWING, idle_finalize_s=4.0)
    with running(slow), splatnode.connect(config.network.directory) as node:
        for frame in frames[:3]:
            peer.server.offer(frame)
        told = map_when(peer, node, lambda told: told.provisional)
        assert told.occupancy is not None and told.views == 3 and told.bounds is not None and told.bounds[0] > 0
        for frame in frames[3:5]:
            peer.server.offer(frame)
        later = map_when(peer, node, lambda told: told.provisional and told.views == 5)
        shown = node.wait(PATIENCE_S)
        assert shown is not None and len(shown.result.cameras) == 5
        own = np.stack([camera.T_world_camera for camera in shown.result.cameras])
        numbers = {frame.name: frame.frame_id for frame in frames}
        true = [synthetic.scene_cameras(SMALL)[numbers[camera.name]][0] for camera in shown.result.cameras]
        free = np.argwhere(later.occupancy.states == VoxelState.FREE)
        T = later.occupancy.T_world_map
        centres = (later.occupancy.origin + (free + 0.5) * later.occupancy.voxel) @ T[:3, :3].T + T[:3, 3]
        assert len(free) > 1000
        assert inside(synthetic.solids(SMALL), align_cameras(own, np.stack(true))(centres)).mean() < 0.01
        peer.wait(finished(5), "a final scene")
        final = map_when(peer, node, lambda told: told.occupancy is not None and not told.provisional)
        assert final.views is None and final.bounds is None
        assert np.array_equal(final.occupancy.states, splatnode.load(config.out / "scene-0001").map().states)
