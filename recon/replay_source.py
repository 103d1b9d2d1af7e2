"""What is reconstructed offline: a folder of photographs, some of its photographs, a recording, a film, or frames.

A film is a video, an image topic of an MCAP file, or an episode of a LeRobot data set, by the name that `film` knows.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture import film
from splatnode.capture.cameras import folder
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import encode_png
from splatnode.capture.keyframe_selection import THINNED, Choice, Config, choose
from splatnode.capture.lens_file import Lenses, describe_image
from splatnode.capture.lerobot import data_set
from splatnode.capture.masks import Find, mask_frames, open_masks
from splatnode.capture.odometry import make_given_pose
from splatnode.capture.process.terminal import Tell, ignore_progress, report_items
from splatnode.capture.process.text import sanitize_name
from splatnode.capture.quality import Limits
from splatnode.recon.config import ReconstructionConfig as Reconstruction

Array = npt.NDArray[np.float64]

ALL = 30  # photographs of a folder that are all used; of more, keyframes are chosen
MOST = 60  # keyframes of a video, or of a folder of more photographs
EVERY = 300  # frames of a video, where all that are sharp and no copies are asked for
IMAGES = "images"  # in the result folder: the keyframes of a video

_OF_PHOTOGRAPHS = Config(max_fps=1e9, patience_s=0.0)  # which were not taken at any rate


@dataclass(frozen=True)
class Request:
    """A request for a reconstruction: which images, masks and lens."""

    source: Path  # a folder, or a film
    listed: tuple[str, ...] = ()  # the photographs of the folder that were named; none: all
    views: int | None = None  # so many of them, evenly spread
    frames: tuple[str, ...] = ()  # those of the folder with these names
    every_frame: bool = False  # all that are sharp and no copies
    masks: Path | None = None  # a folder of masks, or one for all; None: photographs are used whole
    lenses: Lenses | None = None  # in place of what EXIF tells


@dataclass(frozen=True, eq=False)
class Source:
    """The frames to reconstruct, in their order, and where they come from."""

    frames: tuple[Frame | DroppedFrame, ...]
    photographs: Path | None  # the folder that they lie in; None: they lie in none, as a film's
    choice: Choice | None  # None: all that were asked for are used

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(width, height) of each frame."""
        return [(frame.width, frame.height) for frame in self.frames if isinstance(frame, Frame)]

    @property
    def further_bytes(self) -> int:
        """Bytes that `files` has at most."""
        return 0 if self.photographs else sum(3 * width * height for width, height in self.sizes)

    def files(self) -> dict[str, bytes]:
        """The frames as files of the result folder, by their names in it; none where they lie in a folder already."""
        frames = () if self.photographs else self.frames
        return {f"{IMAGES}/{each.name}": encode_png(each.image) for each in frames if isinstance(each, Frame)}


@dataclass(frozen=True, eq=False)
class ReplayRecording:
    """All keyframes of a recording, which are read again when they are needed."""

    path: Path
    listed: tuple[str, ...]  # the photographs of the folder that were named; none: all
    choice: Choice
    masks: Path | None = None
    lenses: Lenses | None = None

    @property
    def is_film(self) -> bool:
        return film.is_film(self.path)

    def identity(self, config: Reconstruction) -> str:
        """32 hexadecimal digits that tell it, reconstructed in this way, from others.

        Of a folder the names count: it may hold the results, too, which change when it was last written.
        """
        written_ns = film.file_and_part(self.path)[0].stat().st_mtime_ns if self.is_film else 0
        known = [str(self.path.resolve()), written_ns, self.choice.names, config]
        if self.masks is not None:
            known.append(str(self.masks.resolve()))
        if self.lenses is not None:
            known.append(self.lenses)
        return hashlib.sha256(msgspec.json.encode(known)).hexdigest()[:32]

    def frames(self) -> Iterator[Frame | DroppedFrame]:
        """The keyframes in their order, and what the recording could not give."""
        names = set(self.choice.names)
        streamed = _stream(self.path, self.listed)
        chosen = (each for each in streamed if isinstance(each, DroppedFrame) or each.name in names)
        if self.lenses is not None:
            chosen = map(self.lenses.apply, chosen)
        return chosen if self.masks is None else mask_frames(chosen, open_masks(self.masks))


