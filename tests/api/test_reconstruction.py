"""`splatnode.reconstruct`: what goes in, what comes out, and that it is what `splatnode replay` makes."""

from __future__ import annotations

import logging
import pickle
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

import splatnode
from splatnode import command_line
from splatnode.capture.image_file import encode_png
from splatnode.capture.process import terminal
from splatnode.recon import core
from splatnode.recon.geometry import umeyama
from tests.api.conftest import QUICK, SMALL
from tests.support.synthetic import errors


def same(a: splatnode.Result, b: splatnode.Result) -> bool:
    """To the bit."""
    cameras = [
        np.array_equal(one.T_world_camera, other.T_world_camera) and np.array_equal(one.K, other.K)
        for one, other in zip(a.cameras, b.cameras, strict=True)
    ]
    ours, theirs = a.gaussians, b.gaussians
    return all(cameras) and all(np.array_equal(ours[name], theirs[name]) for name in ours) and len(ours["means"]) > 0


def test_it_is_what_replay_makes_of_the_folder(folder, tmp_path, capsys):
    config = tmp_path / "config.yaml"
    config.write_text("optimize: {iterations: 40}\n")
    out = ["--out", str(tmp_path / "replayed"), "--config", str(config), "--seed", "3"]
    assert command_line.main(["replay", str(folder), *out]) == 0
    capsys.readouterr()
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT), logging.getLogger().handlers[:]
    made = splatnode.reconstruct(folder, config=config, seed=3).save(tmp_path / "saved")
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT), logging.getLogger().handlers) == before
    assert capsys.readouterr() == ("", "")
    names = {path.relative_to(made) for path in made.rglob("*") if path.is_file()}
    assert names == {path.relative_to(tmp_path / "replayed") for path in (tmp_path / "replayed").rglob("*.*")}
    for name in sorted(str(each) for each in names if each.name not in ("report.json", "manifest.json")):
        assert (made / name).read_bytes() == (tmp_path / "replayed" / name).read_bytes(), name


def test_arrays_paths_and_pil_images_give_the_same(result, arrays, folder):
    image = pytest.importorskip("PIL.Image")
    paths = sorted(folder.iterdir())
    assert same(splatnode.reconstruct(paths, config=QUICK), result)
    opened = [image.open(path) for path in paths]
    assert same(splatnode.reconstruct(opened, config=QUICK), result)
    assert [camera.name for camera in result.cameras] == [path.name for path in paths]
    assert same(splatnode.reconstruct(np.stack(arrays), config=QUICK), result)


def test_the_cameras_are_right(result):
    found = errors(result._snapshot, SMALL)
    assert found.rotation_deg < 1.0 and found.centre_pct < 5.0


def test_two_at_once_give_what_each_gives_alone(result, arrays):
    def made(threads: int | None) -> splatnode.Result:
        return splatnode.reconstruct(arrays, config=QUICK, threads=threads)

    before = torch.get_num_threads(), core.library().core_get_threads()
    with ThreadPoolExecutor(2) as pool:
        assert all(same(each, result) for each in pool.map(made, [1, None]))
    assert (torch.get_num_threads(), core.library().core_get_threads()) == before


def test_a_caller_keeps_the_array_and_may_change_it(arrays):
    copies = [arrays[0].copy(), arrays[0].copy()]
    made = splatnode.reconstruct(copies, config=QUICK)
    copies[0][:] = 0
    assert made._files.source.frames[0].image.any()  # pyright: ignore[reportAttributeAccessIssue]


def test_a_refusal_is_a_value(arrays, tmp_path):
    made = splatnode.reconstruct([arrays[0], arrays[0]])
    assert not made.verdict.publishable and made.verdict.advice and made.cameras == ()
    assert len(made.gaussians["means"]) == 0 and made.gaussians["sh"].shape[0] == 0
    with pytest.raises(ValueError, match="there is no scene to render: STATIC_CAMERA"):
        made.render(np.eye(4), np.diag([100.0, 100, 1]), (64, 48))
    again = splatnode.load(made.save(tmp_path / "refused"))
    assert again.verdict == made.verdict and again.cameras == ()
    assert "STATIC_CAMERA: 0 cameras" in repr(made)


