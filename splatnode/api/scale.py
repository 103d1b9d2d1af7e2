"""What a program knows of a scene's size: measured distances, printed markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

from splatnode.capture.cameras.folder import frame_name

Baseline: TypeAlias = tuple[str | int, str | int, float]  # two photographs and the metres between their cameras


@dataclass(frozen=True)
class Marker:
    """Printed markers in the scene, all of one size: those of `splatnode marker`, ArUco's, or AprilTags."""

    side_m: float  # of the black square, metres
    sigma_m: float = 0.0005  # standard deviation of that side as it was measured, metres
    dictionary: str = "4X4_50"  # of OpenCV's ArUco dictionaries, or APRILTAG_36h11


Known: TypeAlias = Baseline | Marker
Scale: TypeAlias = Known | Sequence[Known]


def metric_changes(scale: Scale, of_pictures: bool) -> dict[str, Any]:
    """What of the configuration's `metric` it sets; `of_pictures`: photographs are named by their places in a list.

    Raises TypeError.
    """
    changes: dict[str, Any] = {}
    baselines = []
    for each in _known(scale):
        if isinstance(each, Marker):
            changes |= _of_marker(each)
        else:
            baselines.append(_baseline(each, of_pictures))
    if baselines:
        changes |= {"baseline": baselines[0], "further_baselines": baselines[1:]}
    return changes


def _known(scale: object) -> Sequence[object]:
    """What is known, one by one: a sequence of distances and markers is several."""
    if isinstance(scale, (list, tuple)) and all(isinstance(each, (list, tuple, Marker)) for each in scale):
        return scale
    return (scale,)


def _of_marker(marker: Marker) -> dict[str, Any]:
    return {
        "marker_m": marker.side_m,
        "marker_sigma_m": marker.sigma_m,
        "marker_dictionary": marker.dictionary,
    }


def _baseline(scale: object, of_pictures: bool) -> list[Any]:
    """As the configuration has it."""
    if not isinstance(scale, (tuple, list)) or len(scale) != 3 or not isinstance(scale[2], (int, float)):
        raise TypeError(
            "scale must be two photographs and the metres between them, ('a.jpg', 'b.jpg', 0.5), or a Marker, or a "
            f"list of these; got {scale!r}"
        )
    first, second, metres = scale
    return [_name(first, of_pictures), _name(second, of_pictures), float(metres)]


def _name(photograph: object, of_pictures: bool) -> str:
    if isinstance(photograph, int) and of_pictures:
        return f"{photograph:04d}.png"
    if isinstance(photograph, (str, PathLike)):
        return frame_name(Path(fspath(photograph)))
    raise TypeError(f"scale must name photographs by their files, or pictures by their places, got {photograph!r}")
