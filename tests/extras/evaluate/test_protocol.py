"""Scenes, splits and scores: a perfect reconstruction scores perfectly, a worse one by what is wrong with it."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import undistort_frame
from splatnode.extras.evaluate.dataset import Split, load_scene
from splatnode.extras.evaluate.protocol import (
    EXPOSURES,
    Run,
    average_intrinsics,
    compute_mean,
    evaluate,
    find_test_pose,
    interpolate_pose,
    psnr,
    undistort_counts,
    undistort_view,
)
from splatnode.extras.evaluate.regions import UNKNOWN
from splatnode.extras.evaluate.stability.perturbations import TrialImage, distort_image
from splatnode.recon import keyframes
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.export import write_result
from splatnode.recon.result.export.formats.colmap import encode_colmap
from splatnode.recon.result.export.formats.nerfstudio import encode_nerfstudio
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.stored import encode_cameras
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import CameraEstimate, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.scene.exposure import relative_illumination
from tests.support.blobs import (
    HEIGHT,
    NAMES,
    NO_NETWORKS,
    QUICK,
    SPLIT,
    WIDTH,
    K,
    estimate,
    make_gaussians,
    perfect_snapshot,
    true_pose,
    write_scene,
)

RUN = Run("exact", 0, None, {"poses": 1.0, "points": None, "optimise": 2.0, "total": 3.5}, 123.0)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "blobs"
    write_scene(folder)
    return folder


def score(
    snapshot: Snapshot,
    folder: Path,
    found: dict[str, np.ndarray] | None = None,
    split: Split = SPLIT,
    shown: dict[str, np.ndarray] | None = None,
    **settings,
):
    return evaluate(
        snapshot,
        load_scene(folder),
        split,
        RUN,
        rasterize=rasterize_on_cpu,
        networks=NO_NETWORKS,
        settings=replace(QUICK, **settings),
        found=found,
        shown=shown,
    )


# --- scenes


def test_every_layout_gives_the_same_cameras(scene_folder, tmp_path):
    pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP models (the extra bench)")
    expected = load_scene(scene_folder)
    cameras = [estimate(name, true_pose(int(name[:2]))) for name in NAMES]
    files = {
        "ours/cameras.json": encode_cameras(cameras),
        "nerfstudio/transforms.json": encode_nerfstudio(cameras),
        **{f"colmap/sparse/0/{name}": data for name, data in encode_colmap(cameras, make_gaussians()).items()},
    }
    for name, data in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    for layout in ("ours", "nerfstudio", "colmap"):
        os.symlink(scene_folder / "images", tmp_path / layout / "images")
        scene = load_scene(tmp_path / layout)
        assert list(scene.cameras) == NAMES
        for name in NAMES:
            found, true = scene.cameras[name], expected.cameras[name]
            assert np.allclose(found.T_world_camera, true.T_world_camera, atol=1e-12)
            assert np.allclose(found.K, K) and (found.width, found.height) == (WIDTH, HEIGHT)


def test_incomplete_scenes_are_clear_errors(scene_folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold the scene's images"):
        load_scene(tmp_path)
    os.symlink(scene_folder / "images", tmp_path / "images")
    with pytest.raises(FileNotFoundError, match="must hold the true cameras"):
        load_scene(tmp_path)
    (tmp_path / "transforms.json").write_text('{"frames": [{"file_path": "00.png"}]}')
    with pytest.raises(ValueError, match="must give w, h, fl_x, transform_matrix"):
        load_scene(tmp_path)
    frame = {"file_path": "00.png", "w": 1, "h": 1, "fl_x": 1, "k1": 0.1, "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with pytest.raises(ValueError, match="undistorted"):
        load_scene(tmp_path)


def test_frames_tell_a_reconstruction_nothing_but_pixels(scene_folder):
    frames = load_scene(scene_folder).frames(SPLIT.train)
    assert [frame.name for frame in frames] == list(SPLIT.train)
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    assert all(frame.intrinsics is None for frame in frames)
    assert frames[0].image.shape == (HEIGHT, WIDTH, 3)


# --- scores


def test_an_estimated_distortion_is_taken_out_of_held_out_photographs_too(scene_folder, tmp_path):
    scene = load_scene(scene_folder)
    shutil.copytree(scene_folder, tmp_path / "blobs")
    shutil.copy(scene_folder.parent / "splits.json", tmp_path)
    for name in NAMES:
        photo = distort_image(TrialImage(name, scene.image(name), scene.cameras[name]), -0.3)
        cv2.imwrite(str(tmp_path / "blobs" / "images" / name), photo.image[..., ::-1])
    focal = photo.camera.K[0, 0]
    lens = Intrinsics(WIDTH, HEIGHT, focal, focal, 48.0, 36.0, "estimated", (-0.3, 0.0, 0.0, 0.0))
    pinhole = undistort_frame(Frame(0, "a", 0, photo.image, lens)).intrinsics.K
    snapshot = perfect_snapshot()
    straight = tuple(replace(camera, K=pinhole, lens=lens) for camera in snapshot.cameras)
    row = score(replace(snapshot, cameras=straight), tmp_path / "blobs")
    as_they_are = tuple(replace(camera, K=lens.K) for camera in snapshot.cameras)
    other = score(replace(snapshot, cameras=as_they_are), tmp_path / "blobs")
    assert row.psnr > 32.0 and row.psnr > other.psnr + 5.0
    assert row.focal_error_pct == pytest.approx(100.0 * (focal / 90.0 - 1.0))  # of the photographs as they were taken
    shown = {name: np.full((HEIGHT, WIDTH), 2, np.uint8) for name in SPLIT.test}
    for counts in shown.values():
        counts[:, :24] = 0
    regions = score(replace(snapshot, cameras=straight), tmp_path / "blobs", shown=shown).regions
    assert regions["two"].psnr > 32.0 and regions["one"].share_pct == 0.0
    assert 98.0 < regions["two"].share_pct + regions["none"].share_pct < 100.0  # what the lens mixes is neither


def test_what_the_lens_mixes_is_unknown():
    lens = Intrinsics(WIDTH, HEIGHT, 90.0, 90.0, 48.0, 36.0, "estimated", (-0.3, 0.0, 0.0, 0.0))
    counts = np.full((HEIGHT, WIDTH), 2, np.uint8)
    counts[:, :20] = 1
    straight = undistort_counts(lens, counts)
    mixed = (straight == UNKNOWN).sum(1)
    assert set(np.unique(straight)) == {1, 2, UNKNOWN} and mixed.min() >= 1 and mixed.max() <= 3
    assert undistort_counts(None, counts) is counts
    assert undistort_counts(replace(lens, model="fisheye"), counts) is None


def test_what_a_lens_cuts_off_is_no_mask():
    lens = Intrinsics(WIDTH, HEIGHT, 90.0, 90.0, 48.0, 36.0, "estimated", (0.05, 0.0, 0.0, 0.0), "fisheye")
    cut = np.ones((HEIGHT, WIDTH), bool)
    cut[0, 0] = False
    image, used = undistort_view(lens, np.zeros((HEIGHT, WIDTH, 3), np.uint8), cut)
    assert used.all() and used.shape == image.shape[:2]


def test_perfect_reconstruction_scores_perfectly(scene_folder):
    row = score(perfect_snapshot(), scene_folder)
    assert row.psnr is not None and row.psnr > 50  # 8-bit images allow 59 dB
    assert row.ssim is not None and row.ssim > 0.999
    assert row.rotation_error_deg == pytest.approx(0, abs=1e-6)
    assert row.centre_error_pct == pytest.approx(0, abs=1e-6)
    assert row.focal_error_pct == pytest.approx(0, abs=1e-6)
    assert row.lpips_alex is None and row.lpips_vgg is None
    assert (row.scene, row.views, row.method, row.iterations, row.final) == ("blobs", 3, "exact", 100, True)
    assert (row.num_gaussians, row.num_cameras, row.verdict) == (500, 3, "OK")
    assert row.scene_bytes == len(encode_ply(make_gaussians()))
    assert row.seconds["total"] == 3.5 and row.peak_rss_mb == 123.0


def test_worse_scene_scores_worse_by_what_is_wrong(scene_folder):
    perfect = perfect_snapshot()
    faded = replace(perfect, gaussians=replace(perfect.gaussians, opacities=np.full(500, 0.3, np.float32)))
    good, bad = score(perfect, scene_folder), score(faded, scene_folder)
    assert good.psnr is not None and bad.psnr is not None and bad.psnr < good.psnr - 15
    zoomed = replace(perfect, cameras=tuple(replace(c, K=c.K * [[1.04], [1.04], [1]]) for c in perfect.cameras))
    assert score(zoomed, scene_folder).focal_error_pct == pytest.approx(4.0)


def test_another_moment_of_a_run_goes_on_from_the_poses_that_were_found(scene_folder, monkeypatch):
    searched = []

    def align(*scene_and_view, steps, levels, **rate):
        searched.append((steps, levels))
        return find_test_pose(*scene_and_view, steps=steps, levels=levels, **rate)

    monkeypatch.setattr("splatnode.extras.evaluate.protocol.find_test_pose", align)
    poses: dict[str, np.ndarray] = {}
    end, earlier = (score(perfect_snapshot(), scene_folder, found=poses, continued_steps=2) for _ in range(2))
    assert searched == [(QUICK.alignment_steps, 1)] * 2 + [(2, 1)] * 2
    assert poses.keys() == set(SPLIT.test)
    assert end.psnr is not None and earlier.psnr is not None and earlier.psnr > 50


def test_what_photographs_do_not_show_is_not_scored(scene_folder, tmp_path, monkeypatch):
    spoilt = tmp_path / scene_folder.parent.name
    shutil.copytree(scene_folder.parent, spoilt)
    for path in (spoilt / scene_folder.name / "images").iterdir():
        image = cv2.imread(str(path))
        image[:3] = 255
        cv2.imwrite(str(path), image)

    def below(images):
        return [np.arange(len(image))[:, None] >= np.array([3] * image.shape[1]) for image in images]

    monkeypatch.setattr(keyframes, "valid_masks", below)
    row = score(perfect_snapshot(), spoilt / scene_folder.name)
    assert row.psnr is not None and row.psnr > 50
    assert row.psnr_with_rim is not None and row.psnr_with_rim < 20


def test_what_masks_hide_is_neither_given_nor_scored(scene_folder, tmp_path):
    folder = tmp_path / "masked"
    shutil.copytree(scene_folder, folder)
    (folder / "masks").mkdir()
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path))
        mask = np.full(image.shape[:2], 255, np.uint8)
        mask[: len(mask) // 4] = 0
        image[: len(mask) // 4] = (255, 0, 255)
        cv2.imwrite(str(path), image)
        cv2.imwrite(str(folder / "masks" / f"{path.stem}.png"), mask)
    frames = load_scene(folder).frames(SPLIT.train)
    assert all(each.mask is not None and not each.mask[: each.height // 4].any() for each in frames)
    name = SPLIT.test[0]
    image, mask = load_scene(folder).load_masked_image(name)
    assert np.array_equal(image[mask], load_scene(scene_folder).image(name)[mask])
    assert not (image == (255, 0, 255)).all(2).any()
    used = torch.from_numpy(mask)
    truth = torch.from_numpy(load_scene(scene_folder).image(name)).float() / 255
    spoilt = torch.where(used[..., None], truth, 1 - truth)
    assert psnr(spoilt, truth, used) == 100.0 and psnr(spoilt, truth) < 20.0


def masked_scene(folder: Path, masks: dict[str, np.ndarray]) -> Path:
    """The scene of blobs in `folder` with these masks (H, W) by the name of the photograph, True where it is used."""
    write_scene(folder)
    (folder / "masks").mkdir()
    for name, mask in masks.items():
        cv2.imwrite(str(folder / "masks" / name), np.where(mask, 255, 0).astype(np.uint8))
    return folder


def test_a_view_of_which_a_mask_leaves_no_whole_pixel_is_left_out(scene_folder, tmp_path):
    chequered = np.indices((HEIGHT, WIDTH)).sum(0) % 2 == 0  # half of it is used, and of no pixel of 48 all
    folder = masked_scene(tmp_path / "blobs", {SPLIT.test[0]: chequered})
    row = score(perfect_snapshot(), folder, longer_side=48)
    alone = score(perfect_snapshot(), folder, split=replace(SPLIT, test=SPLIT.test[1:]), longer_side=48)
    assert row.psnr == pytest.approx(alone.psnr, abs=0.5) and row.psnr > 30  # one photograph tells of no rim
    none = score(perfect_snapshot(), folder, split=replace(SPLIT, test=SPLIT.test[:1]), longer_side=48)
    assert (none.psnr, none.psnr_with_rim, none.verdict) == (None, None, "OK")


def test_a_view_of_which_a_mask_leaves_hardly_anything_is_left_out(scene_folder, tmp_path):
    sliver = np.zeros((HEIGHT, WIDTH), bool)
    sliver[:2] = True  # 3 %
    folder = masked_scene(tmp_path / "blobs", {SPLIT.test[0]: sliver})
    image, used = load_scene(folder).load_masked_image(SPLIT.test[0])
    assert image.shape == (HEIGHT, WIDTH, 3) and not used.any()
    assert score(perfect_snapshot(), folder, split=replace(SPLIT, test=SPLIT.test[:1])).psnr is None
    assert score(perfect_snapshot(), folder).psnr > 40


def test_what_a_mask_hides_does_not_move_the_pose_that_is_searched(scene_folder, tmp_path, monkeypatch):
    half = np.zeros((HEIGHT, WIDTH), bool)
    half[:, : WIDTH // 2] = True
    folder, asked = masked_scene(tmp_path / "blobs", {SPLIT.test[0]: half}), []

    def noted(*scene_and_view, used, **steps):
        asked.append(used)
        return find_test_pose(*scene_and_view, used=used, **steps)

    monkeypatch.setattr("splatnode.extras.evaluate.protocol.find_test_pose", noted)
    assert score(perfect_snapshot(), folder).psnr > 50
    assert 0.4 < asked[0].float().mean() < 0.6 and not asked[0][:, -1].any() and asked[1] is None


def test_refused_scene_is_not_scored_but_its_cameras_are(scene_folder):
    refused = replace(perfect_snapshot(), verdict=Verdict(Code.NO_PARALLAX, "No.", "Move."))
    row = score(refused, scene_folder)
    assert (row.verdict, row.psnr, row.ssim, row.scene_bytes) == ("NO_PARALLAX", None, None, 0)
    assert row.rotation_error_deg == pytest.approx(0, abs=1e-6)


def test_what_a_mask_hides_counts_as_well_rendered_in_ssim(scene_folder, tmp_path):
    upper = np.indices((HEIGHT, WIDTH))[0] < HEIGHT // 3
    folder = masked_scene(tmp_path / "blobs", dict.fromkeys(SPLIT.test, ~upper))
    for name in SPLIT.test:
        image = cv2.imread(str(folder / "images" / name))
        image[upper] = 255 - image[upper]
        cv2.imwrite(str(folder / "images" / name), image)
    row = score(perfect_snapshot(), folder)
    assert row.ssim > 0.995 and row.psnr > 45


def test_renders_get_the_light_that_was_taken_out_of_photographs(scene_folder, tmp_path):
    """A lens that keeps half of the light from the corners: with it renders are right, and without it too bright."""
    folder, falloff = tmp_path / "blobs", 0.7
    write_scene(folder)
    light = relative_illumination(falloff, WIDTH, HEIGHT)
    assert light.max() > 0.99 and light.min() < 0.6
    for path in (folder / "images").iterdir():
        dimmed = cv2.imread(str(path)) * light[..., None]
        cv2.imwrite(str(path), np.rint(dimmed).astype(np.uint8))
    told = replace(perfect_snapshot(), falloffs=dict.fromkeys(SPLIT.train, falloff))
    with_light, without = score(told, folder), score(perfect_snapshot(), folder)
    assert with_light.psnr > 45 and with_light.psnr > without.psnr + 10


def darken(folder: Path, drift: float) -> dict[str, float]:
    """Writes the scene's photographs with gains that grow along their order, by name."""
    names = list(load_scene(folder).paths)
    gains = dict(zip(names, np.exp(np.linspace(-drift, 0.0, len(names))), strict=True))
    for name, gain in gains.items():
        path = folder / "images" / name
        cv2.imwrite(str(path), np.rint(cv2.imread(str(path)) * gain).astype(np.uint8))
    return gains


