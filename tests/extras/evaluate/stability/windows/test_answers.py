"""Answers to windows of the built-in place: what is kept of other windows changes no camera."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from msgspec.structs import replace

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.extras.evaluate.dataset import load_scene, write_capture
from splatnode.extras.evaluate.report import Timing
from splatnode.extras.evaluate.stability import window_campaign
from splatnode.extras.evaluate.stability import windows as windows_windows
from splatnode.extras.evaluate.stability.perturbations import TrialScene
from splatnode.extras.evaluate.stability.trial import list_registered_cameras
from splatnode.extras.evaluate.stability.windows import (
    PieceKey,
    Window,
    WindowAnswer,
    WindowOutcome,
    compute_angle_deg,
    judge_window,
    select_keys,
)
from splatnode.extras.jobs import usable_cores
from splatnode.recon import estimation
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import prepare
from splatnode.recon.matching import pair_matching
from splatnode.recon.matching.view_graph import match
from splatnode.recon.result.verdict import Code, Verdict

PLACE = synthetic.Config(views=6, width=320, height=240)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> TrialScene:
    folder = tmp_path_factory.mktemp("built_in")
    write_capture(folder, PLACE)
    return TrialScene(load_scene(folder), tuple(synthetic.frame_name(i) for i in range(PLACE.views)))


def window(place: TrialScene, start: int, stride: int, count: int = 3) -> Window:
    span = slice(start, start + stride * count, stride)
    return Window(place.name, count, stride, start, place.names[span], compute_angle_deg(place.Ts_world_camera[span]))


def answered(
    place: TrialScene, each: Window, known: dict[PieceKey, bytes], config: ReconstructionConfig, **asked
) -> WindowAnswer:
    """What splatnode answers; what it finds is known from then on."""
    answer, found = window_campaign.reconstruct_window(place, each, config, asked.get("fresh", False), "nothing", known)
    known |= found
    return answer


def test_what_is_known_of_a_scene_changes_no_answer(place):
    config = ReconstructionConfig()
    windows = [window(place, 0, 2), window(place, 1, 1, 4)]  # which share a pair
    known: dict[PieceKey, bytes] = {}
    found = [answered(place, each, known, config) for each in windows]
    for each, answer in zip(windows, found, strict=True):
        estimate = window_campaign.estimate_without_store(window_campaign.load_window_frames(place, each), config)
        assert answer.verdict == estimate.verdict
        cameras = list_registered_cameras(estimate)
        assert [camera.name for camera in answer.cameras] == [camera.name for camera in cameras]
        for one, other in zip(answer.cameras, cameras, strict=True):
            np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
            np.testing.assert_array_equal(one.K, other.K)
            assert one.bounds == other.bounds
    assert any(answer.verdict.publishable for answer in found), "else nothing was compared"


def test_masks_hide_what_they_hide_in_windows_too(place, tmp_path):
    each = window(place, 1, 2, 2)
    hidden = np.full((PLACE.height, PLACE.width, 3), 255, np.uint8)
    hidden[:100] = 0
    (tmp_path / f"{each.names[1]}.png").write_bytes(encode_png(hidden))
    scene = dataclasses.replace(place.scene, masks=tmp_path)
    plain, frames = (
        window_campaign.load_window_frames(place, each, True),
        window_campaign.load_window_frames(TrialScene(scene, place.names), each, True),
    )
    assert [(frame.frame_id, frame.stamp_ns, frame.intrinsics is None) for frame in frames] == [
        (1, 1, False),
        (3, 3, False),
    ]
    assert_same(plain[0], frames[0])
    assert frames[1].mask is not None and frames[1].mask.mean() == pytest.approx(140 / 240)
    assert np.array_equal(frames[1].image[100:], plain[1].image[100:])
    assert not np.array_equal(frames[1].image[:100], plain[1].image[:100])


def assert_same(one: object, other: object) -> None:
    """To the bit, field by field."""
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_a_graph_of_what_is_known_is_that_of_matching_from_scratch(place, monkeypatch):
    """Of firm pairs and of weak ones, which tilted features are made for, and which are chosen by window."""
    config = ReconstructionConfig()
    few = replace(config.matching.features, max_num_features=1000)
    matching = replace(config.matching, features=few, tilting=replace(config.matching.tilting, firm_matches=100))
    config = replace(config, matching=matching)
    keyframes = [prepare(frame, config) for frame in window_campaign.load_window_frames(place, window(place, 0, 1, 6))]
    known: dict[PieceKey, bytes] = {}
    for some in (keyframes[:4], keyframes[2:], keyframes[1::2], keyframes):
        graph, found = windows_windows.match_keyframes(
            some, {key: known[key] for key in select_keys(known, [k.name for k in some])}, matching, None
        )
        known |= found
        scratch = match(some, matching)
        assert list(graph.pairs) == list(scratch.pairs) and list(graph.tilted) == list(scratch.tilted)
        for pair, geometry in graph.pairs.items():
            assert_same(geometry, scratch.pairs[pair])
        for one, other in zip(graph.keyframes, scratch.keyframes, strict=True):
            assert_same(one.features, other.features)
    assert 0 < len(graph.tilted) < len(graph.plain), "else there was nothing to choose"
    for work in ("match_plain", "match_affine"):
        monkeypatch.setattr(pair_matching, work, None)
    assert windows_windows.match_keyframes(keyframes, known, matching, None)[1] == {}, "nothing is matched twice"


def test_a_refusal_keeps_its_cameras_and_evidence(place, monkeypatch):
    monkeypatch.setattr(estimation, "refuse_before_registration", lambda *_: Verdict(Code.BLUR, "No.", ""))
    each = window(place, 0, 2)
    answer = answered(place, each, {}, ReconstructionConfig(), fresh=True)
    assert answer.fresh_seconds is not None and answer.fresh_seconds > 0
    row = judge_window(each, "splatnode", answer, place.scene.cameras)
    assert row.outcome is WindowOutcome.REFUSED and row.cores == len(usable_cores())
    assert row.evidence is not None and row.right and len(row.cameras) == 3
    assert all(camera.bounds is not None for camera in row.cameras)


def test_seconds_are_those_of_a_window_that_had_its_cores_alone(place):
    each = window(place, 0, 1)
    alone, beside = Timing(1, "a processor", 0.01), Timing(1, "a processor", 0.3)
    answer = WindowAnswer(Verdict(Code.NO_OVERLAP, "Nothing.", ""), (), 2.0, alone, 5.0, alone)
    row = judge_window(each, "splatnode", answer, place.scene.cameras)
    assert (row.seconds, row.fresh_seconds, row.others, row.cores) == (2.0, 5.0, 0.01, 1)
    for one, other in ((alone, beside), (beside, alone)):
        row = judge_window(
            each, "splatnode", dataclasses.replace(answer, timed_on=one, fresh_on=other), place.scene.cameras
        )
        assert (row.seconds, row.fresh_seconds, row.others) == (None, None, 0.3)


def share_of_rows(one: np.ndarray, other: np.ndarray) -> float:
    """How many rows are in both, of those in either.

    COLMAP seeks neighbours in an approximate index: in one of some hundred runs a pair has two or three other matches.
    """
    first, second = (set(map(tuple, rows.tolist())) for rows in (one, other))
    return len(first & second) / len(first | second)


def test_rivals_map_what_is_known_of_the_scene(place):
    pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")
    from splatnode.extras.evaluate.stability import window_campaign

    jobs = [("colmap", window(place, 0, 1, 4)), ("glomap", window(place, 1, 1)), ("colmap", window(place, 2, 1, 4))]
    known: dict[PieceKey, bytes] = {}
    for number, (method, each) in enumerate(jobs):
        answer, found = window_campaign.run_rival_on_window(place, each, method, 0, number == 0, known)
        assert len(found) == (10, 0, 7)[number], "what is known is not found again"
        known |= found
        row = judge_window(each, method, answer, place.scene.cameras)
        assert row.outcome is WindowOutcome.RIGHT and {camera.name for camera in row.cameras} == set(each.names)
        assert all(camera.bounds is None for camera in row.cameras)
        assert answer.seconds > 0 and (answer.fresh_seconds is not None) == (number == 0)
        _, found = window_campaign.run_rival_on_window(place, each, method, 0, False, {})
        for key in (key for key in found if len(key) == 3):
            one, other = (pickle.loads(pieces[key]) for pieces in (known, found))
            assert share_of_rows(one.matches, other.matches) > 0.95
            assert share_of_rows(one.geometry.inlier_matches, other.geometry.inlier_matches) > 0.95
