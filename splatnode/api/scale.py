"""What a program knows of a scene's size: measured distances, printed markers, stereo pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

from splatnode.api.photographs import Images, list_images, make_frame, names_of
from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.right_image import Baseline as Apart
from splatnode.recon.metric.stereo_pairs import StereoPair, make_pairs, stream_right_images

Baseline: TypeAlias = tuple[str | int, str | int, float]  # two photographs and the metres between their cameras


@dataclass(frozen=True)
class Marker:
    """Printed markers in the scene, all of one size: those of `splatnode marker`, ArUco's, or AprilTags."""

    side_m: float  # of the black square, metres
    sigma_m: float = 0.0005  # standard deviation of that side as it was measured, metres
    dictionary: str = "4X4_50"  # of OpenCV's ArUco dictionaries, or APRILTAG_36h11


@dataclass(frozen=True, eq=False)
class Stereo:
    """A second camera to the right of the first: what both saw at once are rectified pairs."""

    right: (
        str | PathLike[str] | Sequence[Any]
    )  # its photographs: a folder, where both of a pair have one name, or a list
    baseline_m: float  # between the two cameras, metres
    sigma_m: float = 0.0003  # standard deviation of that distance, metres


Known: TypeAlias = Baseline | Marker | Stereo
Scale: TypeAlias = Known | Sequence[Known]


def metric_changes(scale: Scale, of_pictures: bool) -> dict[str, Any]:
    """Returns the settings of `metric` for this scale; `of_pictures`: photographs are named by their places in a list.

    Raises TypeError, and ValueError for markers of two kinds.
    """
    changes: dict[str, Any] = {}
    baselines = []
    markers = {each for each in _list_scale_sources(scale) if isinstance(each, Marker)}
    if len(markers) > 1:
        raise ValueError(f"scale can have markers of one size and dictionary alone, got {len(markers)} kinds of Marker")
    for each in _list_scale_sources(scale):
        if isinstance(each, Marker):
            changes |= _make_marker_settings(each)
        elif isinstance(each, Stereo):
            changes |= {"stereo_m": each.baseline_m, "stereo_sigma_m": each.sigma_m}
        else:
            baselines.append(_baseline(each, of_pictures))
    if baselines:
        changes |= {"baseline": baselines[0], "further_baselines": baselines[1:]}
    return changes


def is_stereo(scale: Scale | None) -> bool:
    """Whether stereo pairs are among what is known."""
    return any(isinstance(each, Stereo) for each in _list_scale_sources(scale))


def pairs_given(scale: Scale | None, images: Images, frames: Sequence[Frame | DroppedFrame]) -> tuple[StereoPair, ...]:
    """The stereo pairs of the frames, in which `images` resulted, of several stereo cameras each with their baseline.

    Raises TypeError, ValueError, FileNotFoundError.
    """
    stereos = [each for each in _list_scale_sources(scale) if isinstance(each, Stereo)]
    several = len(stereos) > 1  # else the configuration's is theirs
    return tuple(
        replace(pair, baseline=Apart(each.baseline_m, each.sigma_m)) if several else pair
        for each in stereos
        for pair in make_pairs(frames, _load_right_frames(each.right, images, frames))
    )


def _load_right_frames(
    right: object, images: Images, frames: Sequence[Frame | DroppedFrame]
) -> Iterable[Frame | DroppedFrame]:
    if isinstance(right, (str, PathLike)):
        return stream_right_images(Path(right), frames)
    names, pictures = names_of(images), list_images(right)
    if len(names) != len(pictures):
        raise ValueError(f"right must have one picture for each of the {len(names)} photographs, got {len(pictures)}")
    return [
        make_frame(each, number, name, number) for number, (name, each) in enumerate(zip(names, pictures, strict=True))
    ]


def _list_scale_sources(scale: object) -> Sequence[object]:
    """Lists the scale sources one by one: a sequence of distances, markers and pairs is several."""
    if isinstance(scale, (list, tuple)) and all(isinstance(each, (list, tuple, Marker, Stereo)) for each in scale):
        return scale
    return (scale,)


def _make_marker_settings(marker: Marker) -> dict[str, Any]:
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
            f"Stereo, or a list of these; got {scale!r}"
        )
    first, second, metres = scale
    return [_name(first, of_pictures), _name(second, of_pictures), float(metres)]


def _name(photograph: object, of_pictures: bool) -> str:
    if isinstance(photograph, int) and of_pictures:
        return f"{photograph:04d}.png"
    if isinstance(photograph, (str, PathLike)):
        return frame_name(Path(fspath(photograph)))
    raise TypeError(f"scale must name photographs by their files, or pictures by their places, got {photograph!r}")