def parse_paths(paths: Sequence[Path]) -> tuple[Path, tuple[str, ...]]:
    """The folder or the video that the command line names, and the photographs of that folder; none of these: all.

    Raises ValueError where several are named that are not photographs of one folder.
    """
    (first, *others) = paths
    if not others and not (first.suffix.lower() in folder.SUFFIXES | folder.FOREIGN_SUFFIXES and first.is_file()):
        return first, ()
    for path in paths:
        if path.is_dir():
            raise ValueError(f"{str(path)!r} is a folder; give one folder alone, or photographs of one")
        if not path.is_file():
            raise FileNotFoundError(f"{str(path)!r} is not there; give a folder, a video, or photographs of one folder")
        if path.parent.resolve() != first.parent.resolve():
            raise ValueError(f"{str(path)!r} lies in another folder than {str(first)!r}; put them into one folder")
    return first.parent, tuple(folder.frame_name(path) for path in paths)


def select_frames(
    frames: Sequence[Frame], views: int | None = None, every_frame: bool = False, tell: Tell = ignore_progress
) -> Source:
    """Photographs that lie in no folder, or what is used of them: as of a folder's.

    Raises ValueError as `load_source`.
    """
    if views:
        return Source(tuple(frames[i] for i in _select_evenly(views, len(frames))), None, None)
    if every_frame or len(frames) <= ALL:
        return Source(tuple(frames), None, None)
    looked_through = report_items(frames, tell, "choosing keyframes", len(frames), "photograph")
    choice = choose(looked_through, _OF_PHOTOGRAPHS, Limits(), MOST, "photograph")
    return Source((*choice.keyframes, *choice.dropped), None, choice)


def load_recording(request: Request, tell: Tell = ignore_progress) -> ReplayRecording:
    """As `load_source`, without a limit to the number of keyframes."""
    _check_there(request.source)
    images: set[tuple[str, str, int, int]] = set()
    looked_through = _record_sizes(_stream_candidates(request, tell), images)
    choice = choose(looked_through, _selection(request), Limits(), None, _unit_name(request))
    if request.lenses is not None:
        request.lenses.check(images)
    return ReplayRecording(request.source, request.listed, choice, request.masks, request.lenses)


def load_source(request: Request, tell: Tell = ignore_progress) -> Source:
    """The frames that are asked for; `tell` hears how far the reading is.

    Raises FileNotFoundError and ValueError where there is nothing that can be used.
    """
    _check_there(request.source)
    found = _load_unmasked(request, tell)
    if request.lenses is not None:
        found = apply_lenses(found, request.lenses)
    return found if request.masks is None else apply_masks(found, open_masks(request.masks), tell)


def apply_lenses(given: Source, lenses: Lenses) -> Source:
    """Returns the frames, each with its lens. Raises ValueError where a lens is of none of them."""
    lenses.check(describe_image(each) for each in given.frames if isinstance(each, Frame))
    return replace(given, frames=tuple(map(lenses.apply, given.frames)))


def add_poses(given: Source, poses: Mapping[str, Array], sigma_m: float, sigma_deg: float) -> Source:
    """The frames, each with its pose of `poses` (4, 4), metres, by their names, and its sigmas. Raises ValueError."""

    def add_pose(frame: Frame | DroppedFrame) -> Frame | DroppedFrame:
        if not isinstance(frame, Frame) or frame.name not in poses:
            return frame
        try:
            return replace(frame, given_pose=make_given_pose(poses[frame.name], sigma_m, sigma_deg))
        except ValueError as error:
            raise ValueError(f"{sanitize_name(frame.name)}: {error}") from error

    return replace(given, frames=tuple(map(add_pose, given.frames)))


def apply_masks(given: Source, find: Find, tell: Tell = ignore_progress) -> Source:
    """The frames, each with the mask that is found for it. Raises UnusableMask where one cannot be its mask."""
    return replace(given, frames=tuple(mask_frames(given.frames, find, tell)))


def _load_unmasked(request: Request, tell: Tell) -> Source:
    if film.is_film(request.source):
        if request.frames:
            raise ValueError("--frames names photographs of a folder; of a video, give --views N or nothing")
        return _select_keyframes(request, None, tell)
    names, there = _names(request), _list_photographs(request)
    if names or request.every_frame or len(_skip_raw_files(there)) <= ALL:
        frames = folder.stream(folder.Config(folder=request.source, names=names or request.listed))
        of = len(names or there)
        return Source(tuple(report_items(frames, tell, "reading", of, "photograph")), request.source, None)
    return _select_keyframes(request, request.source, tell)