def test_who_waits_hears_how_long_the_rest_of_a_step_takes(arrays, monkeypatch):
    monkeypatch.setattr(terminal, "_TELLS_S", 0.0)
    heard = []
    splatnode.reconstruct(arrays[:3], config=QUICK, tell=heard.append)
    steps = [step for step in heard if not isinstance(step, str)]
    left = {name: [step.left_s for step in steps if step.doing == name] for name in ("matching", "refining the scene")}
    assert (
        left["refining the scene"][0] is None and left["refining the scene"][-1] is None
    )  # nothing known, nothing left
    assert all(any(each is not None and each >= 0 for each in told) for told in left.values())
    assert all(step.left_s is None for step in steps if not step.of)


def test_who_waits_hears_what_is_done_and_can_end_it(arrays):
    heard = []

    def stop(step) -> None:
        heard.append(step)
        if getattr(step, "doing", "") == "refining the scene":
            raise TimeoutError

    with pytest.raises(TimeoutError):
        splatnode.reconstruct(arrays[:2], config=QUICK, tell=stop)
    assert "matching" in {step.doing for step in heard if not isinstance(step, str)}


def test_metres_from_a_known_distance(result, arrays):
    made = splatnode.reconstruct(arrays, config=QUICK, scale=(0, 2, 0.5))
    centres = [camera.centre for camera in made.cameras]
    assert made.metric and not result.metric
    assert np.linalg.norm(centres[0] - centres[2]) == pytest.approx(0.5)


def test_a_lens_that_was_given_is_used_and_told(result, arrays):
    K = result.cameras[0].K
    made = splatnode.reconstruct(arrays, config=QUICK, intrinsics=K)
    lens = made.cameras[0].lens
    assert lens is not None and lens.fx == pytest.approx(K[0, 0]) and lens.source == "given"
    assert result.cameras[0].lens is None
    wide = splatnode.Intrinsics(640, 480, 600, 600, 320, 240, "calibration", distortion=(-0.002, 0.0, 0.0, 0.0))
    assert splatnode.reconstruct(arrays, config=QUICK, intrinsics=wide).cameras[0].lens == wide.resized(320, 240)


