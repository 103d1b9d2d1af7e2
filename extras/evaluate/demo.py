"""The built-in capture on disk, in the layout of a scene with known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.extras.evaluate.dataset import Split
from splatnode.recon.result.export.cameras import encode_cameras
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.threads import map_parallel


def write_capture(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs, those held out for testing, and the true cameras of both; returns their names.

    The cameras are for evaluation: reconstruction reads the photographs in `folder`/images and nothing else.
    """
    split = write_training_images(folder, place)
    write_held_out_images(folder, place)
    return split


def write_training_images(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs that are reconstructed; returns the names of all."""
    training = _list_training_cameras(place)
    _write_images(folder, place, training, first=0)
    return Split(tuple(training), tuple(_list_test_cameras(place)))


def write_held_out_images(folder: Path, place: synthetic.Config) -> None:
    """Writes the photographs held out for testing, and the true cameras of all."""
    training, testing = _list_training_cameras(place), _list_test_cameras(place)
    _write_images(folder, place, testing, first=len(training))
    cameras = [
        CameraEstimate(name, number, T_world_camera, K, place.width, place.height)
        for number, (name, (T_world_camera, K)) in enumerate({**training, **testing}.items())
    ]
    write_files(folder, {"cameras.json": encode_cameras(cameras)})


def _list_training_cameras(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {synthetic.frame_name(i): camera for i, camera in enumerate(synthetic.scene_cameras(place))}


def _list_test_cameras(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {f"test_{i:03d}.png": camera for i, camera in enumerate(synthetic.evaluation_cameras(place))}


def _write_images(folder: Path, place: synthetic.Config, cameras: Mapping[str, synthetic.Camera], first: int) -> None:
    """Photographs by name, rendered side by side; `first` is the number of the first one's noise."""

    def render_png(camera: synthetic.Camera, number: int) -> bytes:
        return encode_png(synthetic.render_image(place, camera, noise_seed=number))

    synthetic.solids(place)  # or each thread would make it
    files = map_parallel(render_png, cameras.values(), range(first, first + len(cameras)))
    write_files(folder, {f"images/{name}": file for name, file in zip(cameras, files, strict=True)})


def compute_max_capture_bytes(place: synthetic.Config) -> int:
    """Bytes that `write_capture` stays below: those of its photographs without compression."""
    return (2 * place.views - 1) * place.width * place.height * 3