def test_held_out_views_are_scored_with_the_gains_that_training_views_imply_and_with_the_best(scene_folder, tmp_path):
    folder = tmp_path / "blobs"
    write_scene(folder)
    gains = darken(folder, 0.3)
    told = replace(perfect_snapshot(), gains={name: (gains[name],) * 3 for name in SPLIT.train})
    published, measured = score(told, folder), score(perfect_snapshot(), folder)  # whose photographs nobody changed
    for row in (published, measured):
        raw, interpolated, best = (row.exposures[kind] for kind in EXPOSURES)
        assert raw.psnr < 30 and interpolated.psnr > raw.psnr + 8 and best.psnr > interpolated.psnr - 0.1
        assert interpolated.gain_error_pct < 2.0 and best.gain_error_pct == 0.0
        assert interpolated.ssim > raw.ssim and (row.psnr, row.ssim) == (interpolated.psnr, interpolated.ssim)
    alike = score(perfect_snapshot(), scene_folder)
    assert alike.exposures["raw"].psnr == alike.psnr  # what is noise changes nothing


def test_the_search_starts_from_the_true_pose_or_from_between_its_neighbours(scene_folder, monkeypatch):
    starts = []

    def align(scene, image, T_world_camera, *view, **steps):
        starts.append(T_world_camera)
        return find_test_pose(scene, image, T_world_camera, *view, **steps)

    monkeypatch.setattr("splatnode.extras.evaluate.protocol.find_test_pose", align)
    snapshot = perfect_snapshot()
    score(snapshot, scene_folder)
    score(snapshot, scene_folder, start="interpolated")
    cameras = {camera.name: camera.T_world_camera for camera in snapshot.cameras}
    between = [interpolate_pose(name, NAMES, cameras) for name in SPLIT.test]
    assert all(np.allclose(start, pose) for start, pose in zip(starts[2:], between, strict=True))
    assert not any(np.allclose(start, pose, atol=1e-3) for start, pose in zip(starts[:2], between, strict=True))


