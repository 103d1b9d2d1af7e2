"""Depth images of a program: they give metres and fill plain walls, whichever way they are given."""

from __future__ import annotations

import json
import logging
import re

import cv2
import msgspec
import numpy as np
import pytest

import splatnode
from splatnode import command_line
from splatnode.api.photographs import add_depths, load_frames
from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import encode_png
from splatnode.recon.config import preset
from splatnode.recon.pipeline import estimate_frames
from splatnode.recon.result.snapshot import DepthCode
from splatnode.recon.threads import Clock
from tests.api.conftest import QUICK, SMALL
from tests.api.test_publisher import picture, publisher, receive, recon
from tests.support import depth_camera
from tests.support.depth_camera import DepthCamera
from tests.support.synthetic import photographs

TRUE = [T for T, _ in synthetic.scene_cameras(SMALL)]


@pytest.fixture(scope="module")
def depths() -> list[splatnode.DepthImage]:
    frames = depth_camera.add_depths(photographs(SMALL), SMALL)
    return [frame.depth for frame in frames if frame.depth is not None]


def metres_ratio(result: splatnode.Result) -> float:
    """How far the first and the last camera are apart, over what is true."""
    true = np.linalg.norm(TRUE[-1][:3, 3] - TRUE[0][:3, 3])
    return float(np.linalg.norm(result.cameras[-1].centre - result.cameras[0].centre) / true)


