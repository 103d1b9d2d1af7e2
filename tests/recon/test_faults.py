"""A fault of a library on one image or one pair costs that image or pair, by name; our own errors surface."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import decode_image
from splatnode.recon import estimation
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.estimation import UnusableFrame, prepare_all
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.keyframes import screen_all
from splatnode.recon.matching import features, pair_matching
from splatnode.recon.matching.view_graph import match, moving_points
from splatnode.recon.priors import stereo
from splatnode.recon.result.verdict import Code
from tests.support.synthetic import photographs

PHOTOGRAPHS = Path(__file__).parent.parent / "support" / "photographs"
FAULT = cv2.error("sample_size <= points_size_")


def shrunk(frame: Frame, longer_side: int, name: str) -> Frame:
    scale = longer_side / max(frame.width, frame.height)
    size = round(frame.width * scale), round(frame.height * scale)
    return replace(frame, image=cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), name=name, encoded=None)


def failing_for(name: str, function, error: Exception = FAULT):
    """`function` of a frame or keyframe, which fails for the one of this name."""

    def fail(first, *others):
        if first.name == name:
            raise error
        return function(first, *others)

    return fail


def test_thumbnails_beside_photographs_are_left_out_by_name_with_their_size():
    views = photographs()[:4]
    thumbnails = [shrunk(views[0], side, f"thumbnail_{side}.jpg") for side in (48, 64, 80)]
    kept, dropped, rejected = screen_all([*thumbnails, *views], ReconstructionConfig().screening)
    assert [frame.name for frame in kept] == [view.name for view in views]
    assert [frame.name for frame in dropped] == ["thumbnail_48.jpg", "thumbnail_64.jpg", "thumbnail_80.jpg"]
    assert "too small" in dropped[0].reason and "48 x 36 pixels" in dropped[0].reason
    assert {each.code for each in rejected} == {Code.TOO_FEW_VIEWS}


def test_small_photographs_alone_and_a_set_of_two_scales_are_used():
    small = [shrunk(view, 96, view.name) for view in photographs()[:3]]
    assert len(screen_all(small, ReconstructionConfig().screening)[0]) == 3
    mixed = [shrunk(photographs()[0], 120, "a.jpg"), shrunk(photographs()[1], 320, "b.jpg")]
    assert len(screen_all(mixed, ReconstructionConfig().screening)[0]) == 2


def test_a_thumbnail_is_matched_without_a_fault(caplog):
    """OpenCV refuses what these two have in common with an assertion, which ended the run."""
    names = "beside_thumbnail.jpg", "thumbnail.jpg"
    images = [decode_image((PHOTOGRAPHS / name).read_bytes()).image for name in names]
    frames = [Frame(index, name, index, images[index], None) for index, name in enumerate(names)]
    graph = match(prepare_all(frames, ReconstructionConfig())[0], ReconstructionConfig().matching)
    assert not graph.pairs and "beside_thumbnail.jpg and thumbnail.jpg" in caplog.text


@pytest.mark.parametrize("error", [FAULT, np.linalg.LinAlgError("SVD did not converge")])
def test_a_pair_on_which_a_library_fails_shares_nothing(monkeypatch, caplog, error):
    keyframes, _ = prepare_all(photographs()[:3], ReconstructionConfig())
    estimate = pair_matching.estimate
    first = keyframes[0]

    def fail(points1, points2, *others):
        found = [np.isin(points[:, 0], first.features.points[:, 0] - first.frame.width / 2).mean() for points in
                 (points1, points2)]  # fmt: skip
        if max(found) > 0.9:
            raise error
        return estimate(points1, points2, *others)

    monkeypatch.setattr(pair_matching, "estimate", fail)
    with caplog.at_level(logging.WARNING):
        graph = match(keyframes, ReconstructionConfig().matching)
    assert set(graph.pairs) == {(1, 2)}
    assert first.name in caplog.text and "sharing nothing" in caplog.text
    assert not any(points.any() for points in moving_points(graph))


def test_an_error_of_ours_in_a_pair_surfaces(monkeypatch):
    keyframes, _ = prepare_all(photographs()[:2], ReconstructionConfig())
    monkeypatch.setattr(pair_matching, "_estimate_geometry", lambda *_: {}["ours"])
    with pytest.raises(KeyError):
        match(keyframes, ReconstructionConfig().matching)


def test_a_photograph_in_which_no_features_can_be_found_is_left_out(monkeypatch, caplog):
    views = photographs()[:3]
    extract = features.extract

    def fail(image, config):
        if image is views[1].image:
            raise FAULT
        return extract(image, config)

    monkeypatch.setattr(features, "extract", fail)
    keyframes, dropped = prepare_all(views, ReconstructionConfig())
    assert [keyframe.name for keyframe in keyframes] == [views[0].name, views[2].name]
    assert [frame.name for frame in dropped] == [views[1].name] and "sample_size" in dropped[0].reason
    assert views[1].name in caplog.text


def test_a_lens_that_folds_one_photograph_costs_that_one_and_of_all_it_is_the_lens():
    views = list(photographs()[:3])
    width, height = views[0].width, views[0].height
    folding = Intrinsics(width, height, width, width, width / 2, height / 2, "given", (-0.5, 0.0))
    one = [views[0], replace(views[1], intrinsics=folding), views[2]]
    keyframes, dropped = prepare_all(one, ReconstructionConfig())
    assert len(keyframes) == 2 and "folds the picture over" in dropped[0].reason
    with pytest.raises(UnusableFrame, match="folds the picture over"):
        prepare_all([replace(view, intrinsics=folding) for view in views], ReconstructionConfig())


def test_a_stream_goes_on_without_the_frame_that_cannot_be_prepared(monkeypatch):
    views = photographs()[:2]
    work = IncrementalReconstruction(preset("preview"))
    monkeypatch.setattr(estimation, "undistort_frame", failing_for(views[1].name, estimation.undistort_frame))
    for view in views:
        work.add_frame(view)
    assert work.names == [views[0].name]
    assert [frame.name for frame in work.dropped] == [views[1].name]
    assert "sample_size" in work.dropped[0].reason


def test_a_photograph_that_cannot_be_tilted_keeps_its_plain_features(monkeypatch, caplog):
    keyframe = prepare_all(photographs()[:1], ReconstructionConfig())[0][0]
    monkeypatch.setattr("splatnode.recon.matching.view_graph._add_affine_features", failing_for(keyframe.name, None))
    from splatnode.recon.matching.view_graph import _try_affine_features

    assert _try_affine_features(keyframe, (1.6,), ReconstructionConfig().matching) is keyframe
    assert f"{keyframe.name} is matched without simulated tilts" in caplog.text


def test_stereo_begins_without_the_points_on_which_a_library_fails(monkeypatch, caplog):
    image = np.zeros((24, 32, 3), np.uint8)
    K = np.array([[32.0, 0.0, 16.0], [0.0, 32.0, 12.0], [0.0, 0.0, 1.0]])
    view = stereo.StereoView(image, K, np.eye(4), (1.0, 4.0), "view.jpg")
    points = stereo.SparsePoints(np.array([[5.0, 5.0]]), np.array([2.0]))
    level = stereo._make_level(view, 0)
    assert stereo._initialize_or_unknown(view, level, points).inverse_depth.max() == 0.5

    def fail(*_, **__):
        raise FAULT

    monkeypatch.setattr(cv2, "distanceTransformWithLabels", fail)
    assert stereo._initialize_or_unknown(view, level, points).inverse_depth.max() == 0.0
    assert "view.jpg" in caplog.text
