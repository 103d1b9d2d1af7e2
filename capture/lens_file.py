"""Lenses in a file: YAML as a camera's configuration has it, a model of COLMAP, or a camchain of Kalibr.

Sources of the formats: COLMAP's page on its output (text), Kalibr's wiki on its YAML formats.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.pose_files import binary_images, text_images
from splatnode.capture.process.config import MAX_BYTES, ConfigError, parse_yaml, record_of
from splatnode.capture.process.files import read_bounded, read_text
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text

# Lenses that are given: of which images each of them can be, and what is said where it is of none.

ALL = "*"  # the key of a lens that is of all images
_AFTER_CAMERA = "/_-. "  # what may follow the name of a camera in the name of an image


@dataclass(frozen=True)
class Lenses:
    """Lenses by the images that they took.

    A key is the name of an image, with or without its suffix; a camera id; the name of a camera, as `Frame.camera` has
    it or with which the names of its images begin (`left` for left/0001.png and left_0001.png); or a pattern, such as
    `left*.png`.
    The first kind of key that an image matches counts, in this order.
    """

    by_key: Mapping[str, Intrinsics]

    def find_key(self, name: str, camera: str = "", camera_id: str = "") -> str | None:
        """Returns the key of the lens of an image; None where no lens is of it."""
        return find_key(self.by_key, name, camera, camera_id)

    def apply(self, each: Any) -> Any:
        """Returns the frame with its lens; as it is where no lens is of it, or one of another aspect ratio.

        Where lenses differ, the key becomes the frame's camera: images of different cameras share no lens.
        """
        if not isinstance(each, Frame) or (key := self.find_key(each.name, each.camera, each.camera_id)) is None:
            return each
        lens = self.by_key[key]
        seen = assign_lens(each, lens)
        if seen is each or len(set(self.by_key.values())) == 1:
            return seen
        first = next(other for other, known in self.by_key.items() if known == lens)
        return replace(seen, camera=sanitize_text(first, LONGEST_NAME))

    def check(self, images: Iterable[tuple[str, str, str, int, int]]) -> None:
        """Raises ValueError where a lens is of no image, or of none of its aspect ratio.

        `images` are names, cameras, camera ids, widths and heights of all that there are.
        """
        sizes: dict[str, set[tuple[int, int]]] = {key: set() for key in self.by_key}
        names = []
        for name, camera, camera_id, width, height in images:
            names.append(name)
            if (key := self.find_key(name, camera, camera_id)) is not None:
                sizes[key].add((width, height))
        for key, found in sizes.items():
            if found:
                check_fits(self.by_key[key], found)
            elif names:
                raise ValueError(
                    f"intrinsics has a lens of {sanitize_text(key, 100)!r}, which is no photograph's: they are called "
                    f"{sanitize_text(min(names), 100)} to {sanitize_text(max(names), 100)}. Name a photograph, a "
                    "camera with "
                    "which names begin, or a pattern such as left*.png"
                )


def find_key(keys: Collection[str], name: str, camera: str = "", camera_id: str = "") -> str | None:
    """Returns which of the keys an image with this name, of this camera, matches; None: none. See `Lenses`."""
    for exact in (name, name.rpartition(".")[0], PurePosixPath(name).name, camera_id, camera):
        if exact and exact in keys:
            return exact
    begins = (key for key in keys if key and name.startswith(key) and name[len(key) : len(key) + 1] in _AFTER_CAMERA)
    patterns = (key for key in keys if fnmatchcase(name, key))
    return next(begins, None) or next(patterns, None)


def describe_image(frame: Frame) -> tuple[str, str, str, int, int]:
    """Returns what `Lenses.check` asks of an image: name, camera, camera id, width and height."""
    return frame.name, frame.camera, frame.camera_id, frame.width, frame.height


def same_aspect(intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Whether an image of this size can be one of the camera's, resized."""
    return abs(intrinsics.width * height - intrinsics.height * width) <= max(width, height)


