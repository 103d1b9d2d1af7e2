"""Photographs of different exposure make the scene that those of one exposure make, in the light of their median."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from splatnode.capture.cameras import synthetic
from splatnode.capture.frame import Frame
from splatnode.recon.config import apply_changes, preset
from splatnode.recon.geometry import align_cameras
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.pipeline import run
from splatnode.recon.result.rendering import render_arrays
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.view_exposure import collect_view_gains, interpolate_gains, relative_illumination
from tests.support.synthetic import SMALL, photographs

CONFIG = apply_changes(preset("preview"), {"size": 320})
GAINS = (0.55, 1.0, 0.8, 1.0, 0.6, 1.0)


def exposed(frame: Frame) -> Frame:
    dimmed = np.rint(frame.image * GAINS[frame.frame_id]).astype(np.uint8)
    return replace(frame, image=dimmed, encoded=None)


@lru_cache(maxsize=3)
def snapshot_of(differing: bool, enabled: bool = True) -> Snapshot:
    config = apply_changes(CONFIG, {"exposure_compensation": {"enabled": enabled}})
    return run([exposed(each) if differing else each for each in photographs()], config)


def held_out_psnr(snapshot: Snapshot) -> float:
    """dB, with the gain that fits each held-out photograph best."""
    true = synthetic.scene_cameras(SMALL)
    known = np.stack([true[camera.frame_id][0] for camera in snapshot.cameras])
    similarity = align_cameras(known, np.stack([camera.T_world_camera for camera in snapshot.cameras]))
    K, errors = snapshot.cameras[0].K, []
    for T, _ in synthetic.evaluation_cameras(SMALL):
        photograph = synthetic.render_image(SMALL, (T, K), 99) / 255.0
        shown = render_arrays(snapshot.gaussians, similarity.camera(T), K, SMALL.width, SMALL.height).rgb
        gain = (shown * photograph).sum((0, 1)) / (shown * shown).sum((0, 1))
        errors.append(((gain * shown - photograph) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_gains_are_found_told_and_taken_out():
    snapshot = snapshot_of(True)
    assert snapshot.verdict.publishable and len(snapshot.cameras) == SMALL.views
    expected = np.array(GAINS) / np.median(GAINS)
    found = np.array([snapshot.gains[camera.name] for camera in snapshot.cameras])
    assert found == pytest.approx(np.repeat(expected[:, None], 3, 1), rel=0.05)
    told = build_report(snapshot, seed=0, preset="preview", peak_rss_mb=None)["gains"]
    assert isinstance(told, dict) and len(told) == SMALL.views
    means = np.array([snapshot.images[camera.name].mean() for camera in snapshot.cameras])
    assert means.max() / means.min() < 1.25  # of what the scene is fitted to; as photographed it is 1.8


def test_held_out_views_are_as_good_as_of_one_exposure():
    alike = held_out_psnr(snapshot_of(False))
    assert held_out_psnr(snapshot_of(True)) > alike - 0.5
    assert held_out_psnr(snapshot_of(True, enabled=False)) < alike - 1.5  # it is not for nothing


def test_a_scene_has_what_is_white_in_all_but_a_few_photographs():
    gains = np.array([0.5, 1.0, 0.5, 1.0, 1.0, 1.0]) * 1.8

    def bright(frame: Frame) -> Frame:
        image = np.minimum(np.rint(frame.image * gains[frame.frame_id]), 255).astype(np.uint8)
        return replace(frame, image=image, encoded=None)

    frames = [bright(each) for each in photographs()]
    assert np.mean([(frame.image == 255).any(-1).mean() for frame in frames]) > 0.4
    snapshot = run(frames, CONFIG)
    assert np.median([snapshot.gains[camera.name] for camera in snapshot.cameras]) == pytest.approx(1.0, abs=0.02)
    assert held_out_psnr(snapshot) > held_out_psnr(snapshot_of(False)) - 3.0  # by 8, were it clipped
    brightest = max(snapshot.images.values(), key=lambda image: image.mean())
    assert brightest.max() == 255  # photographs, too, are in the light that is published


def test_photographs_of_one_exposure_are_untouched():
    snapshot = snapshot_of(False)
    assert snapshot.gains == {} and all(
        np.array_equal(snapshot.images[frame.name], frame.image) for frame in photographs()
    )


DRIFT = 1.25  # of the last photograph's gain over the first's, as of an automatic exposure


def drifting(frame: Frame) -> Frame:
    gain = DRIFT ** (frame.frame_id / (SMALL.views - 1) - 1.0)
    return replace(frame, image=np.rint(frame.image * gain).astype(np.uint8), encoded=None)


def drifting_psnr(snapshot: Snapshot, interpolate: bool) -> float:
    """dB of held-out photographs with the gains of their places between the others."""
    true = synthetic.scene_cameras(SMALL)
    known = np.stack([true[camera.frame_id][0] for camera in snapshot.cameras])
    similarity = align_cameras(known, np.stack([camera.T_world_camera for camera in snapshot.cameras]))
    K, errors = snapshot.cameras[0].K, []
    gains = collect_view_gains(snapshot.cameras, snapshot.gains, snapshot.gain_sigmas)
    for index, (T, _) in enumerate(synthetic.evaluation_cameras(SMALL)):
        gain = DRIFT ** ((index + 0.5) / (SMALL.views - 1) - 1.0)
        photograph = gain * synthetic.render_image(SMALL, (T, K), 99) / 255.0
        shown = render_arrays(snapshot.gaussians, similarity.camera(T), K, SMALL.width, SMALL.height).rgb
        implied = interpolate_gains(gains, similarity.camera(T)).gains if interpolate else np.ones(3)
        errors.append(((np.clip(implied * shown, 0, 1) - photograph) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_held_out_views_of_a_drifting_exposure_are_shown_in_the_exposure_of_their_place():
    frames = [drifting(each) for each in photographs()]
    snapshot = run(frames, CONFIG)
    expected = DRIFT ** (np.arange(SMALL.views) / (SMALL.views - 1))
    found = np.array([snapshot.gains[camera.name] for camera in snapshot.cameras])
    assert found / found[0] == pytest.approx(np.repeat(expected[:, None], 3, 1), rel=0.03)
    sigmas = np.array([snapshot.gain_sigmas[camera.name] for camera in snapshot.cameras])
    assert (sigmas > 0).all() and (sigmas < 0.03).all()
    interpolated = drifting_psnr(snapshot, interpolate=True)
    assert interpolated > drifting_psnr(snapshot, interpolate=False) + 1.0
    off = run(frames, apply_changes(CONFIG, {"exposure_compensation": {"enabled": False}}))
    assert interpolated > drifting_psnr(off, interpolate=True) - 0.1


FALLOFF = 0.9  # two fifths of the light reach the corners


def dimmed(frame: Frame) -> Frame:
    light = relative_illumination(FALLOFF, frame.width, frame.height)[..., None]
    return replace(frame, image=np.rint(frame.image * light).astype(np.uint8), encoded=None)


def test_vignetting_is_found_told_and_taken_out():
    snapshot = run([dimmed(each) for each in photographs()], CONFIG)
    assert snapshot.verdict.publishable and snapshot.gains == {}
    assert [snapshot.falloffs[camera.name] for camera in snapshot.cameras] == pytest.approx([FALLOFF] * 6, abs=0.1)
    told = build_report(snapshot, seed=0, preset="preview", peak_rss_mb=None)["vignetting"]
    assert isinstance(told, dict) and told == pytest.approx(dict.fromkeys(told, 1.0 - np.exp(-FALLOFF)), abs=0.05)
    assert held_out_psnr(snapshot) > held_out_psnr(snapshot_of(False)) - 1.2  # dark corners have less of 8 bits


LATER = (1.0, 1.0, 1.0, 0.6, 0.5, 1.0)  # the camera closes its iris on the way


def grown(enabled: bool) -> IncrementalReconstruction:
    """A scene that took its photographs one at a time, and was begun with those of one exposure."""
    work = IncrementalReconstruction(apply_changes(CONFIG, {"exposure_compensation": {"enabled": enabled}}))
    for frame in photographs():
        dimmed = np.rint(frame.image * LATER[frame.frame_id]).astype(np.uint8)
        work.add_frame(replace(frame, image=dimmed, encoded=None))
        work.update()
    return work


def test_photographs_that_join_a_live_scene_are_brought_to_its_light():
    work = grown(True)
    snapshot = work.snapshot()
    assert len(snapshot.cameras) == SMALL.views
    found = np.array([snapshot.gains.get(camera.name, (1.0, 1.0, 1.0)) for camera in snapshot.cameras])
    assert found / found[0] == pytest.approx(np.repeat(np.array(LATER)[:, None], 3, 1), rel=0.05)
    assert held_out_psnr(snapshot) > held_out_psnr(grown(False).snapshot()) + 0.5
