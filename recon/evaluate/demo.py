"""The built-in capture on disk, in the layout of a scene with known cameras."""

from __future__ import annotations

from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.result.export.cameras import encode_cameras
from splatnode.recon.result.export.staged import write_file, write_files
from splatnode.recon.result.snapshot import CameraEstimate


def write_capture(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs, those held out for testing, and the true cameras of both; returns their names.

    The cameras are for evaluation: reconstruction reads the photographs in `folder`/images and nothing else.
    """
    training = {synthetic.frame_name(i): camera for i, camera in enumerate(synthetic.scene_cameras(place))}
    testing = {f"test_{i:03d}.png": camera for i, camera in enumerate(synthetic.held_out_cameras(place))}
    files, cameras = {}, []
    for number, (name, (T_world_camera, K)) in enumerate({**training, **testing}.items()):
        image = synthetic.photograph(place, (T_world_camera, K), noise_seed=number)
        files[name] = encode_png(image)
        cameras.append(CameraEstimate(name, number, T_world_camera, K, place.width, place.height))
    write_files(folder / "images", files)
    write_file(folder / "cameras.json", encode_cameras(cameras))
    return Split(tuple(training), tuple(testing))


def largest_capture_bytes(place: synthetic.Config) -> int:
    """Bytes that `write_capture` stays below: those of its photographs without compression."""
    return (2 * place.views - 1) * place.width * place.height * 3
