"""Which poses hold: a world stays while a scene grows, and is another one once the scene is made afresh."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from splatnode.recon.daemon import MOST_WORLDS, REBUILT, WorldRevisions, explain_moved_cameras, output
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.daemon.submap_index import SubmapState
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Bounds, Code, Verdict, make_ball
from tests.support.exported import make_snapshot

BOUNDS = Bounds(1.0, 0.1, 10.0, 1.0, make_ball(0.1))


def camera(number: int, x: float = 0.0, turn_deg: float = 0.0, bounds: Bounds | None = BOUNDS) -> CameraEstimate:
    T, angle = np.eye(4), np.radians(turn_deg)
    T[:3, 3] = number + x, 0.0, 0.0
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return CameraEstimate(f"{number}.png", number, T, np.diag([100.0, 100.0, 1.0]), 64, 48, bounds)


def growing(*cameras: CameraEstimate) -> Snapshot:
    return replace(make_snapshot(), cameras=cameras, final=False)


def test_a_scene_that_grows_keeps_its_world_and_one_that_is_made_afresh_does_not():
    revisions = WorldRevisions()
    first = revisions.update("a", growing(camera(0), camera(1)))
    assert first.provisional and not first.why
    assert revisions.update("a", growing(camera(0), camera(1, 0.05), camera(2))) == first
    final = revisions.update("a", replace(growing(camera(0), camera(1, 0.05), camera(2)), final=True))
    assert (final.why, final.provisional) == (REBUILT, False) and final.revision > first.revision
    further = revisions.update("a", growing(camera(0), camera(1, 0.05), camera(2), camera(3)))
    assert further.revision == final.revision and further.provisional  # it goes on from the final scene
    assert revisions.records == (further,)


@pytest.mark.parametrize(
    ("now", "why"),
    [
        ((camera(0), camera(1, 0.11)), "1.png moved by more than its bounds"),
        ((camera(0), camera(1, turn_deg=1.1)), "1.png moved by more than its bounds"),
        ((camera(0), camera(2)), "1.png was removed"),
        ((camera(0), camera(1, 0.09, 0.9)), ""),
    ],
)
def test_cameras_that_go_or_move_beyond_their_bounds_withdraw_what_was_told(now, why):
    before = (camera(0), camera(1))
    assert why in explain_moved_cameras(before, now) and bool(why) == bool(explain_moved_cameras(before, now))
    revisions = WorldRevisions()
    first = revisions.update("a", growing(*before))
    assert (revisions.update("a", growing(*now)).revision > first.revision) == bool(why)


def test_cameras_without_bounds_may_hardly_move():
    before = (camera(0, bounds=None), camera(1, bounds=None))
    assert not explain_moved_cameras(before, (camera(0, bounds=None), camera(1, 0.009, bounds=None)))
    assert "moved" in explain_moved_cameras(before, (camera(0, bounds=None), camera(1, 0.011, bounds=None)))


def test_a_scene_that_is_refused_later_withdraws_what_was_told():
    revisions = WorldRevisions()
    first = revisions.update("a", growing(camera(0), camera(1)))
    refused = Verdict(Code.AMBIGUOUS, "Two scenes fit.", "Take more.")
    now = revisions.update("a", replace(growing(), verdict=refused))
    assert now.revision > first.revision and now.why == "there is no scene any more: AMBIGUOUS"


def test_scenes_that_the_camera_left_are_withdrawn_when_they_are_made_afresh_and_the_oldest_are_forgotten():
    revisions = WorldRevisions()
    left = revisions.update("left", growing(camera(0), camera(1)))
    revisions.update("here", growing(camera(0), camera(1)))
    revisions.rebuild("never shown", (camera(0),))
    revisions.rebuild("left", (camera(0), camera(1)))
    told = {record.scene_id: record for record in revisions.records}
    assert told.keys() == {"left", "here"}
    assert told["left"].revision > left.revision and told["left"].why == REBUILT and not told["left"].provisional
    for number in range(MOST_WORLDS):
        revisions.update(f"scene-{number}", growing(camera(0)))
    assert len(revisions.records) == MOST_WORLDS and "left" not in {each.scene_id for each in revisions.records}


@pytest.mark.parametrize(("scene_id", "withdrawn"), [("scene-0001", True), ("scene-0002", False)])
def test_writing_the_result_of_a_scene_that_the_camera_left_withdraws_its_poses(
    scene_id, withdrawn, tmp_path, monkeypatch
):
    """The present scene, scene-0002, is told of when it is shown."""
    revisions = WorldRevisions()
    told = {name: revisions.update(name, growing(camera(0), camera(1))) for name in ("scene-0001", "scene-0002")}
    here = SimpleNamespace(scene_id="scene-0002", identity="0" * 32)
    written = output.Output(DaemonConfig(out=tmp_path), here, lambda shown: None, lambda problem: None, revisions)
    monkeypatch.setattr(output, "write_result_folder", lambda *rest, **more: None)
    monkeypatch.setattr(output, "describe_submap", lambda *rest: None)
    for name in ("update", "link_scene"):
        monkeypatch.setattr(written.index, name, lambda *rest: None)
    monkeypatch.setattr(written._metres, "scale_result", lambda snapshot, work: snapshot)
    final = replace(growing(camera(0), camera(1)), final=True)
    assert written.export(final, None, SimpleNamespace(scene_id=scene_id), SubmapState.FINISHED, ())
    now = {record.scene_id: record.revision for record in revisions.records}
    assert (now[scene_id] > told[scene_id].revision) == withdrawn
