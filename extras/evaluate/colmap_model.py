"""COLMAP's sparse model, text or binary: the cameras of its photographs. Points are not read.

It is read here and not by pycolmap, which takes memory for every count that a file states.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from splatnode.capture.pose_files import binary_images, content_lines, text_images
from splatnode.capture.process.files import read_bounded
from splatnode.capture.process.records import record_in
from splatnode.capture.process.text import guard_untrusted, sanitize_text

# JSON files of evaluations: true cameras, splits, raw results.

T = TypeVar("T")

MAX_BYTES = 500_000_000


class EvaluationFileError(ValueError):
    """A file of an evaluation that is not what it should be; the message names it."""


def read_json(path: Path, kind: type[T], expected: str) -> T:
    """The content of `path`, which must be `expected`, as a `kind`; numbers are finite.

    Raises EvaluationFileError, OSError.
    """
    with guard_untrusted(EvaluationFileError, str(path)):
        try:
            return record_in(read_bounded(path, MAX_BYTES, EvaluationFileError, str(path)), kind)
        except msgspec.MsgspecError as error:
            raise EvaluationFileError(f"{path} must be {expected}: {error}") from error


_PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}  # parameters of each
_NUMBERS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE"}


@dataclass(frozen=True)
class ColmapCamera:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class ColmapImage:
    name: str
    quat: tuple[float, float, float, float]  # wxyz, of T_camera_world
    translation: tuple[float, float, float]
    camera: ColmapCamera


def read_model(folder: Path) -> list[ColmapImage]:
    """The photographs of the model in `folder`.

    Raises EvaluationFileError where it is none, or is of distorted photographs; OSError.
    """
    suffix = "bin" if (folder / "cameras.bin").exists() else "txt"
    cameras_file, images_file = _read_content(folder / f"cameras.{suffix}"), _read_content(folder / f"images.{suffix}")
    with guard_untrusted(EvaluationFileError, str(folder)):
        try:
            cameras = dict(
                _parse_binary_cameras(cameras_file) if suffix == "bin" else _parse_text_cameras(cameras_file.decode())
            )
            images = binary_images(images_file) if suffix == "bin" else text_images(images_file.decode())
            return [
                ColmapImage(name, (w, x, y, z), (tx, ty, tz), cameras[camera_id])
                for name, (w, x, y, z, tx, ty, tz), camera_id in images
            ]
        except KeyError as error:
            raise EvaluationFileError(f"{folder}: a photograph has the camera {error}, which is not there") from error
        except (ValueError, struct.error) as error:
            raise EvaluationFileError(f"{folder} must be a COLMAP model of undistorted photographs: {error}") from error


def _read_content(path: Path) -> bytes:
    return read_bounded(path, MAX_BYTES, EvaluationFileError, str(path))


def _make_camera(model: str, width: int, height: int, lens: tuple[float, ...]) -> ColmapCamera:
    if model not in _PINHOLES or len(lens) != _PINHOLES[model]:
        raise ValueError(f"a camera is {sanitize_text(model, 100)} with {len(lens)} parameters, not PINHOLE with 4")
    fx, fy, cx, cy = lens if len(lens) == 4 else (lens[0], *lens)
    return ColmapCamera(width, height, fx, fy, cx, cy)


def _parse_text_cameras(text: str) -> Iterator[tuple[int, ColmapCamera]]:
    for line in content_lines(text):
        if line.strip():
            number, model, width, height, *lens = line.split()
            yield int(number), _make_camera(model, int(width), int(height), tuple(map(float, lens)))


def _parse_binary_cameras(data: bytes) -> Iterator[tuple[int, ColmapCamera]]:
    (count,), position = struct.unpack_from("<Q", data), 8
    for _ in range(count):  # ends at the latest where the bytes do
        number, model, width, height = struct.unpack_from("<IiQQ", data, position)
        size = _PINHOLES.get(_NUMBERS.get(model, ""), 0)
        lens = struct.unpack_from(f"<{size}d", data, position + 24)
        yield number, _make_camera(_NUMBERS.get(model, f"of model {model}"), width, height, lens)
        position += 24 + 8 * size
