"""Recordings of a robot with three cameras become one world: a LeRobot episode, an MCAP file, folders, videos."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from splatnode import command_line
from splatnode.capture.cameras import synthetic
from splatnode.capture.film import ALL
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.image_file import encode_png
from splatnode.capture.keyframe_selection import group_frame_sets
from splatnode.capture.lenses import Lenses
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, load_prior
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.replay_source import Request, Source, load_source, parse_sources
from splatnode.recon.threads import Clock
from splatnode.recon.verification.decision import _find_other_lens_frames
from tests.support import lerobot_sets, mcap_files

PLACE = synthetic.Config(views=9, width=480, height=360, seed=1)
STEPS = 3  # frame sets
ON_PATH = {
    "front": 0.0,
    "side": 2.5,
    "wrist": 5.0,
}  # where each camera begins on the way; it goes one photograph a step
ZOOM = {"front": 1.0, "side": 1.3, "wrist": 1.15}
SIZE = {"front": (480, 360), "side": (360, 272), "wrist": (400, 400)}  # width, height


def photograph(camera: str, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a camera sees, (H, W, 3); its true K, and T_world_camera."""
    T_world_camera, K = synthetic._camera_on_path(PLACE, ON_PATH[camera] + step)
    image = synthetic.render_image(PLACE, (T_world_camera, K), 10 * step + list(ON_PATH).index(camera))
    (width, height), zoom = SIZE[camera], ZOOM[camera]
    scale = zoom * max(width / PLACE.width, height / PLACE.height)
    across = np.array([[scale, 0, width / 2 - scale * K[0, 2]], [0, scale, height / 2 - scale * K[1, 2]], [0, 0, 1.0]])
    shift = across + 0.0
    shift[:2, 2] += 0.5 * scale - 0.5  # OpenCV's pixels begin at their centres
    cropped = cv2.warpAffine(image, shift[:2], (width, height), flags=cv2.INTER_AREA)
    return cropped.astype(np.uint8), across @ K, T_world_camera


@pytest.fixture(scope="module")
def seen():
    return {camera: [photograph(camera, step) for step in range(STEPS)] for camera in ON_PATH}


def told_lens(seen, camera: str) -> Intrinsics:
    _, K, _ = seen[camera][0]
    return Intrinsics(*SIZE[camera], K[0, 0], K[1, 1], K[0, 2], K[1, 2], "calibration")


def write_episode(seen, folder: Path) -> Path:
    episode = {f"observation.images.{camera}": [image for image, *_ in seen[camera]] for camera in ON_PATH}
    return Path(f"{lerobot_sets.write(folder, [episode])}#0")


def write_log(seen, file: Path) -> Path:
    messages = []
    for camera in ("front", "side"):  # the lens of the third is not told
        K = told_lens(seen, camera).K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        messages.append(mcap_files.calibration(f"/{camera}/camera_info", SIZE[camera], K.ravel().tolist()))
    for step in range(STEPS):
        for late, camera in enumerate(ON_PATH):
            at_ns = mcap_files.START_NS + step * 10**9 + late * 4_000_000
            messages.append(mcap_files.compressed(f"/{camera}/image_raw", seen[camera][step][0], header_ns=at_ns))
    return mcap_files.write(file, messages)


def write_folders(seen, folder: Path) -> Path:
    for camera in ON_PATH:
        (folder / camera).mkdir(parents=True)
        for step, (image, *_) in enumerate(seen[camera]):
            (folder / camera / f"{step:04d}.png").write_bytes(encode_png(image))
    return folder


def check_one_world(seen, source: Source) -> Reconstruction:
    """All cameras are placed in one world, each where it was."""
    frames = [each for each in source.frames if isinstance(each, Frame)]
    assert sorted({frame.camera_id for frame in frames}) == sorted(ON_PATH)
    config = ReconstructionConfig()
    estimate, _ = estimate_frame_cameras(frames, load_prior(config), config, Clock())
    assert estimate.publishable and estimate.registration is not None, estimate.verdict
    cameras = estimate.registration.cameras
    assert len(cameras) == len(frames)
    for one in cameras:
        for other in cameras:
            between = np.linalg.inv(one.T_world_camera) @ other.T_world_camera
            true = [seen[frame.camera_id][int(frame.name[-8:-4])][2] for frame in (
                estimate.graph.keyframes[one.index].frame, estimate.graph.keyframes[other.index].frame
            )]  # fmt: skip
            off = between[:3, :3].T @ (np.linalg.inv(true[0]) @ true[1])[:3, :3]
            assert np.degrees(np.arccos(np.clip((np.trace(off) - 1) / 2, -1, 1))) < 1.5
    return estimate


