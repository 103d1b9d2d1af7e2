"""Each rival's recipe, number by number as the publications have it; what is cut down, its own module says."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="stock COLMAP needs pycolmap (pip install 'splatnode[bench]')")

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.rivals import cf_3dgs, colmap, colmap_3dgs, colmap_fsgs, nerfmm, nope_nerf
from splatnode.recon.optimize.control import adaptive
from splatnode.recon.result.verdict import Code


def make_frames(count: int, size: tuple[int, int] = (32, 24)) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [Frame(i, f"{i}.png", i, rng.integers(0, 256, (*size[::-1], 3), dtype=np.uint8), None) for i in range(count)]


def settings_of(record: msgspec.Struct, *names: str) -> dict[str, object]:
    return {name: getattr(record, name) for name in names}


def test_3dgs_takes_the_step_sizes_of_its_publication():
    rates = msgspec.structs.asdict(colmap_3dgs.RATES)
    published = {"means": 1.6e-4, "quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 5e-2, "sh": 2.5e-3}
    assert {name: rates[name] for name in published} == published
    assert rates["final_means"] == 0.01 and rates["final"] == 1.0  # means alone fall, to a hundredth
    assert colmap_3dgs.OPTIMIZE.ssim_lambda == 0.2 and not colmap_3dgs.OPTIMIZE.refine_poses
    assert colmap_3dgs.OPTIMIZE.iterations == 1500 and colmap_3dgs.PUBLISHED.iterations == 7000
    assert colmap_3dgs.PUBLISHED.lr.final_means == pytest.approx(0.01 ** (7 / 30))  # the longer run falls further


def test_3dgs_grows_and_prunes_as_its_publication_does():
    published = {
        "min_gradient": 2e-4, "min_opacity": 0.005, "clone_scale": 0.01, "max_scale": 0.1, "max_radius_px": 20.0,
        "split_factor": 1.6, "reset_opacity": 0.01,
    }  # fmt: skip
    short, long = (each.control.config for each in (colmap_3dgs.OPTIMIZE, colmap_3dgs.PUBLISHED))
    assert settings_of(short, *published) == settings_of(long, *published) == published
    assert (short.end, short.reset_every, short.max_gaussians) == (0.5, 0.2, 100_000)
    assert (long.every, round(7000 * long.start), round(7000 * long.reset_every)) == (100, 500, 3000)


def test_3dgs_starts_with_a_gaussian_of_a_tenth_of_the_opacity_for_each_point():
    points = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    model = colmap.SparseModel((), points, np.full((12, 3), 51, np.uint8), ())
    gaussians = colmap_3dgs.initialize_scene(model, 0).gaussians
    np.testing.assert_allclose(gaussians.means.numpy(), points, rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities.numpy(), 0.1, rtol=1e-5)
    np.testing.assert_allclose(gaussians.rgb.numpy(), 0.2, atol=1e-6)


def test_fsgs_correlates_whole_images_and_grows_between_three_neighbours():
    ((name, loss),) = colmap_fsgs.OPTIMIZE.regularizers.losses.items()
    assert (name, loss.kind) == ("depth", "depth") and loss.config.share == 1.0 and loss.config.patch >= 512 * 512
    assert (loss.config.weight, loss.config.start, loss.config.end) == (0.05, 0.2, 0.95)
    control = colmap_fsgs.OPTIMIZE.control
    assert control.kind == "proximity" and control.config.neighbours == 3
    grown = control.config.adaptive
    assert (grown.min_gradient, grown.start, grown.end, grown.reset_every) == (5e-4, 0.05, 0.95, adaptive.NEVER)
    assert colmap_fsgs.OPTIMIZE.lr == colmap_3dgs.RATES and colmap_fsgs.PUBLISHED.iterations == 10_000
    assert colmap_fsgs.PUBLISHED.control.config.adaptive.every == 100


def test_cf_3dgs_has_the_iterations_that_its_module_tells():
    told = {"alone": 60, "motion": 200, "motion_rate": 0.01, "growing": 60, "final": 500, "stride": 3, "opacity": 0.5}
    assert msgspec.structs.asdict(cf_3dgs.Config()) == told
    assert settings_of(cf_3dgs.PUBLISHED, "alone", "motion", "growing") == {
        "alone": 1000,
        "motion": 300,
        "growing": 1000,
    }
    assert cf_3dgs._TOGETHER.control.config.reset_every == adaptive.NEVER and cf_3dgs._ALONE.control is None


def test_nerf_starts_with_a_focal_length_of_the_image_s_size_and_learns_it(monkeypatch):
    asked = []
    monkeypatch.setattr(
        nerfmm, "fit_field", lambda images, used, focal, *rest, **named: asked.append((images, focal)) or []
    )
    with pytest.raises(AssertionError):  # without an end there is no last snapshot
        list(nerfmm.reconstruct(make_frames(3, (512, 384)), 0))
    ((images, focal),) = asked
    assert float(focal.K(64, 48)[0, 0].detach()) == pytest.approx(64.0)
    assert all(parameter.requires_grad for parameter in focal.parameters())
    assert {tuple(image.shape) for image in images} == {(192, 256, 3)}
    assert settings_of(nerfmm.OPTIMIZE, "iterations", "rays") == {"iterations": 1500, "rays": 384}


def test_nope_nerf_has_the_weights_of_its_publication():
    assert (nope_nerf._DEPTH, nope_nerf._CLOUD, nope_nerf._SURFACE, nope_nerf._PAIRS_UNTIL) == (0.04, 1.0, 1.0, 0.6)
    assert nope_nerf.OPTIMIZE is nerfmm.OPTIMIZE


def test_two_cameras_are_no_answer_of_a_rival():
    frames = make_frames(4)
    assert [methods.make_verdict(frames, [f"{i}.png" for i in range(n)]).code for n in (2, 3, 4)] == [
        Code.NO_OVERLAP,
        Code.OK_PARTIAL,
        Code.OK,
    ]


def test_the_largest_of_colmap_s_models_that_has_points_counts(tmp_path, monkeypatch):
    def model(images: int, points: int) -> SimpleNamespace:
        return SimpleNamespace(num_reg_images=lambda: images, num_points3D=lambda: points)

    small, large, empty = model(2, 50), model(5, 20), model(7, 0)
    monkeypatch.setattr(colmap, "_convert_model", lambda found, named: found)
    for number, found in enumerate(((small, large, empty), (large, small), (empty,))):
        folder = tmp_path / str(number)
        folder.mkdir()
        chosen = colmap.map_largest_model(folder, {}, 0, lambda *_: dict(enumerate(found)))  # noqa: B023
        assert chosen is (None if found == (empty,) else large)


def test_colmap_s_photographs_of_one_size_share_a_camera(tmp_path):
    frames = [
        *make_frames(2, (96, 64)),
        *(replace(each, name=f"other-{each.name}") for each in make_frames(1, (64, 96))),
    ]
    colmap.extract_features(tmp_path, colmap.name_images(frames), 0)
    with colmap._open_database(tmp_path) as (database, _):
        cameras = [image.camera_id for image in database.read_all_images()]
    assert len(cameras) == 3 and len(set(cameras)) == 2
