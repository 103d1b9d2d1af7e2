"""Stereo images, 360-degree images and turntables are told as what they are, and other sets are not taken for them."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.capture.masks import apply_mask
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import estimate_cameras, prepare_all
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph, match
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.input_kinds import explain_refusal, measure_seam, refuse_stereo_or_panorama
from tests.support.input_kinds import panoramas, stereo_halves, turned
from tests.support.synthetic import photographs, renumbered

INPUTS = Path(__file__).parents[3] / "docs" / "inputs.md"
REFUSED = Verdict(Code.NO_OVERLAP, "Only 0 of 4 photographs could be placed.", "Take others.")


def prepared(images) -> list[Keyframe]:
    frames = images if isinstance(images[0], Frame) else renumbered(images)
    return prepare_all(frames, ReconstructionConfig())[0]


@lru_cache(maxsize=8)
def graph_of(*frames: Frame) -> ViewGraph:
    return match(prepared(list(frames)), ReconstructionConfig().matching)


@pytest.mark.parametrize(
    ("stack", "size", "words"),
    [
        (np.hstack, None, "side by side"),
        (np.hstack, (480, 360), "side by side"),  # squeezed to half their width, as television has it
        (np.vstack, None, "one above the other"),
    ],
)
def test_stereo_images_are_told_with_the_way_to_cut_them(stack, size, words):
    images = [stack(halves) for halves in stereo_halves(4)]
    images = [image if size is None else cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    verdict = refuse_stereo_or_panorama(prepared(images))
    assert verdict is not None and verdict.code is Code.STEREO_IMAGES and not verdict.publishable
    assert f"4 of 4 images show the same place twice, {words}" in verdict.message
    assert "--stereo-baseline" in verdict.advice and len(verdict.frames) == 4


def test_one_other_image_of_five_does_not_hide_that_the_rest_are_stereo_images():
    pairs = stereo_halves(5)
    four = [np.hstack(halves) for halves in pairs[:4]]
    verdict = refuse_stereo_or_panorama(prepared([pairs[4][0], *four]))
    assert verdict is not None and "4 of 5 images" in verdict.message
    assert refuse_stereo_or_panorama(prepared([pairs[4][0], pairs[3][0], *four[:3]])) is None


@pytest.mark.parametrize("kind", ["halves", "room", "pairs of other places", "mirror"])
def test_other_photographs_are_no_stereo_images(kind):
    pairs = stereo_halves(4)
    images = {
        "halves": [left for left, _ in pairs],
        "room": [frame.image for frame in photographs()[:4]],
        "pairs of other places": [np.hstack([pairs[i][0], pairs[(i + 2) % 4][0]]) for i in range(4)],
        "mirror": [np.hstack([left, left[:, ::-1]]) for left, _ in pairs],
    }[kind]
    assert refuse_stereo_or_panorama(prepared(images)) is None


def test_images_of_360_degrees_are_told_and_pieces_of_them_are_not():
    frames = panoramas(3)
    verdict = refuse_stereo_or_panorama(prepared(list(frames)))
    assert verdict is not None and verdict.code is Code.PANORAMA and len(verdict.frames) == 3
    assert "3 of 3 images are 360-degree ones" in verdict.message and "docs/inputs.md" in verdict.advice
    pieces = [cv2.resize(frame.image[:, :700], (768, 384)) for frame in frames]
    assert refuse_stereo_or_panorama(prepared(pieces)) is None


def test_photographs_that_are_twice_as_wide_as_high_are_none_of_360_degrees():
    wide = [frame.image[: frame.width // 2] for frame in photographs()[:4]]
    assert wide[0].shape[1] == 2 * wide[0].shape[0]
    assert refuse_stereo_or_panorama(prepared(wide)) is None
    assert measure_seam(np.full((64, 128, 3), 90, np.uint8)) is None
    rows = np.random.default_rng(0).integers(0, 255, (256, 1, 3)).astype(np.uint8)
    assert measure_seam(np.repeat(rows, 512, axis=1)) == pytest.approx(1.0, abs=0.01)


def test_a_turntable_before_a_room_is_told_instead_of_what_it_leads_to():
    frames, _ = turned(4)
    estimate = estimate_cameras(graph_of(*frames), (), ReconstructionConfig())
    assert estimate.verdict.code is Code.TURNTABLE
    assert "6 of 6 pairs" in estimate.verdict.message and "--masks" in estimate.verdict.advice
    assert estimate.verdict.frames == tuple(frame.name for frame in frames)


def test_a_scene_that_is_published_is_no_turntable_and_a_plain_background_makes_none():
    frames, _ = turned(4)
    good = Verdict(Code.OK, "All were placed.", "", publishable=True)
    assert explain_refusal(good, graph_of(*frames)) is good
    plain, _ = turned(4, plain=True)
    assert explain_refusal(REFUSED, graph_of(*plain)) is REFUSED
    assert explain_refusal(REFUSED, graph_of(*photographs()[:4])) is REFUSED


def test_masks_that_hide_the_background_leave_no_turntable():
    frames, masks = turned(4)
    hidden = [apply_mask(frame, mask) for frame, mask in zip(frames, masks, strict=True)]
    assert explain_refusal(REFUSED, graph_of(*[frame for frame in hidden if isinstance(frame, Frame)])) is REFUSED


def test_a_robot_that_sees_itself_and_a_camera_that_stands_still_are_no_turntables():
    body = photographs()[5].image
    height = body.shape[0]
    part = slice(int(0.7 * height), height)
    seen = [frame.image.copy() for frame in photographs()[:4]]
    for image in seen:
        image[part] = body[part]
    assert explain_refusal(REFUSED, graph_of(*renumbered(seen))) is REFUSED
    grains = [np.random.default_rng(seed).normal(size=body.shape) for seed in range(4)]
    still = renumbered(np.clip(body + grain, 0, 255).astype(np.uint8) for grain in grains)
    copies = Verdict(Code.STATIC_CAMERA, "The camera did not move.", "Step to the side.")
    assert explain_refusal(copies, graph_of(*still)) is copies


def python_in(section: str) -> str:
    """The example of a section of docs/inputs.md."""
    told = INPUTS.read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    (code,) = re.findall(r"```python\n(.*?)```", told, re.DOTALL)
    return code


def test_the_page_cuts_stereo_images_into_their_halves(tmp_path, monkeypatch):
    left, right = stereo_halves(4)[0]
    (tmp_path / "stereo").mkdir()
    cv2.imwrite(str(tmp_path / "stereo" / "a.jpg"), np.hstack([left, right])[..., ::-1])
    monkeypatch.chdir(tmp_path)
    exec(python_in("Stereo images"), {})
    for name, half in (("left", left), ("right", right)):
        cut = cv2.imread(str(tmp_path / name / "a.jpg"))[..., ::-1]
        assert cut.shape == half.shape and np.abs(cut.astype(int) - half).mean() < 6


def test_the_page_cuts_images_of_360_degrees_into_views_that_a_pinhole_would_have_taken(tmp_path, monkeypatch):
    frame = panoramas(1)[0]
    (tmp_path / "panoramas").mkdir()
    cv2.imwrite(str(tmp_path / "panoramas" / "a.jpg"), frame.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    monkeypatch.chdir(tmp_path)
    exec(python_in("360-degree images"), {})
    views = sorted((tmp_path / "views").iterdir())
    assert [path.name for path in views] == ["a_000.png", "a_090.png", "a_180.png", "a_270.png"]
    ahead, right = (cv2.imread(str(path))[..., ::-1].astype(int) for path in views[:2])
    assert ahead.shape == (256, 256, 3)
    assert np.abs(ahead[:, -1] - right[:, 0]).mean() < 12  # the same rays, half a pixel apart
    middle = frame.image[190:194, 382:386].mean((0, 1))
    assert np.abs(ahead[127:129, 127:129].mean((0, 1)) - middle).max() < 25
    assert refuse_stereo_or_panorama(prepared([np.ascontiguousarray(ahead.astype(np.uint8))])) is None
