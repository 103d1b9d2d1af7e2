"""A rig that is given makes scenes in metres: a camchain, whose lenses count, too, or the transforms of a log."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatnode
from splatnode import command_line
from splatnode.capture.film import select_cameras
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import encode_png
from splatnode.capture.process.terminal import InputWarning, give_warnings, ignore_progress
from splatnode.capture.rig import Rig, RigCamera, format_rig, read_rig
from splatnode.recon import cli
from splatnode.recon.config import ReconstructionConfig, apply_changes
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.estimation import load_prior
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.replay_source import (
    DRAWN_SIGMA_DEG,
    DRAWN_SIGMA_M,
    Source,
    add_rig_lenses,
    apply_rig,
    choose_rig,
    describe_rig_use,
    hold_rig,
)
from splatnode.recon.threads import Clock
from tests.support import mcap_files
from tests.support.rig_walk import RigWalk, make_rig_walk, true_mounts

SIZE = (320, 240)
IDS = {"front": "cam0", "left": "cam1"}  # Kalibr numbers the cameras
QUICK: dict[str, Any] = {"size": 160, "optimize": {"iterations": 4}}


@pytest.fixture(scope="module")
def walk() -> RigWalk:
    mounts = {camera: T for camera, T in true_mounts().items() if camera in IDS}
    return make_rig_walk(5, mounts, size=SIZE, lens_told=True)


def lens_of(walk: RigWalk):
    lens = walk.frames[0].intrinsics
    assert lens is not None
    return lens


def write_camchain(walk: RigWalk, file: Path) -> Path:
    """The cameras of the walk, as Kalibr writes them: its pixels begin at their centres."""
    lens = lens_of(walk)
    told = {
        "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4,
        "intrinsics": [lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5], "resolution": list(SIZE),
    }  # fmt: skip
    T_left_front = np.linalg.inv(true_mounts()["left"]) @ true_mounts()["front"]
    file.write_text(json.dumps({"cam0": told, "cam1": {**told, "T_cn_cnm1": T_left_front.tolist()}}))
    return file


def write_folders(walk: RigWalk, folder: Path) -> Path:
    """A folder of each camera; the photographs' names have their times."""
    for frame in walk.frames:
        path = folder / IDS[frame.camera_id] / name_of(frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(frame.image))
    return folder


def name_of(frame: Frame) -> str:
    assert frame.captured_at is not None
    return f"{1_700_000_000_000_000_000 + frame.captured_at.ns}.png"