def load(path: Path, lenses: Lenses | None = None, *further: Path) -> Source:
    first, listed, cameras = parse_sources([path, *further], (ALL,))
    return load_source(Request(first, listed, every_frame=True, cameras=cameras, lenses=lenses))


def test_an_mcap_file_with_three_cameras_is_one_world(seen, tmp_path):
    estimate = check_one_world(seen, load(write_log(seen, tmp_path / "drive.mcap")))
    told = {each.frame.camera_id for each in estimate.graph.keyframes if each.frame.intrinsics is not None}
    assert told == {"front", "side"}


def test_an_mcap_file_with_three_cameras_has_a_set_a_step_and_the_lenses_that_are_told(seen, tmp_path):
    frames = [each for each in load(write_log(seen, tmp_path / "drive.mcap")).frames if isinstance(each, Frame)]
    sets = [sorted(each.camera_id for each in sets) for sets in group_frame_sets(frames) if isinstance(sets, tuple)]
    assert sets == [["front", "side", "wrist"]] * STEPS
    lenses = {each.camera_id: each.intrinsics for each in frames}
    assert lenses["wrist"] is None
    for camera in ("front", "side"):
        told = lenses[camera]
        assert told is not None and told.fx == pytest.approx(told_lens(seen, camera).fx)


def test_an_episode_with_three_cameras_is_one_world(seen, tmp_path):
    lenses = Lenses({camera: told_lens(seen, camera) for camera in ("front", "wrist")})
    source = load(write_episode(seen, tmp_path / "set"), lenses)
    frames = [each for each in source.frames if isinstance(each, Frame)]
    sets = [
        [each.camera_id for each in together] for together in group_frame_sets(frames) if isinstance(together, tuple)
    ]
    assert sets == [["front", "side", "wrist"]] * STEPS
    check_one_world(seen, source)


def test_a_folder_of_each_camera_is_one_result(seen, tmp_path, capsys):
    folder = write_folders(seen, tmp_path / "shots")
    assert command_line.main(["replay", str(folder), "--out", str(tmp_path / "no")]) == 2
    assert "--cameras all" in capsys.readouterr().err
    quick = tmp_path / "quick.yaml"
    quick.write_text("{size: 240, optimize: {iterations: 4}}")
    lenses = tmp_path / "lenses.yaml"
    lenses.write_text(
        json.dumps(
            {
                "cameras": {
                    camera: {
                        key: getattr(told_lens(seen, camera), key)
                        for key in ("width", "height", "fx", "fy", "cx", "cy")
                    }
                    for camera in ON_PATH
                }
            }
        )
    )
    out = tmp_path / "out"
    arguments = [
        "--cameras",
        "front,side,wrist",
        "--intrinsics",
        str(lenses),
        "--config",
        str(quick),
        "--out",
        str(out),
    ]
    assert command_line.main(["replay", str(folder), *arguments, "--views", "7"]) == 0
    cameras = json.loads((out / "cameras.json").read_text())["cameras"]
    assert {each["name"]: (each["camera_id"], each["frame_set"]) for each in cameras} == {
        f"{camera}/{step:04d}.png": (camera, place) for camera in ON_PATH for place, step in enumerate((0, 2))
    }
    assert json.loads((out / "report.json").read_text())["photographs"] == str(folder.resolve())
    assert sorted(path.name for path in (out / "colmap").iterdir()) == [
        "cameras.txt",
        "frames.txt",
        "images.txt",
        "points3D.txt",
        "rigs.txt",
    ]
    assert command_line.main(["export", str(out), "--to", "dataset"]) == 0
    assert (out / "dataset" / "images" / "side" / "0000.png").is_file()


def test_a_camera_with_an_id_is_no_foreign_one():
    """Images of another size are those of a camera that is known to be another one, and no photographs gone astray."""

    def find(camera_id: str) -> list[str]:
        frames = [Frame(i, f"{i}.png", i, np.zeros((8, 9 if i else 8, 3), np.uint8), None) for i in range(3)]
        frames = [replace(frame, camera_id=camera_id and f"{camera_id}{frame.width}") for frame in frames]
        keyframes = [SimpleNamespace(frame=frame, name=frame.name) for frame in frames]
        cameras = [SimpleNamespace(index=i) for i in range(3)]
        case = SimpleNamespace(
            graph=SimpleNamespace(keyframes=keyframes), registration=SimpleNamespace(cameras=cameras)
        )
        return _find_other_lens_frames(cast(Any, case))

    assert find("") == ["0.png"]
    assert find("camera") == []
