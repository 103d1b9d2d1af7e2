"""Stock COLMAP and GLOMAP on the same frames, through pycolmap (pip install 'splatnode[bench]').

Everything is at its defaults, except that frames of one size share a camera, as they do in splatnode.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pycolmap

from capture.frame import DroppedFrame, Frame
from recon.config import Config
from recon.snapshot import CameraEstimate, GaussianArrays, Snapshot
from recon.verdict import Code, Verdict

Models = Mapping[int, pycolmap.Reconstruction]

_MIN_CAMERAS = 3  # a model of two cameras counts as no answer, for every method


def colmap(frames: Iterable[Frame | DroppedFrame], config: Config) -> Snapshot:
    """Incremental mapping: the largest model."""
    return _reconstructed(frames, config, _incremental)


def glomap(frames: Iterable[Frame | DroppedFrame], config: Config) -> Snapshot:
    """Global mapping after a calibration of the view graph, as GLOMAP does it: the largest model."""
    return _reconstructed(frames, config, _global)


def _incremental(folder: Path, seed: int) -> Models:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    return pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "models", options)


def _global(folder: Path, seed: int) -> Models:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = seed
    pycolmap.calibrate_view_graph(folder / "database.db")
    return pycolmap.global_mapping(folder / "database.db", folder / "images", folder / "models", options)


def _reconstructed(
    frames: Iterable[Frame | DroppedFrame], config: Config, mapping: Callable[[Path, int], Models]
) -> Snapshot:
    usable = [frame for frame in frames if isinstance(frame, Frame)]
    with TemporaryDirectory(prefix="splatnode-rival-") as name:
        folder = Path(name)
        _prepare(folder, usable, config.seed)
        models = mapping(folder, config.seed) if len(usable) > 1 else {}
        model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
        cameras = _cameras(model, usable) if model is not None else ()
    return _snapshot(cameras, usable)


def _prepare(folder: Path, frames: list[Frame], seed: int) -> None:
    """Images by size, features, and matches of all pairs, in `folder`/database.db."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # it reports every step
    pycolmap.set_random_seed(seed)
    (folder / "models").mkdir()
    groups: dict[str, list[int]] = {}
    for number, frame in enumerate(frames):
        group = f"{frame.width}x{frame.height}"
        path = folder / "images" / _image_name(number, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        groups.setdefault(group, []).append(number)
    for members in groups.values():
        options = pycolmap.ImageReaderOptions()
        known = frames[members[0]].intrinsics
        if known is not None:
            options.camera_model = "SIMPLE_RADIAL"
            options.camera_params = f"{known.fx},{known.cx},{known.cy},0"
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            image_names=[_image_name(number, frames[number]) for number in members],
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=options,
            device=pycolmap.Device.cpu,
        )
    if len(frames) > 1:
        pycolmap.match_exhaustive(folder / "database.db", device=pycolmap.Device.cpu)


def _image_name(number: int, frame: Frame) -> str:
    return f"{frame.width}x{frame.height}/{number:04d}.png"


def _cameras(model: pycolmap.Reconstruction, frames: list[Frame]) -> tuple[CameraEstimate, ...]:
    found = {image.name: image for image in model.images.values() if image.has_pose}
    cameras = []
    for number, frame in enumerate(frames):
        image = found.get(_image_name(number, frame))
        if image is None:
            continue
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        K = model.cameras[image.camera_id].calibration_matrix()
        T_world_camera = np.linalg.inv(T_camera_world)
        cameras.append(
            CameraEstimate(frame.name, frame.frame_id, T_world_camera, K, frame.width, frame.height, None, None)
        )
    return tuple(cameras)


def _snapshot(cameras: tuple[CameraEstimate, ...], frames: list[Frame]) -> Snapshot:
    """These methods publish whatever they find: their only refusal is to find nothing."""
    placed = {camera.name for camera in cameras}
    missing = tuple(frame.name for frame in frames if frame.name not in placed)
    told = f"{len(cameras)} of {len(frames)} frames were placed."
    if len(cameras) < _MIN_CAMERAS:
        verdict = Verdict(Code.NO_OVERLAP, told, "", missing)
    else:
        verdict = Verdict(Code.OK_PARTIAL if missing else Code.OK, told, "", missing, publishable=True)
    return Snapshot(
        sequence=1,
        verdict=verdict,
        cameras=cameras if verdict.publishable else (),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=0,
        final=True,
    )
