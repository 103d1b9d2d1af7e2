"""Stock COLMAP and GLOMAP on the built-in place, whose cameras are known, and on frames that share nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.extras.evaluate.dataset import TrueCamera
from splatnode.extras.evaluate.rivals import colmap
from splatnode.extras.evaluate.stability import trial
from splatnode.extras.evaluate.stability.trial import score_cameras
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.result.verdict import Code

PLACE = synthetic.Config(views=3, width=320, height=240)


@pytest.mark.parametrize("name", ["colmap", "colmap-few-views", "glomap", "glomap-few-views"])
def test_cameras_of_the_built_in_place_are_right(name):
    method = trial.find_method(name)
    cameras = synthetic.scene_cameras(PLACE)
    truth = {synthetic.frame_name(i): TrueCamera(T, K, PLACE.width, PLACE.height) for i, (T, K) in enumerate(cameras)}
    snapshot = method([*synthetic.stream(PLACE), DroppedFrame("broken.jpg", "damaged")], ReconstructionConfig())
    assert snapshot.verdict.code is Code.OK and snapshot.verdict.publishable
    assert [camera.name for camera in snapshot.cameras] == list(truth)
    assert score_cameras(snapshot.cameras, [truth]).right


def test_options_for_few_views_are_those_that_the_page_lists(monkeypatch):
    """COLMAP: six options and no distortion; its other row has the defaults but for the seed."""
    asked = []
    monkeypatch.setattr(colmap.pycolmap, "incremental_mapping", lambda *arguments: asked.append(arguments[3]) or {})
    for name in ("colmap", "colmap-few-views"):
        colmap.MAPPERS[name](Path("nowhere"), 3)
    default, few = (flatten(each.todict()) for each in asked)
    plain = colmap.pycolmap.IncrementalPipelineOptions()
    plain.random_seed = 3
    assert default == flatten(plain.todict())
    assert {name: value for name, value in few.items() if value != default[name]} == {
        "mapper.init_min_tri_angle": "1.0",
        "mapper.init_max_forward_motion": "1.0",
        "mapper.init_min_num_inliers": "50",
        "mapper.abs_pose_min_num_inliers": "15",
        "mapper.abs_pose_refine_extra_params": "False",
        "mapper.filter_min_tri_angle": "0.5",
        "triangulation.min_angle": "0.5",
        "ba_refine_extra_params": "False",
    }


def test_glomap_for_few_views_takes_points_of_two_views(monkeypatch):
    asked = []
    monkeypatch.setattr(colmap.pycolmap, "calibrate_view_graph", lambda *_: None)
    monkeypatch.setattr(colmap.pycolmap, "global_mapping", lambda *arguments: asked.append(arguments[3]) or {})
    for name in ("glomap", "glomap-few-views"):
        colmap.MAPPERS[name](Path("nowhere"), 3)
    default, few = (flatten(each.todict()) for each in asked)
    assert {name: value for name, value in few.items() if value != default[name]} == {
        "mapper.track_min_num_views_per_track": "2",
        "mapper.global_positioning.min_num_view_per_track": "2",
        "mapper.bundle_adjustment.min_track_length": "2",
        "mapper.bundle_adjustment.refine_extra_params": "False",
        "mapper.min_tri_angle_deg": "0.5",
        "mapper.retriangulation.min_angle": "0.5",
        "mapper.retriangulation.ignore_two_view_tracks": "False",
    }


def flatten(options: dict, before: str = "") -> dict[str, str]:
    """The options of all levels, by their names with dots."""
    found: dict[str, str] = {}
    for name, value in options.items():
        found |= flatten(value, f"{before}{name}.") if isinstance(value, dict) else {f"{before}{name}": str(value)}
    return found


def test_what_shares_nothing_is_no_scene():
    rng = np.random.default_rng(0)
    noise = [Frame(i, f"{i}.png", i, rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), None) for i in range(3)]
    for frames in (noise, noise[:1], []):
        snapshot = trial.find_method("colmap")(frames, ReconstructionConfig())
        assert not snapshot.verdict.publishable and snapshot.cameras == ()
        assert snapshot.verdict.frames == tuple(frame.name for frame in frames)