def test_a_mean_is_of_all_that_was_measured_also_of_nothing_at_all():
    assert compute_mean([0.0, 3.0, None]) == 1.5 and compute_mean([0.0]) == 0.0
    assert compute_mean([None, None]) is None and compute_mean([]) is None


def test_one_camera_cannot_be_aligned(scene_folder):
    row = score(replace(perfect_snapshot(), cameras=perfect_snapshot().cameras[:1]), scene_folder)
    assert (row.psnr, row.rotation_error_deg, row.centre_error_pct, row.num_cameras) == (None, None, None, 1)
    assert row.focal_error_pct == pytest.approx(0, abs=1e-6)


def test_intrinsics_are_carried_to_an_image_of_another_size():
    first = CameraEstimate("a", 0, np.eye(4), np.array([[100.0, 0, 50], [0, 100, 30], [0, 0, 1]]), 100, 60)
    second = replace(first, K=np.array([[110.0, 0, 52], [0, 110, 30], [0, 0, 1]]))
    found = average_intrinsics([first, second], 200, 120)
    assert np.allclose(found, [[210, 0, 102], [0, 210, 60], [0, 0, 1]])


def test_a_result_is_itself_a_scene_with_known_cameras(scene_folder, tmp_path):
    """So that two reconstructions can be compared with each other."""
    snapshot = perfect_snapshot()
    write_result(snapshot, tmp_path, build_report(snapshot, seed=0, preset="p", peak_rss_mb=None))
    os.symlink(scene_folder / "images", tmp_path / "images")
    row = score(snapshot, tmp_path)
    assert row.rotation_error_deg == pytest.approx(0, abs=1e-6)


def test_a_search_from_between_the_neighbours_finds_the_view_too(scene_folder):
    row = score(perfect_snapshot(), scene_folder, start="interpolated", alignment_steps=200, alignment_levels=3)
    untouched = score(perfect_snapshot(), scene_folder, start="interpolated", alignment_steps=1)
    assert row.psnr is not None and untouched.psnr is not None and row.psnr > 40 > untouched.psnr