def assign_lens(each: Any, known: Intrinsics) -> Any:
    """The frame with this lens, if it can be one of its images."""
    if not isinstance(each, Frame) or not same_aspect(known, each.width, each.height):
        return each
    return replace(each, intrinsics=known.resized(each.width, each.height))


def check_fits(known: Intrinsics, sizes: Collection[tuple[int, int]]) -> None:
    """Raises ValueError where there are photographs, of these sizes, and the lens can be of none of them."""
    if sizes and not any(same_aspect(known, *size) for size in sizes):
        shown = ", ".join(f"{width} x {height}" for width, height in sorted(set(sizes)))
        raise ValueError(
            f"intrinsics must be of images of the photographs' aspect ratio, got those of {known.width} x "
            f"{known.height} for {shown}. Give the size of the images that were calibrated, or photographs of its "
            "aspect ratio"
        )


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
    """Returns the one lens that a file gives. Raises UnusableLens, also where it gives several."""
    lenses = read_lenses(path).by_key
    if len(lenses) > 1:
        raise UnusableLens(
            f"{sanitize_text(str(path))} must be of one camera here, it has "
            f"{', '.join(map(sanitize_text, list(lenses)[:5]))}; "
            "leave the one that took the photographs"
        )
    return next(iter(lenses.values()))


def read_lenses(path: Path) -> Lenses:
    """Returns the lenses that a file gives, by the images or cameras that they are of; one lens alone is of all.

    `path` is YAML with a lens, or with `cameras`: a mapping of images, cameras or patterns to lenses; cameras.txt of
    COLMAP, or the folder of a model, whose images.txt or images.bin says which camera took which image; or a camchain
    of Kalibr, whose cameras are called cam0, cam1 and so on. `source` of each is "calibration" unless the file says
    otherwise. Raises UnusableLens.
    """
    if path.is_dir():
        path = path / "cameras.txt"
    shown = sanitize_text(str(path))
    text = read_text(path, MAX_BYTES, UnusableLens, shown, _READ)
    with guard_untrusted(UnusableLens, shown):
        return _parse(path, shown, text)


def _parse(path: Path, shown: str, text: str) -> Lenses:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and all(len(words) > 4 and words[0].isdigit() and words[1].isupper() for words in lines):
        return _parse_colmap(path, shown, lines)
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
    if cameras:
        return _name_lenses({str(name): _parse_kalibr(shown, name, each) for name, each in cameras.items()})
    several = content.get("cameras")
    if isinstance(several, dict) and several and all(isinstance(each, dict) for each in several.values()):
        return Lenses(
            {str(name): _parse_own(f"{shown}: {sanitize_text(name)}", each) for name, each in several.items()}
        )
    return Lenses({ALL: _parse_own(shown, content)})


def _name_lenses(lenses: Mapping[str, Intrinsics]) -> Lenses:
    """The lenses by their keys; a single one is of all images."""
    return Lenses(lenses if len(lenses) > 1 else {ALL: next(iter(lenses.values()))})


def _parse_own(shown: str, content: Mapping[str, Any]) -> Intrinsics:
    """A lens, also below `intrinsics` or `camera`, as the configuration of a capture has it."""
    nested = content.get("camera")
    content = nested if isinstance(nested, dict) and "intrinsics" in nested else content
    told = content.get("intrinsics", content)
    told = {"source": "calibration", **told} if isinstance(told, dict) else told
    known = {field.name for field in dataclasses.fields(Intrinsics)}
    try:
        lens = record_of(told, Intrinsics)
    except msgspec.ValidationError as error:
        raise UnusableLens(f"{shown} must give {_READ}: {error}") from error
    if unknown := sorted(set(told) - known):
        raise UnusableLens(
            f"{shown}: a lens has no {', '.join(map(sanitize_text, unknown))}; there are {', '.join(sorted(known))}"
        )
    return lens


