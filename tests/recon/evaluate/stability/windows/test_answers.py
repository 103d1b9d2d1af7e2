"""Answers to windows of the built-in place: what is kept of other windows changes no camera."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.recon import estimation
from splatnode.recon.config import Config
from splatnode.recon.evaluate.demo import write_capture
from splatnode.recon.evaluate.stability.own_cameras import cameras_of
from splatnode.recon.evaluate.stability.places import Place
from splatnode.recon.evaluate.stability.windows import ours
from splatnode.recon.evaluate.stability.windows.row import Found, judged
from splatnode.recon.evaluate.stability.windows.window import Window, angle_deg
from splatnode.recon.evaluate.truth import load_scene
from splatnode.recon.result.verdict import Code, Verdict

PLACE = synthetic.Config(views=6, width=320, height=240)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    folder = tmp_path_factory.mktemp("built_in")
    write_capture(folder, PLACE)
    return Place(load_scene(folder), tuple(synthetic.frame_name(i) for i in range(PLACE.views)))


def window(place: Place, start: int, stride: int, count: int = 3) -> Window:
    span = slice(start, start + stride * count, stride)
    return Window(place.name, count, stride, start, place.names[span], angle_deg(place.Ts_world_camera[span]))


def test_a_window_from_the_store_is_answered_as_from_scratch(place):
    config = Config()
    windows = [window(place, 0, 2), window(place, 1, 1, 4)]  # which share a pair
    found = [answer for _, answer in ours.answers(place, windows, config, fresh=False)]
    for each, answer in zip(windows, found, strict=True):
        estimate = ours.from_scratch(ours.frames_of(place, each), config)
        assert answer.verdict == estimate.verdict
        cameras = cameras_of(estimate)
        assert [camera.name for camera in answer.cameras] == [camera.name for camera in cameras]
        for one, other in zip(answer.cameras, cameras, strict=True):
            np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
            np.testing.assert_array_equal(one.K, other.K)
            assert one.bounds == other.bounds
    assert any(answer.verdict.publishable for answer in found), "else nothing was compared"


def test_a_refusal_keeps_its_cameras_and_evidence(place, monkeypatch):
    monkeypatch.setattr(estimation, "refuse_before_registration", lambda *_: Verdict(Code.BLUR, "No.", ""))
    each = window(place, 0, 2)
    (answer,) = [answer for _, answer in ours.answers(place, [each], Config(), fresh=True)]
    row = judged(each, "splatnode", answer, place.scene.cameras)
    assert row.found is Found.REFUSED and row.fresh_seconds is not None and row.fresh_seconds > 0
    assert row.evidence is not None and row.right and len(row.cameras) == 3
    assert all(camera.bounds is not None for camera in row.cameras)


def test_an_exception_is_an_answer(place, monkeypatch):
    def fails(*_):
        raise FloatingPointError("worse luck")

    monkeypatch.setattr(ours, "estimate_cameras", fails)
    (answer,) = [answer for _, answer in ours.answers(place, [window(place, 0, 1)], Config(), fresh=False)]
    row = judged(window(place, 0, 1), "splatnode", answer, place.scene.cameras)
    assert row.found is Found.FAILED and "worse luck" in row.message and not row.published


def test_rivals_map_what_the_scene_s_database_holds(place):
    pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")
    from splatnode.recon.evaluate.stability.windows import rivals

    jobs = [("colmap", window(place, 0, 1)), ("glomap", window(place, 3, 1)), ("colmap", window(place, 3, 1))]
    found = dict(rivals.answers(place, jobs, Config(), fresh=False, timeout_s=60.0))
    assert list(found) == jobs
    for (method, each), answer in found.items():
        row = judged(each, method, answer, place.scene.cameras)
        assert row.found is Found.RIGHT and {camera.name for camera in row.cameras} == set(each.names)
        assert all(camera.bounds is None for camera in row.cameras) and row.seconds > 0