@pytest.mark.parametrize("by_name", [False, True], ids=["a list", "by name"])
def test_photographs_of_two_cameras_get_their_lenses(result, arrays, by_name):
    """Every second photograph is an enlargement, as of another camera: with both lenses told, cameras stay right."""
    K = result.cameras[0].K
    near = np.diag([1.25, 1.25, 1.0]) @ K
    near[:2, 2] -= 0.125 * np.array([320, 240])
    images = [cv2.resize(each[24:216, 32:288], (320, 240)) if i % 2 else each for i, each in enumerate(arrays)]
    lenses = {f"{i:04d}.png": near if i % 2 else K for i in range(len(images))} if by_name else [
        near if i % 2 else K for i in range(len(images))
    ]  # fmt: skip
    made = splatnode.reconstruct(images, config=QUICK, intrinsics=lenses)
    assert made.verdict.publishable and len(made.cameras) == len(arrays)
    assert [camera.lens.fx / K[0, 0] for camera in made.cameras] == pytest.approx([1.0, 1.25] * (len(arrays) // 2))
    centres = np.stack([camera.centre for camera in made.cameras])
    known = np.stack([camera.centre for camera in result.cameras])
    assert np.linalg.norm(umeyama(centres, known)(centres) - known, axis=1).max() < 0.02


@pytest.mark.parametrize(
    ("lenses", "kind", "said"),
    [
        ([np.eye(3)], ValueError, "one lens, or as many as there are images, 4; got 1"),
        ({"left": np.eye(3)}, ValueError, "a lens of 'left', which is no photograph's"),
        ({0: np.eye(3)}, TypeError, "names of photographs, cameras or patterns as its keys"),
    ],
)
def test_lenses_that_are_of_no_photograph_are_refused(arrays, lenses, kind, said):
    with pytest.raises(kind, match=said):
        splatnode.reconstruct(arrays, config=QUICK, intrinsics=lenses)


@pytest.mark.parametrize("only", ["multi_view_only", "only_seen"])
def test_what_is_left_out_is_named(arrays, tmp_path, only):
    for index, image in enumerate(arrays[:2]):
        (tmp_path / f"{index}.png").write_bytes(encode_png(image))
    (tmp_path / "broken.png").write_bytes(b"no image")
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        made = splatnode.reconstruct(tmp_path, config={"optimize": {"iterations": 2}}, **{only: True})
    told = [(str(each.message), each.category, each.filename) for each in heard]
    former = "the argument only_seen is called multi_view_only now; the former name is read in this release only"
    assert told == ([(former, DeprecationWarning, __file__)] if only == "only_seen" else [])
    assert [each.name for each in made.dropped] == ["broken.png"] and made.dropped[0].reason
    assert made.gaussians["seen"].all() and len(made.gaussians["seen"])


def test_a_result_can_be_pickled(result, tmp_path):
    again = pickle.loads(pickle.dumps(result))
    assert same(again, result) and again.verdict == result.verdict
    again.save(tmp_path / "a")
    result.save(tmp_path / "b")
    assert (tmp_path / "a" / "scene.ply").read_bytes() == (tmp_path / "b" / "scene.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"images": []}, ValueError, "at least one photograph, got none"),
        ({"images": 3}, TypeError, "must be a folder, a video, or a list, got int"),
        ({"images": ["a.jpg", np.zeros((4, 4, 3), np.uint8)]}, TypeError, "all paths or all pictures, got both"),
        ({"images": "nowhere"}, FileNotFoundError, "'nowhere' is not there; give a folder"),
        ({"images": [np.zeros((4, 4, 3))]}, TypeError, "image 0000.png: must be uint8, got float64"),
        ({"images": [np.zeros((3, 4, 4), np.uint8), object()]}, TypeError, "must be a NumPy array .* got object"),
        ({"images": [np.zeros((3, 40, 40), np.uint8)]}, ValueError, r"must be \(H, W, 3\), got \(3, 40, 40\)"),
        ({"preset": "best"}, ValueError, "no preset 'best'; there are: preview"),
        ({"config": {"optimise": {}}}, ValueError, "optimise"),
        ({"config": 3}, TypeError, "config must be a mapping or a YAML file, got int"),
        ({"budget_s": -1}, ValueError, "budget_s"),
        ({"threads": 0}, ValueError, "threads must be a whole number of 1 or more, or None, got 0"),
        ({"views": 1.5}, ValueError, "views must be a whole number"),
        ({"views": 9}, ValueError, "9 views are asked for: there are 2 photographs"),
        ({"scale": (0, 1)}, TypeError, "scale must be two photographs and the metres"),
        ({"scale": (0, 7, 0.5)}, ValueError, "photograph '0007.png' is not among those that are used: 0000.png"),
        ({"scale": (0.5, 1, 0.5)}, TypeError, "name photographs by their files, or pictures by their places"),
        ({"intrinsics": np.eye(4)}, TypeError, r"Intrinsics or a matrix K \(3, 3\), got \(4, 4\)"),
        ({"intrinsics": np.zeros((3, 3))}, ValueError, "focal lengths above 0"),
        (
            {"intrinsics": splatnode.Intrinsics(100, 100, 90, 90, 50, 50, "given")},
            ValueError,
            "got those of 100 x 100 for 320 x 240",
        ),
    ],
)
def test_a_wrong_argument_is_told_before_the_work(arrays, arguments, error, said):
    with pytest.raises(error, match=said):
        splatnode.reconstruct(**{"images": arrays[:2], **arguments})