def _parse_colmap(path: Path, shown: str, lines: Sequence[Sequence[str]]) -> Lenses:
    """Lenses by camera id; by the images' names where cameras differ, as the model's images say."""
    if len({tuple(words[1:]) for words in lines}) == 1:
        return Lenses({ALL: _parse_colmap_lens(shown, lines[0])})
    lenses = {int(words[0]): _parse_colmap_lens(shown, words) for words in lines}
    for name, parse in (("images.txt", lambda data: text_images(data.decode())), ("images.bin", binary_images)):
        beside = path.parent / name
        if beside.is_file():
            data = read_bounded(beside, MAX_BYTES, UnusableLens, sanitize_text(str(beside)))
            with guard_untrusted(UnusableLens, sanitize_text(str(beside))):
                taken = {row.name: row.camera_id for row in parse(data)}
            if lost := sorted(set(taken.values()) - set(lenses)):
                raise UnusableLens(f"{shown} must have all cameras of {name}, it lacks {lost[:5]}")
            return Lenses(_shorten_names({name: lenses[camera] for name, camera in taken.items()}))
    raise UnusableLens(
        f"{shown} has {len(lenses)} cameras that differ, and no images.txt or images.bin beside it says which of them "
        "took which photograph; put one there, or leave the line of the one that took the photographs"
    )


def _shorten_names(lenses: Mapping[str, Intrinsics]) -> dict[str, Intrinsics]:
    """The lenses by the names of images without their folders, where these are all different."""
    short = {PurePosixPath(name).name: lens for name, lens in lenses.items()}
    return short if len(short) == len(lenses) else dict(lenses)


def _parse_colmap_lens(shown: str, words: Sequence[str]) -> Intrinsics:
    _, model, width, height, *numbers = words
    if model not in _COLMAP:
        raise UnusableLens(f"{shown}: the lens must be one of {', '.join(_COLMAP)}, got {sanitize_text(model, 40)}")
    kind, names = _COLMAP[model][0], _COLMAP[model][1].split()
    if len(numbers) != len(names):
        raise UnusableLens(f"{shown}: {model} must have {len(names)} numbers ({' '.join(names)}), got {len(numbers)}")
    try:
        given = dict(zip(names, map(float, numbers), strict=True))
        size = int(width), int(height)
    except ValueError as error:
        raise UnusableLens(
            f"{shown}: {model} must have a size in pixels and numbers: {sanitize_text(error)}"
        ) from error
    fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    terms = tuple(number for name, number in given.items() if name[0] in "kp")
    if model == "RADIAL":
        terms = (*terms, 0.0, 0.0)
    return _lens(shown, *size, fx, fy, given["cx"], given["cy"], "calibration", terms, kind)


def _parse_kalibr(shown: str, name: object, given: Mapping[str, Any]) -> Intrinsics:
    projection, bending = given["camera_model"], given.get("distortion_model", "none")
    if projection != "pinhole" or str(bending) not in _KALIBR:
        raise UnusableLens(
            f"{shown}: {sanitize_text(name)} must have camera_model pinhole and distortion_model "
            f"{', '.join(_KALIBR)}, got "
            f"{sanitize_text(projection, 40)} and {sanitize_text(bending, 40)}; calibrate with pinhole-radtan or "
            "pinhole-equi"
        )
    try:
        width, height = (int(side) for side in given["resolution"])
        fx, fy, cx, cy = (float(number) for number in given["intrinsics"])
        terms = tuple(float(number) for number in given.get("distortion_coeffs", ()))
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableLens(
            f"{shown}: {sanitize_text(name)} must have resolution [width, height], intrinsics [fx, fy, cx, cy] and "
            f"distortion_coeffs, four numbers: {sanitize_text(error)}"
        ) from error
    terms = () if bending == "none" else terms
    if len(terms) not in (0, 4):
        raise UnusableLens(f"{shown}: {sanitize_text(name)} must have four distortion_coeffs, got {len(terms)}")
    # Kalibr has the centre of the top-left pixel at (0, 0).
    return _lens(shown, width, height, fx, fy, cx + 0.5, cy + 0.5, "calibration", terms, _KALIBR[bending])


def _lens(shown: str, *parts: Any) -> Intrinsics:
    try:
        return Intrinsics(*parts)
    except ValueError as error:
        raise UnusableLens(f"{shown}: {error}") from error