def test_a_scene_in_metres_with_more_depth_and_the_same_cameras(arrays, depths, result, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        made = splatnode.reconstruct(arrays, depths=depths, config=QUICK)
    assert made.verdict.publishable and made.metric and len(made.cameras) == 4
    assert metres_ratio(made) == pytest.approx(1.0, abs=0.01)
    assert (
        made.scale_interval is not None and made.scale_interval[0] <= 1 / metres_ratio(made) <= made.scale_interval[1]
    )
    assert made.scale_source is not None and "depth images of 4 photographs" in made.scale_source
    assert result.scale_source is None
    (check,) = made.depth_checks
    assert check.code is DepthCode.FITS and result.depth_checks == ()
    assert splatnode.load(made.save(tmp_path / "out")).depth_checks == made.depth_checks
    assert "depth images of 4 photographs fit the images" in caplog.text
    assert set(re.findall(r"(\d+) points of the images", caplog.text)) <= {str(check.num_points)}, "one number"
    assert made.consistent_depth is not None and result.consistent_depth is not None
    assert made.consistent_depth > result.consistent_depth
    unit = np.linalg.norm(made.cameras[-1].centre) / np.linalg.norm(result.cameras[-1].centre)
    for with_depth, alone in zip(made.cameras, result.cameras, strict=True):
        assert np.allclose(with_depth.centre, unit * alone.centre, atol=5e-3), "the images decide where cameras are"


def test_a_misaligned_depth_camera_changes_nothing_but_the_report(arrays, result):
    moved = depth_camera.add_depths(photographs(SMALL), SMALL, DepthCamera(shift_px=(4.0, 0.0)))
    made = splatnode.reconstruct(arrays, depths=[frame.depth for frame in moved], config=QUICK)
    (check,) = made.depth_checks
    assert check.code is DepthCode.SHIFTED and not made.metric
    assert all(np.array_equal(made.gaussians[name], result.gaussians[name]) for name in result.gaussians)


def test_plain_walls_get_the_depth_that_was_measured():
    place = msgspec.structs.replace(SMALL, views=4)
    plain = depth_camera.whitewash(photographs(place), place)
    shares = []
    for frames in (plain, depth_camera.add_depths(plain, place)):
        estimate, _ = estimate_frames(frames, preset("preview"), Clock())
        assert estimate.verdict.publishable
        shares.append(float(np.mean([(each.confidence >= 0.12).mean() for each in estimate.pointmaps.values()])))
    alone, measured = shares
    assert alone < 0.85 and measured > 0.93, shares


def test_depths_are_a_list_a_mapping_a_folder_or_files(folder, arrays, depths, tmp_path):
    for index, depth in enumerate(depths):
        (tmp_path / f"{index:04d}.png").write_bytes(cv2.imencode(".png", depth.values)[1].tobytes())
    listed, taken = load_frames(arrays, None, False, lambda _: None), load_frames(folder, None, False, lambda _: None)
    for source, given, images in (
        (listed, [depth.values for depth in depths], arrays),
        (listed, [depth.metres for depth in depths], arrays),
        (listed, [tmp_path / f"{index:04d}.png" for index in range(4)], arrays),
        (taken, tmp_path, folder),
        (taken, {f"{index:04d}.png": depth for index, depth in enumerate(depths)}, folder),
    ):
        frames = add_depths(source, given, images).frames
        for frame, depth in zip(frames, depths, strict=True):
            assert isinstance(frame, Frame) and frame.depth is not None
            assert frame.depth.metres == pytest.approx(depth.metres, abs=1e-6)
    one = add_depths(listed, [None, depths[1], None, None], arrays).frames
    assert [isinstance(each, Frame) and each.depth is not None for each in one] == [False, True, False, False]


@pytest.mark.parametrize(
    ("given", "kind", "why"),
    [
        ([None], ValueError, "one for each of the 4 photographs, got 1"),
        ([np.zeros((240, 320, 3), np.uint8)] * 4, ValueError, "depth image of 0000.png.*uint16 of millimetres"),
        ([np.zeros((9, 320), np.uint16)] * 4, ValueError, "depth image of 0000.png.*shape of its image, 320 x 240"),
        ([np.full((240, 320), 2, np.uint16)] * 4, ValueError, "depth image of 0000.png.*median is 2: probably metres"),
        ([np.full((240, 320), 2500.0)] * 4, ValueError, "floats hold metres; the median is 2500: probably millimetres"),
        ([7, 7, 7, 7], TypeError, "must be a DepthImage"),
        ({"other.png": np.zeros((240, 320), np.uint16)}, ValueError, "none of the photographs, such as 0000.png"),
        ("/not/there", FileNotFoundError, "give a folder of depth images"),
    ],
)
def test_what_are_no_depths_is_said(arrays, given, kind, why):
    with pytest.raises(kind, match=why):
        add_depths(load_frames(arrays, None, False, lambda _: None), given, arrays)


def test_replay_takes_a_folder_of_depth_images(folder, depths, tmp_path, capsys):
    for index, depth in enumerate(depths):
        (tmp_path / f"{index:04d}.tif").write_bytes(cv2.imencode(".tif", depth.values)[1].tobytes())
    out = tmp_path / "out"
    options = ["--preset", "preview", "--out", str(out), "--depths"]
    assert command_line.main(["replay", str(folder), *options, str(tmp_path)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert [each["code"] for each in report["depth"]] == ["FITS"]
    (tmp_path / "0001.tif").write_bytes(b"II*\0 no image")
    assert command_line.main(["replay", str(folder), *options, str(tmp_path)]) != 0
    assert "0001.tif" in capsys.readouterr().err


def test_a_folder_without_them_is_said(arrays, tmp_path):
    (tmp_path / "a.png").write_bytes(encode_png(arrays[0]))
    with pytest.raises(ValueError, match="name both alike"):
        add_depths(load_frames(arrays, None, False, lambda _: None), tmp_path, arrays)


def test_a_session_grows_in_metres_by_depth(arrays, depths):
    with splatnode.Session(config=QUICK, seed=0) as session:
        for image, depth in zip(arrays[:3], depths, strict=False):
            update = session.add(image, depth=depth)
        assert update.result.metric and update.result.depth_checks[0].code is DepthCode.FITS
        first, *_, last = update.result.cameras
    true = np.linalg.norm(TRUE[2][:3, 3] - TRUE[0][:3, 3])
    assert np.linalg.norm(last.centre - first.centre) == pytest.approx(true, rel=0.02)


def test_a_publisher_sends_it(tmp_path):
    measured = np.random.default_rng(0).integers(500, 4000, (240, 320)).astype(np.uint16)
    with publisher(tmp_path) as node, recon(tmp_path) as client:
        node.publish(picture(), name="first", depth=measured)
        (frame,) = receive(client, 1)
        assert isinstance(frame, Frame) and frame.depth is not None
        assert np.array_equal(frame.depth.values, measured) and frame.depth.unit_m == 0.001
        with pytest.raises(ValueError, match="shape of its image"):
            node.publish(picture(1), name="second", depth=measured[:50])