def write_log(walk: RigWalk, file: Path) -> Path:
    """Images without a calibration, and the transforms of the cameras under base_link, which stand still."""
    messages = []
    for camera in IDS:
        T = true_mounts()[camera]
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        told = {
            "parent_frame_id": "base_link", "child_frame_id": f"{camera}_optical",
            "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        }  # fmt: skip
        messages.append(mcap_files.as_json("/tf", "FrameTransform", told))
    for frame in walk.frames:
        assert frame.captured_at is not None
        at_ns = mcap_files.START_NS + frame.captured_at.ns
        sensor = f"{frame.camera_id}_optical"
        messages.append(mcap_files.compressed(f"/{frame.camera_id}/image", frame.image, sensor, at_ns))
    return mcap_files.write(file, messages)


def check_metres(centres: dict[str, np.ndarray], walk: RigWalk, share: float) -> None:
    """Between all cameras there are as many metres as there are in truth."""
    names = sorted(centres)
    assert len(names) == len(walk.frames)
    found, true = (
        np.stack([of[name] for name in names]) for of in (centres, {n: T[:3, 3] for n, T in walk.poses.items()})
    )
    between, truly = (
        np.linalg.norm(each[:, None] - each, axis=2)[np.triu_indices(len(names), 1)] for each in (found, true)
    )
    assert np.median(between / truly) == pytest.approx(1.0, abs=share)


def test_photographs_and_a_camchain_are_a_scene_in_metres(walk: RigWalk, tmp_path: Path) -> None:
    folder, out = write_folders(walk, tmp_path / "shots"), tmp_path / "out"
    quick = tmp_path / "quick.yaml"
    quick.write_text(json.dumps(QUICK))
    camchain = write_camchain(walk, tmp_path / "camchain.yaml")
    arguments = ["--cameras", "all", "--rig", str(camchain), "--config", str(quick), "--out", str(out)]
    assert command_line.main(["replay", str(folder), *arguments]) == 0
    cameras = json.loads((out / "cameras.json").read_text())
    assert cameras["scale"] == "metric" and "rig of 2 cameras" in cameras["scale_source"]
    called = {f"{IDS[frame.camera_id]}/{name_of(frame)}": frame.name for frame in walk.frames}
    placed = {called[each["name"]]: np.array(each["T_world_camera"])[:3, 3] for each in cameras["cameras"]}
    check_metres(placed, walk, 0.02)
    lens = lens_of(walk)
    assert {round(each["K"][0][0] / each["width"], 6) for each in cameras["cameras"]} == {
        round(lens.fx / lens.width, 6)
    }
    rig = read_rig(out / "rig.yaml")
    front, left = (rig.find_camera(camera) for camera in ("cam0", "cam1"))
    assert front is not None and left is not None and front.matrix is not None and left.matrix is not None
    off = np.linalg.inv(np.linalg.inv(front.matrix) @ left.matrix) @ true_mounts()["left"]
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 0.1
    assert np.linalg.norm(off[:3, 3]) < 0.005


def test_a_log_tells_its_rig(walk: RigWalk, tmp_path: Path) -> None:
    log, heard = write_log(walk, tmp_path / "drive.mcap"), []
    made = splatnode.reconstruct(
        log, cameras="all", intrinsics=lens_of(walk), config=QUICK, every_frame=True, tell=heard.append
    )
    assert made.verdict.publishable, made.verdict
    assert made.metric
    assert any("static transforms" in str(each) for each in heard)
    taken_at = {frame.captured_at.ns: frame.name for frame in walk.frames if frame.captured_at is not None}
    found = {each.captured_at.ns - mcap_files.START_NS: each for each in made.cameras if each.captured_at is not None}
    placed = {taken_at[at_ns]: each.T_world_camera[:3, 3] for at_ns, each in found.items()}
    check_metres(placed, walk, 0.05)


def test_a_camera_that_turned_on_its_rig_is_noticed_and_named() -> None:
    turned = true_mounts()["left"]
    turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("y", 3.0, degrees=True).as_matrix()
    walk = make_rig_walk(6, later={"left": turned}, moved_at=4, size=(256, 192), lens_told=True)
    config = ReconstructionConfig(no_fallbacks=True)
    estimate, _ = estimate_frame_cameras(walk.frames, load_prior(config), config, Clock())
    assert estimate.publishable and estimate.rig is not None, estimate.verdict
    (change,) = estimate.rig.changes
    assert (change.camera_ids, change.first, change.count) == (("left",), 4, 2)
    assert change.degrees == pytest.approx(3.0, abs=0.2)
    assert "left from frame set 5 on (2 sets) by 3 degrees" in estimate.verdict.message
    assert "Fasten" in estimate.verdict.advice


# Parts: which rig is chosen, and onto which frames its lenses are put.


def test_transforms_are_less_sure_than_a_calibration(walk: RigWalk, tmp_path: Path) -> None:
    told, cameras = [], select_cameras([write_log(walk, tmp_path / "drive.mcap")])
    rig = choose_rig(None, cameras, told.append)
    assert rig is not None
    assert {(each.sigma_m, each.sigma_deg) for each in rig.cameras} == {(DRAWN_SIGMA_M, DRAWN_SIGMA_DEG)}
    own = tmp_path / "rig.yaml"
    own.write_text(format_rig([(camera, true_mounts()[camera], 0.001, 0.1) for camera in IDS], metric=True))
    chosen = choose_rig(own, cameras, told.append)
    assert chosen is not None and chosen.cameras[0].sigma_m == 0.001


def test_a_log_without_transforms_is_used_all_the_same(walk: RigWalk, tmp_path: Path) -> None:
    messages = [mcap_files.compressed(f"/{each.camera_id}/image", each.image) for each in walk.frames[:4]]
    told = []
    assert choose_rig(None, select_cameras([mcap_files.write(tmp_path / "a.mcap", messages)]), told.append) is None
    assert "does not tell where the camera" in told[0]


def test_only_a_lens_that_nobody_gave_is_the_rigs(walk: RigWalk) -> None:
    lens = lens_of(walk)
    other = replace(lens, fx=2 * lens.fx, fy=2 * lens.fy)
    rig = Rig(tuple(RigCamera(camera, intrinsics=other) for camera in IDS))
    given, nominal, none = (
        walk.frames[0],
        replace(walk.frames[1], intrinsics=replace(lens, source="exif")),
        walk.frames[2],
    )
    frames = given, nominal, replace(none, intrinsics=None)
    found = cast("tuple[Frame, ...]", add_rig_lenses(Source(frames, None, None), rig).frames)
    assert [frame.intrinsics.fx for frame in found if frame.intrinsics] == [lens.fx, other.fx, other.fx]


def test_a_rig_of_other_cameras_is_told(walk: RigWalk) -> None:
    rig = Rig((RigCamera("cam0"), RigCamera("cam1")))
    with pytest.raises(ValueError, match="it has cam0, cam1, and the images are of front, left.*--cameras"):
        add_rig_lenses(Source(walk.frames, None, None), rig)


def place(camera_id: str, x_m: float) -> RigCamera:
    T = np.eye(4)
    T[0, 3] = x_m
    return RigCamera(camera_id, tuple(T.ravel().tolist()))


@pytest.mark.parametrize(
    ("cameras", "ids", "expected"),
    [
        ([place("a", 0), place("b", 0.2)], ["a", "b", "a"], []),
        ([place("a", 0), place("b", 0.2), place("rear", 1)], ["a", "b"], ["no image is of rear .* counts for a, b al"]),
        ([place("a", 0), place("b", 0.2)], ["a", "b", "c"], ["rig does not have c, whose .* The rig has a, b; name"]),
        ([place("a", 0), place("b", 0.2)], ["a", "b", ""], ["1 of 3 images are of no camera that is named"]),
        ([place("a", 0), place("b", 220)], ["a", "b"], ["a and b 220 m apart: its poses are metres.*divide"]),
        ([place("a", 1), place("b", 1)], ["a", "b"], ["a, b in one place, within their sigma_m: it gives no metres"]),
        ([place("a", 0), place("rear", 220), place("b", 0.2)], ["a", "b"], ["no image is of rear"]),
        (
            [place("a", 0), RigCamera("b")],
            ["a", "b"],
            ["not tell where b stands .*images alone.*gives no metres: give"],
        ),
        (
            [place("a", 0), place("b", 0.2), RigCamera("c")],
            ["a", "b", "c"],
            ["where c stands .*The others give the metres"],
        ),
    ],
)
def test_what_of_a_rig_does_not_count_is_told(cameras: list[RigCamera], ids: list[str], expected: list[str]) -> None:
    told = list(describe_rig_use(Rig(tuple(cameras)), ids))
    assert len(told) == len(expected), told
    for text, pattern in zip(told, expected, strict=True):
        assert re.search(pattern, text), text


def test_the_log_or_a_program_hears_what_of_a_rig_does_not_count(walk: RigWalk, tmp_path: Path, caplog) -> None:
    file = tmp_path / "rig.yaml"
    mounts = [(camera, true_mounts()[camera], 0.001, 0.1) for camera in (*IDS, "right")]
    file.write_text(format_rig(mounts, metric=True))
    given, config = Source(walk.frames, None, None), ReconstructionConfig()
    apply_rig(given, config, file, ignore_progress)
    assert "no image is of right of the rig" in caplog.text
    with give_warnings(), pytest.warns(InputWarning, match="no image is of right of the rig") as heard:
        apply_rig(given, config, file, ignore_progress)
    assert heard[0].filename == __file__


def test_a_rig_stays_where_further_settings_change() -> None:
    rig = Rig((RigCamera("a", tuple(np.eye(4).ravel().tolist())), RigCamera("b")))
    config = apply_changes(hold_rig(ReconstructionConfig(), rig), {"registration": {"trust_poses": True}})
    assert config.registration.rig == rig and config.registration.trust_poses


def test_a_long_recording_of_a_rig_is_a_map_in_metres(walk: RigWalk, tmp_path: Path, monkeypatch) -> None:
    """Each scene has the rig, also one that was left and comes from its checkpoint; frame sets are stored as one."""
    folder, out, quick = write_folders(walk, tmp_path / "shots"), tmp_path / "out", tmp_path / "quick.yaml"
    quick.write_text(json.dumps({"size": 128, "optimize": {"iterations": 2}}))
    camchain, real, stored = write_camchain(walk, tmp_path / "camchain.yaml"), cli.make_node_config, []
    monkeypatch.setattr(cli, "make_node_config", lambda *of: msgspec.structs.replace(real(*of), max_views=6))
    add = Store.add_frames
    monkeypatch.setattr(Store, "add_frames", lambda self, each: (stored.append(len(each)), add(self, each))[1])
    arguments = ["--cameras", "all", "--rig", str(camchain), "--config", str(quick), "--out", str(out)]
    assert command_line.main(["replay", str(folder), "--map", "--every-frame", *arguments]) == 0
    assert stored == [2] * 5
    (merged,) = out.glob("map-*")
    scenes = [json.loads(path.read_text()) for path in sorted(out.glob("scene-*/cameras.json"))]
    assert len(scenes) > 1 and all("rig of 2 cameras" in scene["scale_source"] for scene in scenes)
    cameras = json.loads((merged / "cameras.json").read_text())
    assert cameras["scale"] == "metric"
    called = {f"{IDS[frame.camera_id]}/{name_of(frame)}": frame.name for frame in walk.frames}
    check_metres(
        {called[each["name"]]: np.array(each["T_world_camera"])[:3, 3] for each in cameras["cameras"]}, walk, 0.05
    )


def test_a_map_of_a_rig_that_is_of_other_cameras_is_refused_at_once(walk: RigWalk, tmp_path: Path, capsys) -> None:
    folder, rig = write_folders(walk, tmp_path / "shots"), tmp_path / "rig.yaml"
    rig.write_text("cameras: {a: {}, b: {}}")
    arguments = ["--cameras", "all", "--rig", str(rig), "--out", str(tmp_path / "out")]
    assert command_line.main(["replay", str(folder), "--map", *arguments]) == 2
    assert "it has a, b, and the images are of cam0, cam1" in capsys.readouterr().err


def test_mounts_of_several_cameras_give_metres(walk: RigWalk) -> None:
    """T_base_camera of each camera, as capture's configuration or Python tells it, and no rig beside it."""
    mounts = true_mounts()
    frames = [replace(each, T_base_camera=tuple(mounts[each.camera_id].ravel().tolist())) for each in walk.frames]
    config = apply_changes(ReconstructionConfig(), {"size": 160})
    estimate, _ = estimate_frame_cameras(frames, load_prior(config), config, Clock())
    assert estimate.rig is not None and estimate.rig.metres_per_unit is not None and not estimate.rig.refuted
    assert estimate.rig.num_given == 2
