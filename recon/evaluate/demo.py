"""The built-in capture on disk, in the layout of a scene with known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.result.export.cameras import encode_cameras
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.recon.workers import each


def write_capture(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs, those held out for testing, and the true cameras of both; returns their names.

    The cameras are for evaluation: reconstruction reads the photographs in `folder`/images and nothing else.
    """
    split = write_photographs(folder, place)
    write_held_out(folder, place)
    return split


def write_photographs(folder: Path, place: synthetic.Config) -> Split:
    """Writes the photographs that are reconstructed; returns the names of all."""
    training = _training(place)
    _write(folder, place, training, first=0)
    return Split(tuple(training), tuple(_testing(place)))


def write_held_out(folder: Path, place: synthetic.Config) -> None:
    """Writes the photographs held out for testing, and the true cameras of all."""
    training, testing = _training(place), _testing(place)
    _write(folder, place, testing, first=len(training))
    cameras = [
        CameraEstimate(name, number, T_world_camera, K, place.width, place.height)
        for number, (name, (T_world_camera, K)) in enumerate({**training, **testing}.items())
    ]
    write_files(folder, {"cameras.json": encode_cameras(cameras)})


def _training(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {synthetic.frame_name(i): camera for i, camera in enumerate(synthetic.scene_cameras(place))}


def _testing(place: synthetic.Config) -> dict[str, synthetic.Camera]:
    return {f"test_{i:03d}.png": camera for i, camera in enumerate(synthetic.held_out_cameras(place))}


def _write(folder: Path, place: synthetic.Config, cameras: Mapping[str, synthetic.Camera], first: int) -> None:
    """Photographs by name, rendered side by side; `first` is the number of the first one's noise."""

    def png(camera: synthetic.Camera, number: int) -> bytes:
        return encode_png(synthetic.photograph(place, camera, noise_seed=number))

    synthetic.solids(place)  # or each thread would make it
    files = each(png, cameras.values(), range(first, first + len(cameras)))
    write_files(folder, {f"images/{name}": file for name, file in zip(cameras, files, strict=True)})


def largest_capture_bytes(place: synthetic.Config) -> int:
    """Bytes that `write_capture` stays below: those of its photographs without compression."""
    return (2 * place.views - 1) * place.width * place.height * 3
