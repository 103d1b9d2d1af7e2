"""A lens in a file: YAML as a camera's configuration has it, COLMAP's cameras.txt, or a camchain of Kalibr.

Sources of the formats: COLMAP's page on its output (text), Kalibr's wiki on its YAML formats.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from splatnode.capture.frame import Intrinsics
from splatnode.capture.process.bounded_file import read_bounded
from splatnode.capture.process.config_text import MAX_BYTES, ConfigError, parse_yaml
from splatnode.capture.process.foreign import foreign
from splatnode.capture.process.printable import printable
from splatnode.capture.process.records import record_of

# What each of COLMAP's models holds, in its order. f is fx and fy.
_COLMAP = {
    "SIMPLE_PINHOLE": ("opencv", "f cx cy"),
    "PINHOLE": ("opencv", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("opencv", "f cx cy k1"),
    "RADIAL": ("opencv", "f cx cy k1 k2"),
    "OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
}
_KALIBR = {"radtan": "opencv", "equidistant": "fisheye", "none": "opencv"}
_OF_OURS = "width, height, fx, fy, cx and cy of a lens, as `intrinsics` of a camera does"
_READ = f"{_OF_OURS}, or be a cameras.txt of COLMAP or a camchain YAML of Kalibr"


class UnusableLens(ValueError):
    """A file that gives no lens; the text says what was expected."""


def read_lens(path: Path) -> Intrinsics:
    """The lens that a file gives; `source` is "calibration" unless the file says otherwise. Raises UnusableLens."""
    shown = printable(str(path))
    try:
        text = read_bounded(path, MAX_BYTES, UnusableLens, shown).decode("utf-8-sig")
    except OSError as error:
        raise UnusableLens(f"{shown}: {error.strerror}; give a file with {_READ}") from error
    except UnicodeDecodeError as error:
        raise UnusableLens(f"{shown} is no text; it must give {_READ}") from error
    with foreign(UnusableLens, shown):
        return _in_text(shown, text)


def _in_text(shown: str, text: str) -> Intrinsics:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and all(len(words) > 4 and words[0].isdigit() and words[1].isupper() for words in lines):
        return _of_colmap(shown, lines)
    if text.startswith("%YAML:"):
        raise UnusableLens(
            f"{shown} is a file of OpenCV's own format, which is not read; it must give {_READ}. Of OpenCV's camera "
            "matrix, give fx, fy, and cx and cy plus 0.5"
        )
    try:
        content = parse_yaml(text, shown)
    except ConfigError as error:  # on several lines, of which the first says it; it names the file already
        raise UnusableLens(f"{' '.join(str(error).split())}; it must give {_READ}") from error
    if not isinstance(content, dict):
        raise UnusableLens(f"{shown} must give {_READ}; it holds no keys and values")
    cameras = {name: each for name, each in content.items() if isinstance(each, dict) and "camera_model" in each}
    return _of_kalibr(shown, cameras) if cameras else _of_ours(shown, content)


def _of_ours(shown: str, content: Mapping[str, Any]) -> Intrinsics:
    told = content.get("intrinsics", content)
    told = {"source": "calibration", **told} if isinstance(told, dict) else told
    known = {field.name for field in dataclasses.fields(Intrinsics)}
    try:
        lens = record_of(told, Intrinsics)
    except msgspec.ValidationError as error:
        raise UnusableLens(f"{shown} must give {_READ}: {error}") from error
    if unknown := sorted(set(told) - known):
        raise UnusableLens(
            f"{shown}: a lens has no {', '.join(map(printable, unknown))}; there are {', '.join(sorted(known))}"
        )
    return lens


def _of_colmap(shown: str, lines: Sequence[Sequence[str]]) -> Intrinsics:
    lenses = {tuple(words[1:]) for words in lines}
    if len(lenses) > 1:
        raise UnusableLens(
            f"{shown} must be of one camera, it has {len(lenses)} that differ; leave the line of the one that took "
            "the photographs"
        )
    ((model, width, height, *numbers),) = lenses
    if model not in _COLMAP:
        raise UnusableLens(f"{shown}: the lens must be one of {', '.join(_COLMAP)}, got {printable(model, 40)}")
    kind, names = _COLMAP[model][0], _COLMAP[model][1].split()
    if len(numbers) != len(names):
        raise UnusableLens(f"{shown}: {model} must have {len(names)} numbers ({' '.join(names)}), got {len(numbers)}")
    try:
        given = dict(zip(names, map(float, numbers), strict=True))
        size = int(width), int(height)
    except ValueError as error:
        raise UnusableLens(f"{shown}: {model} must have a size in pixels and numbers: {printable(error)}") from error
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    terms = tuple(number for name, number in given.items() if name[0] in "kp")
    if model == "RADIAL":
        terms = (*terms, 0.0, 0.0)
    return _lens(shown, *size, fx, fy, given["cx"], given["cy"], "calibration", terms, kind)


def _of_kalibr(shown: str, cameras: Mapping[str, Mapping[str, Any]]) -> Intrinsics:
    if len(cameras) > 1:
        raise UnusableLens(
            f"{shown} must be of one camera, it has {', '.join(map(printable, cameras))}; leave the one that took the "
            "photographs"
        )
    ((name, given),) = cameras.items()
    projection, bending = given["camera_model"], given.get("distortion_model", "none")
    if projection != "pinhole" or str(bending) not in _KALIBR:
        raise UnusableLens(
            f"{shown}: {printable(name)} must have camera_model pinhole and distortion_model {', '.join(_KALIBR)}, got "
            f"{printable(projection, 40)} and {printable(bending, 40)}; calibrate with pinhole-radtan or pinhole-equi"
        )
    try:
        width, height = (int(side) for side in given["resolution"])
        fx, fy, cx, cy = (float(number) for number in given["intrinsics"])
        terms = tuple(float(number) for number in given.get("distortion_coeffs", ()))
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableLens(
            f"{shown}: {printable(name)} must have resolution [width, height], intrinsics [fx, fy, cx, cy] and "
            f"distortion_coeffs, four numbers: {printable(error)}"
        ) from error
    terms = () if bending == "none" else terms
    if len(terms) not in (0, 4):
        raise UnusableLens(f"{shown}: {printable(name)} must have four distortion_coeffs, got {len(terms)}")
    # Kalibr has the centre of the top-left pixel at (0, 0).
    return _lens(shown, width, height, fx, fy, cx + 0.5, cy + 0.5, "calibration", terms, _KALIBR[bending])


def _lens(shown: str, *parts: Any) -> Intrinsics:
    try:
        return Intrinsics(*parts)
    except ValueError as error:
        raise UnusableLens(f"{shown}: {error}") from error