def _check_there(path: Path) -> None:
    if not path.exists() and re.match(r"[a-z]+:/+", str(path)):
        raise ValueError(f"{str(path)!r} is an address; nothing is fetched: download it first and give the file")
    if not path.exists() and not film.is_film(path):
        raise FileNotFoundError(
            f"{str(path)!r} is not there; give a folder that holds photographs, a video, or an MCAP file"
        )
    if path.is_dir() and data_set.is_data_set(path):
        first = data_set.list_parts(path)[0]
        raise ValueError(
            f"{str(path)!r} is a LeRobot data set; name an episode and a camera of it, such as "
            f"{str(film.part_of(path, first))!r}, or give it to `splatnode batch`, which takes them all"
        )


def _list_photographs(request: Request) -> Sequence[str]:
    """The names of the photographs that there are to choose from."""
    return request.listed or folder.names_in(request.source)


def _skip_raw_files(names: Sequence[str]) -> Sequence[str]:
    """Without raw files, beside which their cameras put photographs; all where there is nothing else."""
    return [name for name in names if folder.explain_unreadable_file(Path(name)) is None] or names


def _stream(path: Path, listed: tuple[str, ...]) -> Iterator[Frame | DroppedFrame]:
    if film.is_film(path):
        return film.stream(path)
    return folder.stream(folder.Config(folder=path, names=listed))


def _stream_candidates(request: Request, tell: Tell) -> Iterator[Frame | DroppedFrame]:
    """All that there is to choose from; how many frames a video has is known at its end."""
    of = 0 if film.is_film(request.source) else len(_list_photographs(request))
    doing = f"choosing keyframes of {sanitize_name(request.source.name)}"
    return report_items(_stream(request.source, request.listed), tell, doing, of, _unit_name(request))


def _record_sizes(
    frames: Iterator[Frame | DroppedFrame], images: set[tuple[str, str, int, int]]
) -> Iterator[Frame | DroppedFrame]:
    """The frames, whose names, cameras and sizes are added to `images` as they pass."""
    for each in frames:
        if isinstance(each, Frame):
            images.add(describe_image(each))
        yield each


def _unit_name(request: Request) -> str:
    """One of those that keyframes are chosen of."""
    return "frame" if film.is_film(request.source) else "photograph"


def _selection(request: Request) -> Config:
    config = Config() if film.is_film(request.source) else _OF_PHOTOGRAPHS
    return msgspec.structs.replace(config, every_frame=request.every_frame)


def _select_keyframes(request: Request, photographs: Path | None, tell: Tell) -> Source:
    """The keyframes of a recording; with --views N so many, evenly spread: thinning leaves half of the most."""
    most = EVERY if request.every_frame else max(MOST, 2 * (request.views or 0))
    choice = choose(_stream_candidates(request, tell), _selection(request), Limits(), most, _unit_name(request))
    frames = choice.keyframes
    if request.every_frame and THINNED in choice.left_out:
        raise ValueError(
            f"{sanitize_name(request.source.name)!r} has more than {EVERY} frames that are sharp and no copies, which "
            "is more than one scene takes. Leave --every-frame out to use keyframes, or add --map for a map of all"
        )
    if request.views:
        if request.views > len(frames):
            raise ValueError(f"{request.views} views are asked for: {choice}; ask for at most as many")
        frames = tuple(frames[i] for i in _space_evenly(len(frames), request.views))
    return Source((*frames, *choice.dropped), photographs, choice)


def _names(request: Request) -> tuple[str, ...]:
    """Returns the names of the images to use; none means all."""
    if request.frames and request.listed:
        raise ValueError("--frames names photographs of a folder; here they are listed already, so leave it out")
    if request.frames:
        return request.frames
    if not request.views:
        return ()
    names = _skip_raw_files(_list_photographs(request))
    return tuple(names[i] for i in _select_evenly(request.views, len(names)))


def _select_evenly(views: int, count: int) -> list[int]:
    """So many of `count` photographs. Raises ValueError where there are fewer."""
    if views > count:
        raise ValueError(f"{views} views are asked for: there are {count} photographs; ask for at most as many")
    return _space_evenly(count, views)


def _space_evenly(count: int, wanted: int) -> list[int]:
    return np.linspace(0, count - 1, wanted).round().astype(int).tolist()
